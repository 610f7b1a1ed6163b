"""Simulated recordings with a concealed effect, and a scorer for diagnoses of them.

This folder imports nothing of the program, because a diagnosis must not be judged by the simulator that it fits with.
It has its own equations, integrator, filters and sampling rates. What is concealed stands in a key file, which only
the scorer reads.
"""
