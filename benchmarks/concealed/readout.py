"""From a trajectory to channels: what each readout makes of the motion, its noise, and its converter."""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import inf, pi

import numpy as np
from numba import njit
from numpy.typing import NDArray

from benchmarks.concealed.motion import (
    MEMORY,
    RATE,
    READOUT,
    SECTION_2,
    THETA,
    Trajectory,
    flat_output,
    integrate,
)
from benchmarks.concealed.scanner_truth import Truth
from benchmarks.concealed.worlds import LEAD, World

Array = NDArray[np.float64]
Rng = np.random.Generator

# fmt: off
AFTER_MOTION = (
    "offset", "delay", "skew", "swing_delay", "jitter", "jitter_frequency", "rate_gain", "gain_drift",
    "ripple", "ripple_frequency", "sensor_cubic", "tone", "tone_frequency", "tone_phase", "feedthrough",
    "drift_1", "drift_2", "drift_3", "play", "play_width", "limit", "angle_cubic", "edge", "edge_loss",
)
# fmt: on
"""Numbers of the truth that no state of the trajectory hears of: only :func:`read` and :func:`limited` take them."""
SETTLING = 30e-3
"""Time that a driven mirror is given to reach its steady swing before anything is recorded [s]."""


def settle(world: World, truth: Truth) -> World:
    """The world with the state that ``truth`` has reached where its trajectory starts: driven, it swings by then."""
    if world.family != "drive":
        return world
    start, step = -SETTLING - LEAD, 1 / world.steps_per_second
    run_up = integrate(truth, world.voltages(start, -LEAD, step), start, step, world.initial)
    return replace(world, initial=run_up.states[-1])


def move(world: World, truth: Truth, refine: int = 1) -> Trajectory:
    """The motion over the recording, from ``LEAD`` before it on, at ``refine`` times the integrator's rate."""
    step = 1 / (world.steps_per_second * refine)
    refined = refine > 1
    voltages = world.voltages(-LEAD, world.duration + LEAD, step) if refined else world.recorded_voltages
    return integrate(truth, voltages, -LEAD, step, world.initial)


def observe(world: World, truth: Truth, refine: int = 1) -> dict[str, Array]:
    """Every channel that is measured, without noise, each (samples,)."""
    return read(world, truth, move(world, truth, refine))


def read(world: World, truth: Truth, trajectory: Trajectory) -> dict[str, Array]:
    """As :func:`observe`, of a motion that is there already."""
    channels = {"sense_x": sense(world, truth, trajectory)}
    if world.angle_sd is not None:
        channels["angle_x"] = angle(trajectory.at(world.times, THETA), truth)
    return channels


def sense(world: World, truth: Truth, trajectory: Trajectory) -> Array:
    """The readout's voltage at the samples, before its output stage limits it, (samples,) [V]."""
    p, t, T = truth, world.times, world.duration
    swing = np.maximum(trajectory.at(t, MEMORY), 0.0)
    clock = t * (1 + p.skew) - p.delay - p.swing_delay * swing + p.jitter * np.sin(p.jitter_frequency * t)
    # A multisine takes longer to evaluate than its motion to integrate: only where it is felt.
    felt = p.feedthrough != 0.0 or p.R_s != 0.0
    command = world.command(clock) if felt else np.zeros_like(clock)
    rate = trajectory.at(clock, RATE)
    if p.readout_corner < inf:
        volts = trajectory.at(clock, READOUT)
    else:
        bias = command + charged(p, clock)
        volts = _flat(trajectory.at(clock, THETA), rate, trajectory.at(clock, SECTION_2), bias, p)
    volts = (volts + p.offset) * (1 + p.rate_gain * np.tanh(rate / (0.03 * world.omega * world.swing)))
    volts = volts * (1 + p.gain_drift * t / T) * (1 + p.ripple * np.sin(p.ripple_frequency * t))
    volts = volts * (1 + p.sensor_cubic * volts**2)
    volts = volts + p.tone * np.sin(p.tone_frequency * t + p.tone_phase)
    if p.feedthrough != 0.0:
        volts = volts + p.feedthrough * (command - p.drive_mean)
    for half_waves, size in enumerate((p.drift_1, p.drift_2, p.drift_3), start=1):
        volts = volts + size * np.cos(pi * half_waves * t / T)
    if p.play != 0.0:
        volts = (1 - p.play) * volts + p.play * play(volts, p.play_width)
    return volts


def limited(volts: Array, p: Truth) -> Array:
    """What the output stage lets through, noise and all, (n,) [V]."""
    return np.clip(volts, -p.limit, p.limit)


def charged(p: Truth, clock: Array) -> Array:
    """Charge on the combs over time, in volts, (n,)."""
    return p.charge * -np.expm1(-np.maximum(clock, 0.0) / p.charge_tau)


def angle(theta: Array, p: Truth) -> Array:
    """The reference detector's reading of angles (n,) [rad]."""
    seen = theta * (1 + p.angle_cubic * theta**2)
    return seen - p.edge_loss * np.maximum(seen - p.edge, 0.0) if p.edge < inf else seen


@njit(cache=True)
def play(volts: Array, half_width: float) -> Array:
    """Play operator: the output stays until the input has crossed a gap, then follows it (hysteresis without rate)."""
    out = np.empty_like(volts)
    held = volts[0]
    for i in range(len(volts)):
        held = min(max(held, volts[i] - half_width), volts[i] + half_width)
        out[i] = held
    return out


@njit(cache=True)
def _flat(theta: Array, rate: Array, section: Array, bias: Array, p: Truth) -> Array:
    out = np.empty_like(theta)
    for i in range(len(theta)):
        out[i] = flat_output(theta[i], rate[i], section[i], bias[i], p)
    return out


@dataclass(frozen=True)
class Noise:
    """White noise, and what a device file says nothing of: a rise to low frequencies, a broad line, and mains hum.

    Attributes:
        sd: of the white part [V].
        knee: where the 1/f part equals the white one, 0 for none [Hz].
        bump, bump_width, bump_height: centre and width [Hz] of the broad line, and its density over the white one.
        hum: amplitudes of the mains' first harmonics [V].
        mains: [Hz].
    """

    sd: float
    knee: float = 0.0
    bump: float = 0.0
    bump_width: float = 1.0
    bump_height: float = 0.0
    hum: tuple[float, ...] = ()
    mains: float = 50.0

    @classmethod
    def coloured(cls, sd: float, sample_rate: float, rng: Rng) -> Noise:
        """Drawn so that the stated standard deviation holds at high frequencies only."""
        return cls(
            sd=sd,
            knee=sample_rate / rng.uniform(40, 150),
            bump=sample_rate / rng.uniform(12, 40),
            bump_width=sample_rate / rng.uniform(200, 600),
            bump_height=rng.uniform(1.5, 6),
            hum=tuple((sd * rng.uniform(0.2, 1.5, 3) / np.arange(1, 4)).tolist()),
            mains=float(rng.choice([50.0, 60.0])),
        )

    @property
    def is_coloured(self) -> bool:
        return self.knee > 0

    def density(self, frequency: Array, lowest: float) -> Array:
        """Power density over that of the white part, (n,); flat below ``lowest`` [Hz]."""
        bump = self.bump_height * np.exp(-0.5 * ((frequency - self.bump) / self.bump_width) ** 2)
        return 1 + self.knee / np.maximum(frequency, lowest) + bump

    def draw(self, times: Array, rng: Rng) -> Array:
        """One realisation at uniform ``times`` (n,) [V]."""
        n, sample_rate = len(times), 1 / (times[1] - times[0])
        # Drawn twice as long as needed, so that its ends do not join.
        frequency = np.fft.rfftfreq(2 * n, 1 / sample_rate)
        spectrum = np.fft.rfft(rng.standard_normal(2 * n)) * np.sqrt(self.density(frequency, sample_rate / (2 * n)))
        noise = self.sd * np.fft.irfft(spectrum, 2 * n)[:n]
        for harmonic, amplitude in enumerate(self.hum, start=1):
            noise += amplitude * np.sin(2 * pi * self.mains * harmonic * times + rng.uniform(0, 2 * pi))
        return noise


def digitise(volts: Array, bits: int, full_scale: float) -> Array:
    """What a converter of ``bits`` over ``full_scale`` [V] returns, in volts."""
    lsb = full_scale / 2**bits
    return np.round(volts / lsb) * lsb
