"""Worlds with a known answer: targets, optics, the forward simulation. Knows ``scanner`` only."""
