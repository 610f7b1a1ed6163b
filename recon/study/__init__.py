"""Blur studies: many simulated recordings, each reconstructed in many ways, as one table."""
