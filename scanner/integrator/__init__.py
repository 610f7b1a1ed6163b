"""Integration of the equation of motion with any set of compiled terms.

Drives, channels and readouts are not in here: ``scanner.forward_model`` calls this package and passes its result on.
"""
