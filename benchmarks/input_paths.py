"""Phase error of every way to state the motion, of one mirror simulated without this program's device models.

    python -m benchmarks.input_paths [--first SEED]

Two sines of 1870 and 733 Hz whose phases drift by 9 and 6 degrees in 0.1 s, at 1 MS/s, over a specimen of 60 spots
with 60 photons a sample beside them and 150 to 360 in their middles. Each row is one recording with its own seed: the
channels named, in noise, and the intensity. The errors are those of the angle at the samples of the intensity, against
the sines, as a phase.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

import lissajous
from lissajous import Device, Recording
from scanner.arrays import Array
from scanner.device import AXES

RATE_HZ, SAMPLES, HALF_RAD = 1e6, 100_000, 0.08
FREQUENCY_HZ, AMPLITUDE_RAD, DRIFT_RAD = {"x": 1870.0, "y": 733.0}, {"x": 0.078, "y": 0.075}, {"x": 0.16, "y": -0.1}
LOCK_IN_RATE_HZ, ANGLE_NOISE_RAD, JITTER_S = 10e3, 1e-4, 1e-7
FAST_HZ, FAST_RATE_HZ = {"x": 9300.0, "y": 3170.0}, 5e6
"""Of the scan of which only frequencies are known, which needs 1000 samples a period."""
FIELD = f"[scan]\nhalf_angle_x = {HALF_RAD}\nhalf_angle_y = {HALF_RAD}\n"
INERTIA, QUALITY = 1e-10, 100.0

Channels = dict[str, tuple[Any, ...]]


class Scan:
    """The true motion and what instruments record of it."""

    def __init__(self, seed: int, frequency: Mapping[str, float], rate: float, drift: float = 1.0) -> None:
        self.rng, self.rate, self.frequency = np.random.default_rng(seed), rate, frequency
        self.time = np.arange(round(SAMPLES / RATE_HZ * rate)) / rate
        self.start = {axis: self.rng.uniform(-np.pi, np.pi) for axis in AXES}
        self.rise = {axis: drift * DRIFT_RAD[axis] * (1.0 - np.exp(-self.time / 0.033)) for axis in AXES}
        self.phase = {
            axis: 2 * np.pi * f * self.time + self.start[axis] + self.rise[axis] for axis, f in frequency.items()
        }
        self.angle = {axis: AMPLITUDE_RAD[axis] * np.sin(self.phase[axis]) for axis in AXES}
        self.light = self._light()

    def _light(self) -> Array:
        x, y = (self.angle[axis] / HALF_RAD for axis in AXES)
        scene = np.full(x.size, 0.2)
        for _ in range(60):
            column, row, size = *self.rng.uniform(-0.95, 0.95, 2), self.rng.uniform(0.015, 0.06)
            scene += self.rng.uniform(0.3, 1.0) * np.exp(-((x - column) ** 2 + (y - row) ** 2) / (2 * size**2))
        return np.asarray(self.rng.poisson(300.0 * scene) / 300.0)

    def derivative(self, axis: str, order: int) -> Array:
        """Angle or its derivative [rad/s^order], in noise of the same relative size."""
        w = np.gradient(self.phase[axis], self.time)
        value = AMPLITUDE_RAD[axis] * w**order * np.sin(self.phase[axis] + order * np.pi / 2)
        return np.asarray(value + self.rng.normal(0.0, ANGLE_NOISE_RAD * w.mean() ** order, value.size))

    def drive(self, axis: str) -> Array:
        """Steady voltage that the resonant motion lags by a quarter of a turn."""
        return np.asarray(5.0 * np.sin(2 * np.pi * self.frequency[axis] * self.time + self.start[axis] + np.pi / 2))

    def edges(self, axis: str, place: float, upward_only: bool) -> Array:
        """Times at which the beam passes a place [rad], with jitter [s]."""
        left = self.angle[axis] - place
        at = np.flatnonzero((left[:-1] < 0.0) & (left[1:] >= 0.0) if upward_only else left[:-1] * left[1:] < 0.0)
        times = (at - left[at] / (left[at + 1] - left[at])) / self.rate
        return np.asarray(times + self.rng.normal(0.0, JITTER_S, times.size))

    def turns(self, axis: str) -> Array:
        """Times of both turning points, with jitter [s]."""
        number = np.arange(np.ceil(self.phase[axis][0] / np.pi - 0.5), self.phase[axis][-1] / np.pi - 0.5)
        times = np.interp((number + 0.5) * np.pi, self.phase[axis], self.time)
        return np.asarray(times + self.rng.normal(0.0, JITTER_S, times.size))

    def lock_in(self, axis: str) -> tuple[Array, Array]:
        """Amplitude and phase [rad] at the nominal frequency."""
        every = round(self.rate / LOCK_IN_RATE_HZ)
        phase = (self.start[axis] + self.rise[axis])[::every]
        amplitude = np.full(phase.size, AMPLITUDE_RAD[axis])
        noise = self.rng.normal(0.0, 1e-3, (2, phase.size))
        return amplitude * (1.0 + noise[0]), phase + noise[1]


def device(readout: str = "", frequencies: Mapping[str, float] | None = None, mechanics: bool = False) -> str:
    """A device file with what the row needs."""
    text = ""
    for axis in AXES:
        text += f"[{axis}]\n"
        if mechanics:
            w = 2 * np.pi * FREQUENCY_HZ[axis]
            text += f"[{axis}.mechanics]\nJ = {INERTIA}\nb = {INERTIA * w / QUALITY}\nk = {INERTIA * w**2}\n"
        if mechanics or frequencies:
            torque = 1.0 if not mechanics else INERTIA * w**2 / QUALITY * AMPLITUDE_RAD[axis] / 5.0
            text += f'[{axis}.drive]\nkind = "linear"\n'
            text += f"frequency = {frequencies[axis]}\n" if frequencies else f"torque_per_volt = {torque}\n"
        text += f"[{axis}.readout]\n{readout}" if readout else ""
    return text + FIELD


def _each(scan: Scan, name: str, unit: str, values: Callable[[str], Array], **stated: Any) -> Channels:
    clock = (stated,) if stated else (scan.rate,)
    return {f"{name}_{axis}": (values(axis), unit, *clock) for axis in AXES}


def _lock_in(scan: Scan) -> Channels:
    found: Channels = {}
    for axis in AXES:
        for name, values in zip(("amplitude", "phase"), scan.lock_in(axis), strict=True):
            found[f"{name}_{axis}"] = (values, "rad", LOCK_IN_RATE_HZ, 0.0, {"reference": scan.frequency[axis]})
    return found


POSITION = 'kind = "position"\ngain = 20.0\nnoise_sd = 2.0e-3\n'
"""Readout of 20 V/rad with the noise of ``ANGLE_NOISE_RAD``."""


def paths(scan: Scan) -> dict[str, tuple[Channels, str, str | None]]:
    """Channels, device and estimator (None: the default) by name of the row."""
    volts = _each(scan, "sense", "V", lambda axis: 20.0 * scan.derivative(axis, 0))
    drives = _each(scan, "drive", "V", scan.drive)
    rates = {"velocity": "rad/s", "acceleration": "rad/s2"}
    speed = {
        name: _each(scan, name, unit, lambda axis, order=order: scan.derivative(axis, order))  # type: ignore[misc]
        for order, (name, unit) in enumerate(rates.items(), 1)
    }
    both = _each(scan, "sync", "s", lambda axis: scan.edges(axis, 0.03, False), angle=0.03)
    upward = _each(scan, "sync", "s", lambda axis: scan.edges(axis, 0.0, True), event="zero-crossing-up")
    turns = _each(scan, "sync", "s", scan.turns, event="turn")
    angle = _each(scan, "angle", "rad", lambda axis: scan.derivative(axis, 0))
    return {
        "`sense_x`, position readout": (volts, device(POSITION), None),
        "`sense_x`, `drive_x`, position readout, `tracker`": (
            volts | drives, device(POSITION, mechanics=True), "tracker"),
        "`angle_x`": (angle, device(), None),
        "`velocity_x`, `drive_x`": (speed["velocity"] | drives, device(mechanics=True), None),
        "`velocity_x` alone": (speed["velocity"], device(mechanics=True), None),
        "`acceleration_x`, `drive_x`": (speed["acceleration"] | drives, device(mechanics=True), None),
        "`sync_x`, both edges at 0.03 rad": (both, device(), None),
        "`sync_x`, upward crossings": (upward, device(), None),
        "`sync_x`, turning points": (turns, device(), None),
        "`amplitude_x`, `phase_x`": (_lock_in(scan), device(), "sensor"),
        "`drive_x`, mechanics": (drives, device(mechanics=True), None),
    }  # fmt: skip


def measure(scan: Scan, channels: Channels, text: str, estimator: str | None) -> list[str]:
    """Estimator, phase errors and stated standard deviations of x and y [degrees]; a sign that is open is chosen."""
    light = {"intensity": (scan.light, "V", scan.rate)}
    result = lissajous.reconstruct(Recording.from_arrays(channels | light, Device.from_toml(text)), estimator=estimator)
    errors, stated = [], []
    for axis in AXES:
        found = np.asarray(result.motion.axes[axis].angle.read())
        truth, known = scan.angle[axis][: found.size], np.isfinite(found)
        # The factor by which the amplitude is off, or the sign, scales the picture and is no error of phase.
        left = found[known] * (found[known] @ truth[known]) / (found[known] @ found[known]) - truth[known]
        errors.append(np.degrees(np.sqrt(2.0 * np.mean(left**2)) / AMPLITUDE_RAD[axis]))
        stated.append(float(np.degrees(np.sqrt(np.mean(np.square(result.motion.axes[axis].phase_sd))))))
    return [result.motion.estimator, *(", ".join(f"{each:.3f}°" for each in pair) for pair in (errors, stated))]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--first", type=int, default=0, metavar="SEED")
    first = parser.parse_args().first
    print("| channels | estimator | angle error as a phase, x, y | stated sd of the phase |\n|" + " --- |" * 4)
    for k, name in enumerate(paths(Scan(first, FREQUENCY_HZ, RATE_HZ))):
        scan = Scan(first + k, FREQUENCY_HZ, RATE_HZ)
        print("| " + " | ".join([name, *measure(scan, *paths(scan)[name])]) + " |", flush=True)
    scan = Scan(first + 50, FAST_HZ, FAST_RATE_HZ, drift=0.5)
    row = measure(scan, {}, device(frequencies=FAST_HZ), None)
    print("| " + " | ".join(["frequencies alone, 9300 and 3170 Hz", *row]) + " |", flush=True)


if __name__ == "__main__":
    sys.exit(main())
