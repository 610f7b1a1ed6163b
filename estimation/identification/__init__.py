"""Device constants with intervals from recordings at rest, in free decay and under drive.

No estimator of motion and nothing of the diagnosis may be in here.
"""
