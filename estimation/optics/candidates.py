"""The optics effects that are searched for: every optics term of the catalogue, linearised in the measured parameters.

Terms from users' files are included. A term of the intensity is applied to constant light, which gives the change of
the gain over time, and to light that grows in proportion to time, which gives the delay. A term of the position is
applied to a sinusoidal motion.
"""

from __future__ import annotations

from collections.abc import Container, Mapping
from dataclasses import dataclass

import numpy as np

from estimation.optics.measurement import MAX_PHASE_ERROR_RAD, MEASURED_PARAMETERS
from estimation.optics.samples import OpticsParameters, ScanSamples
from scanner.active_terms import ActiveTerm
from scanner.arrays import Array
from scanner.device import AXES
from scanner.optics import apply_terms
from scanner.terms import NaturalScales, Term, catalogue
from scanner.terms.term import AMPLITUDE_KINDS

SAME_DIRECTION = ("detector-lag",)
"""Effects whose direction is that of another one: a lag is distinguished from ``intensity-delay`` by a second fit."""

PROBE_SAMPLES = 16_384
"""Samples over the recording at which a term is evaluated."""

PROBE_PERIODS = 256
"""Periods of the motion at which a term of the position is evaluated, 64 samples each."""

MIN_CONTRIBUTION = 0.02
"""Share of a term's rms effect below which its component along a measured parameter is neglected. Components of terms
that change no measured parameter are below 1/PROBE_PERIODS."""


@dataclass(frozen=True)
class OpticsEffect:
    """A hypothesis about the optics: a direction in the space of the measured parameters.

    Attributes:
        name: of the effect in the catalogue, ``"detector-delay"`` for a late detector of one axis's motion, or
            ``"phase"`` for a phase error of one axis whose motion follows from another signal.
        axis: that it is reported for.
        direction: change of each measured parameter with a unit of the effect's amplitude. Empty for an effect that
            changes none of them and cannot be detected.
        size: prior standard deviation of the amplitude. The first parameter of the term is amplitude / size in prior
            standard deviations.
    """

    name: str
    axis: str
    direction: OpticsParameters
    size: float


def candidate_effects(
    scan: ScanSamples, rates: Mapping[str, float], detectors: Container[str] = ()
) -> list[OpticsEffect]:
    """All optics effects of the catalogue, and a phase error of each axis.

    Effects on the intensity are reported for axis x, effects on the position for each axis.

    Args:
        rates: angular frequency of each axis [rad/s].
        detectors: axes whose motion is measured by a detector of their own.
    """
    terms = [term for term in catalogue().values() if term.stage == "optics" and term.effect not in SAME_DIRECTION]
    effects = [_linearise(term, "x", scan, rates) for term in terms if "intensity" in term.channels]
    for axis in AXES:
        effects += [_linearise(term, axis, scan, rates) for term in terms if "place" in term.channels]
        name = "detector-delay" if axis in detectors else "phase"
        effects.append(OpticsEffect(name, axis, {f"delay_{axis}": 1.0}, MAX_PHASE_ERROR_RAD / rates[axis]))
    return [effect for effect in effects if effect is not None]


def optics_scales(scan: ScanSamples, axis: str, rates: Mapping[str, float]) -> NaturalScales:
    """Natural sizes of one axis of a scan, of which the optics use amplitude, rate and duration."""
    return NaturalScales(scan.half_swing[axis], rates[axis], 1.0, 1.0, 1.0, scan.duration)


def _linearise(term: Term, axis: str, scan: ScanSamples, rates: Mapping[str, float]) -> OpticsEffect | None:
    """The direction of a term at its natural size; None if its first parameter is not the size of the effect."""
    if not term.parameters or term.parameters[0].kind not in AMPLITUDE_KINDS:
        return None
    scales = optics_scales(scan, axis, rates)
    x = [float(parameter is term.parameters[0]) for parameter in term.free_parameters]
    if "intensity" in term.channels:
        active = ActiveTerm(term, term.values(x, scales), "intensity")
        change = _intensity_direction(active, scan.duration)
    else:
        active = ActiveTerm(term, term.values(x, scales), "place")
        change = _position_direction(active, axis, scales)
    size = max((abs(value) for value in change.values()), default=0.0)
    return OpticsEffect(term.effect, axis, {name: value / size for name, value in change.items()}, size)


def _intensity_direction(active: ActiveTerm, duration: float) -> dict[str, float]:
    """Changes of the measured parameters by a term of the intensity."""
    time = duration / PROBE_SAMPLES * np.arange(PROBE_SAMPLES, dtype=np.float64)
    middle = slice(PROBE_SAMPLES // 8, -PROBE_SAMPLES // 8)  # without transients, and samples that a delay runs out of
    gain, ramp = (apply_terms([active], light, time)[middle] for light in (np.ones(PROBE_SAMPLES), time))
    if not np.all(gain > 0.0):
        return {}
    elapsed = time[middle] / duration - 0.5
    decay = -float(np.polyfit(elapsed, np.log(gain), 1)[0])
    growth, delay = (float(value) for value in np.polyfit(elapsed, time[middle] - ramp / gain, 1))
    change = {"decay": decay} if abs(decay) > 1e-9 else {}
    for axis in AXES:
        change |= {f"delay_{axis}": delay} if abs(delay) > 1e-9 * duration else {}
        change |= {f"delay_growth_{axis}": growth} if abs(growth) > 1e-9 * duration else {}
    return change


def _position_direction(active: ActiveTerm, axis: str, scales: NaturalScales) -> dict[str, float]:
    """Changes of the measured parameters by a term of the position, from a fit to its effect on a sinusoidal motion."""
    count = 64 * PROBE_PERIODS
    elapsed = np.arange(count) / count
    phase = 2.0 * np.pi * PROBE_PERIODS * elapsed
    rate = 2.0 * np.pi * PROBE_PERIODS / scales.duration
    position, speed = np.sin(phase), rate * np.cos(phase)
    effect = apply_terms([active], scales.amplitude * position, scales.duration * elapsed) / scales.amplitude - position
    middle = slice(count // 8, -count // 8)
    columns: dict[str, Array] = {
        f"delay_{axis}": -speed,
        f"delay_growth_{axis}": -(elapsed - 0.5) * speed,
        f"amplitude_growth_{axis}": (elapsed - 0.5) * position,
        f"drift_{axis}": -elapsed,
        "offset": np.ones(count),
        "gain": position,
    }
    basis = np.stack([column[middle] for column in columns.values()], axis=1)
    norm = np.sqrt(np.mean(basis**2, axis=0))
    contribution = np.linalg.lstsq(basis / norm, effect[middle], rcond=None)[0]
    threshold = MIN_CONTRIBUTION * float(np.sqrt(np.mean(effect[middle] ** 2)))
    return {
        name: float(value / size)
        for name, value, size in zip(columns, contribution, norm, strict=True)
        if name in MEASURED_PARAMETERS and abs(value) > threshold
    }
