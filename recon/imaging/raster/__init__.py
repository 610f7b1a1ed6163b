"""Line phase of resonant raster frames and films: how far the lines of the two directions lie apart."""
