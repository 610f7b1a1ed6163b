"""Imperfections that no catalogue lists. One is added to an injected effect and causes a small share of the misfit.

Every imperfection has a strength; :mod:`benchmarks.blind.share` scales it to the stated share.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from math import pi

import numpy as np
from numpy.typing import NDArray

from benchmarks.blind.effects import SizeReference
from benchmarks.blind.scanner_truth import Truth

Law = Callable[[SizeReference, Truth, float, NDArray[np.float64]], dict[str, float]]


@dataclass(frozen=True)
class Imperfection:
    """One imperfection.

    Attributes:
        name: for the key.
        stage: stage of the signal chain at which it acts.
        law: fields of :class:`Truth` for a reference, the truth without it, a strength, and a shape (three draws from
            [0, 1)). The change of the signal grows with the strength.
        strength: a typical strength, from which the scaling starts.
        largest: strength above which it is no small imperfection any more.
        families: in which it acts.
    """

    name: str
    stage: str
    law: Law
    strength: float
    largest: float
    families: frozenset[str] = frozenset({"ring", "drive", "tf", "imaging"})


def _curve(s: SizeReference, p: Truth, r: float, u: NDArray[np.float64]) -> dict[str, float]:
    """Fifth order, and seventh order of up to half its size."""
    return {"curve_5": r, "curve_7": r * float(u[0] - 0.5), "curve_height": abs(s.middle) + s.height}


def _flutter(s: SizeReference, p: Truth, r: float, u: NDArray[np.float64]) -> dict[str, float]:
    """Three incommensurate sines, 2 to 8 periods of the slowest over the recording."""
    frequency = 2 * pi * (2 + 6 * float(u[0])) / s.scenario.duration
    return {"flutter": r, "flutter_frequency": frequency, "flutter_phase": 2 * pi * float(u[1])}


def _level_gain(s: SizeReference, p: Truth, r: float, u: NDArray[np.float64]) -> dict[str, float]:
    """The gain follows the mean square of the last 5 to 50 periods."""
    return {
        "level_gain": r,
        "level_tau": 2 * pi / s.omega * 5 * 10 ** float(u[0]),
        "level_square": s.middle**2 + 0.5 * s.height**2,
    }


def _foreign_mode(s: SizeReference, p: Truth, r: float, u: NDArray[np.float64]) -> dict[str, float]:
    """A mode from 2.2 to 4.7 times the resonance, with a quality of 20 to 200."""
    frequency = s.omega * (2.2 + 2.5 * float(u[0]))
    quality = 20 * 10 ** float(u[1])
    return {"foreign_frequency": frequency, "foreign_damping": frequency / quality, "foreign_coupling": r * s.omega**2}


def _spring_memory(s: SizeReference, p: Truth, r: float, u: NDArray[np.float64]) -> dict[str, float]:
    return {
        "spring_memory": -r / (0.5 * s.scenario.swing**2),
        "spring_tau": s.scenario.duration * 0.1 * 5 ** float(u[0]),
    }


def _drive_memory(s: SizeReference, p: Truth, r: float, u: NDArray[np.float64]) -> dict[str, float]:
    square = 1350.0 if p.drive_mean else 2.0
    return {"drive_memory": r / square, "drive_tau": s.scenario.duration * 0.05 * 6 ** float(u[0])}


def _slip(s: SizeReference, p: Truth, r: float, u: NDArray[np.float64]) -> dict[str, float]:
    """The pivot slips from 15 to 60 % of the swing on."""
    return {"slip_stiffness": r * p.k, "slip_angle": s.scenario.swing * (0.15 + 0.45 * float(u[0]))}


def _uneven_sampling(s: SizeReference, p: Truth, r: float, u: NDArray[np.float64]) -> dict[str, float]:
    """Two to eight interleaved converters with different delays."""
    return {"uneven": r / s.omega, "uneven_pattern": float(2 + int(7 * u[0])), "uneven_phase": float(u[1])}


def _missing_codes(s: SizeReference, p: Truth, r: float, u: NDArray[np.float64]) -> dict[str, float]:
    """A coarse converter of which 10 to 40 % of the codes are missing."""
    return {"code_step": r * s.height, "code_missing": 0.1 + 0.3 * float(u[0]), "code_seed": float(int(1e6 * u[1]))}


def _rail(s: SizeReference, p: Truth, r: float, u: NDArray[np.float64]) -> dict[str, float]:
    """A limit at the upper side only."""
    return {"rail": s.middle + (1 - r) * s.height}


IMPERFECTIONS: dict[str, Imperfection] = {
    imperfection.name: imperfection
    for imperfection in (
        Imperfection("readout-curve", "readout", _curve, 0.01, 0.5),
        Imperfection("gain-flutter", "readout", _flutter, 0.005, 0.2),
        Imperfection("level-dependent-gain", "readout", _level_gain, 0.01, 0.5, frozenset({"ring", "tf"})),
        Imperfection("foreign-mode", "mechanics", _foreign_mode, 0.03, 1.0),
        Imperfection("spring-memory", "mechanics", _spring_memory, 1e-4, 0.1),
        Imperfection("drive-memory", "drive", _drive_memory, 0.005, 0.3, frozenset({"drive", "tf", "imaging"})),
        Imperfection("slipping-pivot", "mechanics", _slip, 1e-3, 0.1),
        Imperfection("uneven-sampling", "timing", _uneven_sampling, 0.005, 0.3),
        Imperfection("missing-codes", "readout", _missing_codes, 0.01, 0.3),
        Imperfection("one-sided-rail", "readout", _rail, 0.02, 0.4),
    )
}
