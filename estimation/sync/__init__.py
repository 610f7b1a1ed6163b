"""Phase and frequency of a motion from the edges of a detector that the beam crosses."""
