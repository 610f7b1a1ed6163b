"""The instrument: device, physics by stage, channels, recording and motion.

It imports none of the other packages: nothing in here estimates, simulates experiments or makes pictures.
"""
