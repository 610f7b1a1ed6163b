"""The picture of a scan in its three kinds (mean, kernel-weighted, posterior), with their standard deviations."""
