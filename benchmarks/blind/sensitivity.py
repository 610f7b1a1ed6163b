"""Channels in units of their noise, and their derivatives by all that a fit of the nominal device adjusts."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from math import pi

import numpy as np
from numpy.typing import NDArray
from scipy.fft import dct, idct

from benchmarks.blind.effects import InjectedEffect, SizeReference
from benchmarks.blind.motion import RATE, THETA, Trajectory
from benchmarks.blind.noise import Noise
from benchmarks.blind.readout import apply_limit, channels_of_motion
from benchmarks.blind.scanner_truth import Truth
from benchmarks.blind.scenarios import Scenario

Array = NDArray[np.float64]
Change = Callable[..., Array]

UNSTATED_TOLERANCE = 0.02
"""Relative uncertainty of a nominal value without a stated tolerance (the file format's rule), and of the gain of the
reference angle, whose calibration no device file states."""
START_SD = 0.1
"""Standard deviation of the unknown initial state, relative to the swing. A start is visible in the signal to better
than this; the prior only keeps the projection well conditioned."""
NOMINAL = {
    **{name: name for name in ("J", "b", "k", "torque_per_volt", "C0", "Cb", "theta0", "R_s", "a_cir", "gain")},
    "b_cir": "offset",
    "lpf_hz": "sections",
}
"""Name in the device file -> field of :class:`Truth`."""


def channels_in_sigma(noise: Noise, scenario: Scenario, truth: Truth, motion: Trajectory, whiten: bool = True) -> Array:
    """All measured channels in units of their noise's standard deviation, concatenated, (n,); optionally whitened."""
    channels = channels_of_motion(scenario, truth, motion)
    volts = apply_limit(channels["sense_x"], truth)
    n = scenario.samples
    if whiten and noise.is_coloured:
        # A cosine transform: a Fourier transform would make a drift end in a step, which is far easier to detect.
        frequency = np.arange(n) * scenario.sample_rate / (2 * n)
        density = noise.density(frequency, scenario.sample_rate / n)
        volts = idct(dct(volts, norm="ortho") / np.sqrt(density), norm="ortho")
    white = [volts / noise.sd]
    if scenario.angle_sd is not None:
        white.append(channels["angle_x"] / scenario.angle_sd)
    return np.concatenate(white)


def with_effects(reference: SizeReference, injected: Iterable[InjectedEffect]) -> Truth:
    """The reference scanner with these effects."""
    truth = reference.scenario.truth
    for h in injected:
        truth = h.effect.applied_to(truth, reference, h.size, h.shape)
    return truth


def unprojected_norm(gram: Array, i: int, projected: list[int]) -> float:
    """Length of column i after projection off the span of the ``projected`` columns; their priors are in ``gram``."""
    scale = np.sqrt(np.diag(gram)[projected])
    scale[scale == 0] = 1.0
    inner = gram[np.ix_(projected, projected)] / np.outer(scale, scale)
    outer = gram[i, projected] / scale
    return float(np.sqrt(max(gram[i, i] - outer @ np.linalg.pinv(inner, rcond=1e-11, hermitian=True) @ outer, 0.0)))


def nuisance_columns(
    reference: SizeReference, noise: Noise, scenario: Scenario, truth: Truth, change: Change, here: Array
) -> Iterator[tuple[Array, float]]:
    """Columns of all that a fit of the nominal device adjusts, in units of its tolerance.

    Args:
        reference: scales of the scenario.
        noise: whose hum a fit would adjust too.
        scenario, truth: the point of linearisation.
        change: difference of the channels for another truth and scenario, divided by a step.
        here: channels at the point of linearisation, (n,).

    Yields:
        a column, (n,), and the weight of its prior: 1 for one, 0 for none.
    """
    stated: dict[str, float] = scenario.tolerance
    for name, field in NOMINAL.items():
        if value := getattr(truth, field):
            moved: dict[str, float] = {field: value * (1 + 0.01 * stated.get(name, UNSTATED_TOLERANCE))}
            yield change(truth._replace(**moved), 0.01), 1.0
    for state, size in ((THETA, scenario.swing), (RATE, scenario.swing * scenario.omega)):
        initial = scenario.initial.copy()
        initial[state] += 1e-4 * size
        yield change(truth, 1e-4 / START_SD, replace(scenario, initial=initial)), 1.0
    yield change(truth._replace(offset=truth.offset + 1e-3 * reference.height), 1e-3), 0.0
    t = scenario.times
    angle = here[scenario.samples :]
    silent = np.zeros(angle.size)
    if angle.size:
        yield np.concatenate([np.zeros(t.size), UNSTATED_TOLERANCE * angle]), 1.0
        yield np.concatenate([np.zeros(t.size), np.ones(t.size)]), 0.0
    for harmonic in range(1, len(noise.hum) + 1):
        turn = 2 * pi * noise.mains * harmonic * t
        for wave in (np.sin(turn), np.cos(turn)):
            yield np.concatenate([wave, silent]), 0.0
