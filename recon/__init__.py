"""From motion and intensities to pictures: mapping, blur, report, pipeline, the command line."""
