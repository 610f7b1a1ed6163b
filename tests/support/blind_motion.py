"""A linear scanner of the blind generator, and its motion from a given angle."""

from math import pi

import numpy as np

from benchmarks.blind.motion import NODES, STATES, THETA, Trajectory, integrate
from benchmarks.blind.scanner_truth import Truth

OMEGA = 2 * pi * 700.0
LINEAR = Truth(J=1e-12, b=1e-12 * OMEGA / 40, k=1e-12 * OMEGA**2, torque_per_volt=1e-8, gain=40.0)
UNDAMPED = LINEAR._replace(b=0.0)
STEP = 5e-6
SWING = 0.02


def run(truth: Truth, volts: np.ndarray | float = 0.0, theta: float = SWING, steps: int = 20_000) -> Trajectory:
    initial = np.zeros(STATES)
    initial[THETA] = theta
    return integrate(truth, np.broadcast_to(np.asarray(volts), (steps, len(NODES))).copy(), 0.0, STEP, initial)
