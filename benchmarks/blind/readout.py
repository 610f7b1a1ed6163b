"""From a trajectory to channels: readouts, their noise, and the converter."""

from __future__ import annotations

from dataclasses import replace
from math import inf, pi

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy.signal import lfilter

from benchmarks.blind.imaging import partner_output
from benchmarks.blind.motion import (
    MEMORY,
    RATE,
    READOUT,
    SECTION_2,
    THETA,
    Trajectory,
    flat_output,
    integrate,
)
from benchmarks.blind.scanner_truth import Truth
from benchmarks.blind.scenarios import LEAD_TIME_S, Scenario

Array = NDArray[np.float64]

# fmt: off
AFTER_MOTION = (
    "offset", "delay", "skew", "swing_delay", "jitter", "jitter_frequency", "rate_gain", "gain_drift",
    "ripple", "ripple_frequency", "sensor_cubic", "tone", "tone_frequency", "tone_phase", "feedthrough",
    "drift_1", "drift_2", "drift_3", "play", "play_width", "limit", "angle_cubic", "edge", "edge_loss",
    "uneven", "uneven_pattern", "uneven_phase", "curve_5", "curve_7", "curve_height",
    "flutter", "flutter_frequency", "flutter_phase", "level_gain", "level_tau", "level_square",
    "rail", "code_step", "code_missing", "code_seed",
)
# fmt: on
"""Fields of :class:`Truth` that do not change the trajectory. Only :func:`channels_of_motion` and :func:`apply_limit`
use them, so a motion that was integrated once serves all their values."""
SETTLE_TIME_S = 30e-3
"""Time that a parametrically driven mirror gets to reach its steady swing before the recording starts: 8 time constants
of its envelope (quality 190 at 15.6 kHz) [s]."""


def settle_start(scenario: Scenario, truth: Truth) -> Scenario:
    """The scenario with the initial state that a driven mirror has reached when its trajectory starts."""
    if scenario.family != "drive":
        return scenario
    start, step = -SETTLE_TIME_S - LEAD_TIME_S, 1 / scenario.steps_per_second
    run_up = integrate(truth, scenario.voltages(start, -LEAD_TIME_S, step), start, step, scenario.initial)
    return replace(scenario, initial=run_up.states[-1])


def simulate_motion(scenario: Scenario, truth: Truth, refine: int = 1) -> Trajectory:
    """The motion over the recording, from ``LEAD_TIME_S`` before it, at ``refine`` times the integrator's rate."""
    step = 1 / (scenario.steps_per_second * refine)
    refined = refine > 1
    voltages = (
        scenario.voltages(-LEAD_TIME_S, scenario.duration + LEAD_TIME_S, step)
        if refined
        else scenario.recorded_voltages
    )
    return integrate(truth, voltages, -LEAD_TIME_S, step, scenario.initial)


def noiseless_channels(scenario: Scenario, truth: Truth, refine: int = 1) -> dict[str, Array]:
    """Every measured channel without noise, each (samples,)."""
    return channels_of_motion(scenario, truth, simulate_motion(scenario, truth, refine))


def channels_of_motion(scenario: Scenario, truth: Truth, trajectory: Trajectory) -> dict[str, Array]:
    """As :func:`noiseless_channels`, from a motion that is already integrated."""
    channels = {"sense_x": sense(scenario, truth, trajectory)}
    if scenario.partner is not None and not scenario.partner.shared:
        p = scenario.partner.truth
        channels["sense_y"] = p.offset + partner_output(scenario.partner, p, scenario.duration, scenario.times)
    if scenario.angle_sd is not None:
        channels["angle_x"] = angle(trajectory.at(scenario.times, THETA), truth)
    return channels


def sense(scenario: Scenario, truth: Truth, trajectory: Trajectory) -> Array:
    """The readout's voltage at the samples, before its output stage limits it, (samples,) [V]."""
    p, t, T = truth, scenario.times, scenario.duration
    swing = np.maximum(trajectory.at(t, MEMORY), 0.0)
    clock = t * (1 + p.skew) - p.delay - p.swing_delay * swing + p.jitter * np.sin(p.jitter_frequency * t)
    if p.uneven != 0.0:
        clock = clock + p.uneven * interleaving(len(t), p)
    # Evaluated only where it is used: a multisine takes longer to evaluate than its motion to integrate.
    uses_command = p.feedthrough != 0.0 or p.R_s != 0.0
    command = scenario.command(clock) if uses_command else np.zeros_like(clock)
    rate = trajectory.at(clock, RATE)
    if p.readout_corner < inf:
        volts = trajectory.at(clock, READOUT)
    else:
        bias = command + charge_voltage(p, clock)
        volts = _flat(trajectory.at(clock, THETA), rate, trajectory.at(clock, SECTION_2), bias, p)
    if scenario.partner is not None and scenario.partner.shared:
        volts = volts + partner_output(scenario.partner, p, scenario.duration, clock)
    volts = (volts + p.offset) * (1 + p.rate_gain * np.tanh(rate / (0.03 * scenario.omega * scenario.swing)))
    volts = volts * (1 + p.gain_drift * t / T) * (1 + p.ripple * np.sin(p.ripple_frequency * t))
    volts = volts * (1 + p.sensor_cubic * volts**2)
    volts = imperfect_gain(volts, t, p)
    volts = volts + p.tone * np.sin(p.tone_frequency * t + p.tone_phase)
    if p.feedthrough != 0.0:
        volts = volts + p.feedthrough * (command - p.drive_mean)
    for half_waves, size in enumerate((p.drift_1, p.drift_2, p.drift_3), start=1):
        volts = volts + size * np.cos(pi * half_waves * t / T)
    if p.play != 0.0:
        volts = (1 - p.play) * volts + p.play * play(volts, p.play_width)
    return volts


def interleaving(samples: int, p: Truth) -> Array:
    """Time offset of every sample over ``uneven``: a pattern of interleaved converters, of mean square one, (n,)."""
    size = int(p.uneven_pattern)
    pattern = np.sin(2 * pi * (np.arange(size) * 0.618034 + p.uneven_phase))
    pattern -= pattern.mean()
    return np.resize(pattern / np.sqrt(np.mean(pattern**2)), samples)


def imperfect_gain(volts: Array, t: Array, p: Truth) -> Array:
    """A readout curve of fifth and seventh order, a slow flutter of the gain, and a gain that follows the level."""
    if p.curve_5 != 0.0 or p.curve_7 != 0.0:
        relative = volts / p.curve_height
        volts = volts * (1 + p.curve_5 * relative**4 + p.curve_7 * relative**6)
    if p.flutter != 0.0:
        turn = p.flutter_frequency * t + p.flutter_phase
        volts = volts * (1 + p.flutter * (np.sin(turn) + 0.6 * np.sin(1.618 * turn + 1.0) + 0.4 * np.sin(2.414 * turn)))
    if p.level_gain != 0.0:
        step = (t[1] - t[0]) / p.level_tau
        level, _ = lfilter([step], [1.0, step - 1.0], volts**2, zi=[(1.0 - step) * p.level_square])
        volts = volts * (1 - p.level_gain * (level / p.level_square - 1))
    return volts


def apply_limit(volts: Array, p: Truth) -> Array:
    """The noisy voltage after the output stage, which clips it, and the converter's missing codes, (n,) [V]."""
    volts = np.minimum(np.clip(volts, -p.limit, p.limit), p.rail)
    if p.code_step == 0.0:
        return volts
    codes = np.round(volts / p.code_step)
    codes = codes - is_missing(codes, p)
    return codes * p.code_step


def is_missing(codes: Array, p: Truth) -> NDArray[np.bool_]:
    """Whether the converter lacks a code and returns the one below, (n,); the same codes in every recording."""
    mixed = (codes.astype(np.int64) * 2654435761 + int(p.code_seed)) % 4294967296
    return mixed % 65536 < 65536 * p.code_missing


def charge_voltage(p: Truth, clock: Array) -> Array:
    """Charge on the combs over time, in volts, (n,)."""
    return p.charge * -np.expm1(-np.maximum(clock, 0.0) / p.charge_tau)


def angle(theta: Array, p: Truth) -> Array:
    """The reference detector's reading of angles (n,) [rad]."""
    reading = theta * (1 + p.angle_cubic * theta**2)
    return reading - p.edge_loss * np.maximum(reading - p.edge, 0.0) if p.edge < inf else reading


@njit(cache=True)
def play(volts: Array, half_width: float) -> Array:
    """Play operator: the output follows the input at the distance of a gap (rate-independent hysteresis)."""
    out = np.empty_like(volts)
    position = volts[0]
    for i in range(len(volts)):
        position = min(max(position, volts[i] - half_width), volts[i] + half_width)
        out[i] = position
    return out


@njit(cache=True)
def _flat(theta: Array, rate: Array, section: Array, bias: Array, p: Truth) -> Array:
    out = np.empty_like(theta)
    for i in range(len(theta)):
        out[i] = flat_output(theta[i], rate[i], section[i], bias[i], p)
    return out


def digitise(volts: Array, bits: int, full_scale: float) -> Array:
    """The output of a converter with ``bits`` over ``full_scale`` [V], in volts."""
    lsb = full_scale / 2**bits
    return np.round(volts / lsb) * lsb
