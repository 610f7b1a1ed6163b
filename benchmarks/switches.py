"""The tracker where a drive stops and starts again: phase errors and the intervals that claim them (docs/bound.md).

The imaging scanner's x axis on an electrode of its own, its stiffness drifting, its drive off for some milliseconds.
Run: python -m benchmarks.switches [drifts] [milliseconds off]
"""

from __future__ import annotations

import json
import sys
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from benchmarks.clipped import told, with_signal
from benchmarks.tracker_bound import DRIVES, device_with, wandering
from estimation.tracker import track
from estimation.tracker.angle import SlowAngle
from phantoms.forward import Plan, simulate
from phantoms.waveforms import Constant, Sequence
from scanner.drift import Drift
from scanner.motion import AxisMotion

Array = NDArray[np.float64]

RATE, NOISE_SD, NOISES = 5e6, 0.01386, 2  # Hz, V, recordings of each drift
BEFORE, BEHIND = 0.010, 0.014  # s: how long the drive is on


def instant_errors(axis: AxisMotion, angle: Array) -> Array:
    """Phase error at each block's middle, modulo pi [rad]: the truth from two cycles about it, free to change."""
    assert isinstance(axis.angle, SlowAngle)
    reference = axis.angle.motion.reference
    out = []
    for time, phase in zip(axis.time, axis.phase + reference.phase(axis.time), strict=True):
        middle, half = round(time * RATE), round(RATE / reference.frequency)
        s = np.arange(middle - half, middle + half + 1) / RATE - time
        turn, window = 2 * np.pi * reference.frequency * s, np.cos(0.5 * np.pi * s * RATE / (half + 1)) ** 2
        rows = [np.ones(s.size), *(g(n * turn) for n in (1, 3) for g in (np.sin, np.cos))]
        table = np.array([*rows, rows[1] * turn, rows[2] * turn])
        fit = np.linalg.solve((table * window) @ table.T, (table * window) @ angle[middle - half : middle + half + 1])
        out.append(phase - np.angle(fit[1] + 1j * fit[2]))
    return (np.array(out) + np.pi / 2) % np.pi - np.pi / 2


def drive_off(drifts: int, off: float) -> dict[str, dict[str, float]]:
    """Errors and deviations by part of the scan, the drive off for ``off`` [s]."""
    device = device_with(False)
    device = replace(device, axes={"x": device.axis("x")}, scan=None)
    drive = Sequence(((DRIVES["x"], BEFORE), (Constant(0.0), off), (DRIVES["x"], BEHIND)))
    errors, sds, time = [], [], np.empty(0)
    for seed in range(drifts):
        drift = {"x": Drift(wandering(np.random.default_rng(seed)))}
        quiet, truth = simulate(device, Plan({"x": drive}, BEFORE + off + BEHIND, drift=drift))
        signal = quiet["sense_x"].read()
        for noise in range(NOISES):
            rng = np.random.default_rng([seed, noise])
            noisy = with_signal(quiet, device, "sense_x", signal + rng.normal(0.0, NOISE_SD, signal.size))
            axis = track(noisy, device).axes["x"]
            errors.append(instant_errors(axis, truth["angle_x"][0].astype(np.float64))[1:-1])
            sds.append(axis.phase_sd[1:-1])
            time = axis.time[1:-1]
    error, claimed, half = np.array(errors), np.array(sds), 0.5 * (time[1] - time[0])
    stop, start = (np.abs(time - at) <= half for at in (BEFORE, BEFORE + off))
    parts = {
        "decay": (time > BEFORE) & (time < BEFORE + off) & ~stop & ~start,
        "block of the start": start,
        "block of the stop": stop,
        "whole scan": np.ones(time.size, bool),
    }
    return {name: told(error[:, part], claimed[:, part]) for name, part in parts.items()}


def main() -> None:
    given = [float(each) for each in sys.argv[1:]]
    drifts, off = (*given, *(60.0, 4.0)[len(given) :])
    print(json.dumps(drive_off(round(drifts), 1e-3 * off), indent=1))


if __name__ == "__main__":
    main()
