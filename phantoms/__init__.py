"""Simulated experiments with a known answer: targets, optics, circuits, drives and the forward simulation.

It imports ``scanner`` only. No estimator may import it, so that an estimator cannot use the simulator's truth.
"""
