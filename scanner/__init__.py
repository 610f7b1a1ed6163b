"""What the instrument is: the device, its physics stage by stage, the recording. Knows no other package."""
