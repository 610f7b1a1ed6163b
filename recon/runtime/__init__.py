"""Running the work: processes, interruption, compilation, the same work on many recordings."""
