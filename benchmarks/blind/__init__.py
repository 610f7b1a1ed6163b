"""Simulated recordings with a concealed effect, and a scorer for diagnoses of them.

This folder imports nothing of the program, because a diagnosis must not be tested with the simulator that it fits.
It has its own equations, integrator, filters and sampling rates. The concealed effects are in a key file, which only
the scorer reads.
"""
