"""Pictures that follow one another: frames of a scan, stacks of recordings."""
