"""Phase errors of the tracker and its stated standard deviations where a drive stops and starts again.

The x axis of the imaging scanner, on a separate electrode. Its stiffness drifts, and its drive is off for some
milliseconds. docs/explanation/tracker.md has the results.
Run: python -m benchmarks.switches [drifts] [milliseconds off]
"""

from __future__ import annotations

import json
import sys
from dataclasses import replace

import numpy as np

from benchmarks.clipped import summarise_errors, with_signal
from benchmarks.tracker_bound import DRIVES, draw_stiffness_drift, noise_free_device, wrap_half_turn
from estimation.tracker import track
from estimation.tracker.angle_synthesis import PhasorAngle
from phantoms.forward import Plan, simulate
from phantoms.waveforms import Constant, Sequence
from scanner.arrays import Array
from scanner.drift import Drift
from scanner.motion import AxisMotion

SAMPLE_RATE_HZ, NOISE_SD_V = 5e6, 0.01386
"""Sample rate of the recordings [Hz], and noise of the sense signal [V]: that of the imaging scanner's readout."""

NOISES_PER_DRIFT = 2
"""Recordings of each drift: a simulation takes longer than a track."""

ON_BEFORE_S, ON_AFTER_S = 0.010, 0.014
"""Times for which the drive is on before and after the interruption [s]: several decay times each."""

DEFAULT_DRIFTS, DEFAULT_OFF_MS = 60.0, 4.0
"""Number of drifts, and interruption of the drive [ms], of a run without arguments."""


def phase_errors_at_blocks(axis: AxisMotion, angle: Array) -> Array:
    """Phase error at the middle of each block, modulo pi, shape (blocks,) [rad].

    The true phase is fitted to two cycles of the angle about the middle. Phase and amplitude may change linearly in
    them.

    Args:
        axis: tracked motion.
        angle: true angle at every sample, shape (samples,) [rad].
    """
    assert isinstance(axis.angle, PhasorAngle)
    reference = axis.angle.motion.reference
    errors = []
    for time, phase in zip(axis.time, axis.phase + reference.phase(axis.time), strict=True):
        middle, half = round(time * SAMPLE_RATE_HZ), round(SAMPLE_RATE_HZ / reference.frequency)
        offset = np.arange(middle - half, middle + half + 1) / SAMPLE_RATE_HZ - time
        u, window = (
            2 * np.pi * reference.frequency * offset,
            np.cos(0.5 * np.pi * offset * SAMPLE_RATE_HZ / (half + 1)) ** 2,
        )
        rows = [np.ones(offset.size), *(g(n * u) for n in (1, 3) for g in (np.sin, np.cos))]
        table = np.array([*rows, rows[1] * u, rows[2] * u])
        fit = np.linalg.solve((table * window) @ table.T, (table * window) @ angle[middle - half : middle + half + 1])
        errors.append(phase - np.angle(fit[1] + 1j * fit[2]))
    return wrap_half_turn(np.array(errors))


def track_with_drive_off(drifts: int, off: float) -> dict[str, dict[str, float]]:
    """``summarise_errors`` by part of the scan.

    Args:
        drifts: number of drifts.
        off: time for which the drive is off [s].
    """
    device = noise_free_device(False)
    device = replace(device, axes={"x": device.axis("x")}, scan=None)
    drive = Sequence(((DRIVES["x"], ON_BEFORE_S), (Constant(0.0), off), (DRIVES["x"], ON_AFTER_S)))
    errors, sds, time = [], [], np.empty(0)
    for seed in range(drifts):
        drift = {"x": Drift(draw_stiffness_drift(np.random.default_rng(seed)))}
        quiet, truth = simulate(device, Plan({"x": drive}, ON_BEFORE_S + off + ON_AFTER_S, drift=drift))
        signal = quiet["sense_x"].read()
        for noise in range(NOISES_PER_DRIFT):
            rng = np.random.default_rng([seed, noise])
            noisy = with_signal(quiet, device, "sense_x", signal + rng.normal(0.0, NOISE_SD_V, signal.size))
            axis = track(noisy, device).axes["x"]
            errors.append(phase_errors_at_blocks(axis, truth["angle_x"][0].astype(np.float64))[1:-1])
            sds.append(axis.phase_sd[1:-1])
            time = axis.time[1:-1]
    error, sd, half = np.array(errors), np.array(sds), 0.5 * (time[1] - time[0])
    stop, start = (np.abs(time - switch) <= half for switch in (ON_BEFORE_S, ON_BEFORE_S + off))
    parts = {
        "decay": (time > ON_BEFORE_S) & (time < ON_BEFORE_S + off) & ~stop & ~start,
        "block of the start": start,
        "block of the stop": stop,
        "whole scan": np.ones(time.size, bool),
    }
    return {name: summarise_errors(error[:, part], sd[:, part]) for name, part in parts.items()}


def main() -> None:
    arguments = [float(argument) for argument in sys.argv[1:]]
    drifts, off_ms = (*arguments, *(DEFAULT_DRIFTS, DEFAULT_OFF_MS)[len(arguments) :])
    print(json.dumps(track_with_drive_off(round(drifts), 1e-3 * off_ms), indent=1))


if __name__ == "__main__":
    main()
