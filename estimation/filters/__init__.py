"""Kalman filters of the three papers and baselines without a filter, in a readable and a compiled engine.

Imports `scanner` and the shared modules of `estimation`; nothing of the tracker, the diagnosis or the pictures.
"""
