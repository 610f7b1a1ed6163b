"""Blur studies: many simulated recordings, each reconstructed in many ways, as one table.

Plans, runs and reports studies; the simulation is in ``phantoms`` and the reconstruction in ``recon.pipeline``.
"""
