"""From signals to motion. Knows ``scanner`` only, never ``phantoms``: no estimator can reach the simulator."""
