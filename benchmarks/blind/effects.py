"""The effects of the catalogue in this generator: their range of sizes in each family, and the numbers of their laws.

A size is relative to the scenario, for example to the stiffness at full swing, to the signal's height or to a period.
Size zero switches the effect off. All other numbers of a law (a time constant, a phase) are its shape, drawn once.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from math import pi

import numpy as np
from numpy.typing import NDArray

from benchmarks.blind.scanner_truth import Truth
from benchmarks.blind.scenarios import Scenario

Rng = np.random.Generator
Shape = NDArray[np.float64]


@dataclass(frozen=True)
class SizeReference:
    """The scales that a relative size refers to.

    Attributes:
        scenario: the scanner and its drive.
        middle, height: middle of the noiseless sense signal's range, and half that range [V].
    """

    scenario: Scenario
    middle: float
    height: float

    @property
    def omega(self) -> float:
        """Of the motion [rad/s]."""
        return self.scenario.omega

    @property
    def drive_omega(self) -> float:
        """Of the drive: twice the motion's where combs pull [rad/s]."""
        return self.omega * (1 if self.scenario.truth.torque_per_volt else 2)


Law = Callable[[SizeReference, Truth, float, Shape], dict[str, float]]


@dataclass(frozen=True)
class Effect:
    """One effect that a nominal device leaves out.

    Attributes:
        name: as in the catalogue, or a name of this generator for an effect that no catalogue lists.
        stage: stage of the signal chain at which it acts.
        sizes: smallest and largest size, by family. Families that cannot show the effect are missing.
        law: numbers of :class:`Truth` for a size and a shape, three draws from [0, 1).
        signed: the size may be negative.
        shaped: the law has a shape, which a fit would adjust.
        needs_angle: families in which the effect shows only against a reference detector.
        parameters: by field of :class:`Truth` its name in the key and the factor to the key's unit, where they differ.
        listed: whether the effect is in the catalogue.
        also_right: names of the catalogue that describe the effect as well.
        linear_fraction: part of a size at which the change of the signal is linear in the size. 1 where none is.
        power: a small change of the signal is proportional to this power of the size.
    """

    name: str
    stage: str
    sizes: Mapping[str, tuple[float, float]]
    law: Law
    signed: bool = False
    shaped: bool = False
    needs_angle: frozenset[str] = frozenset()
    parameters: Mapping[str, tuple[str, float]] = field(default_factory=dict)
    listed: bool = True
    also_right: tuple[str, ...] = ()
    linear_fraction: float = 0.02
    power: int = 1

    @property
    def is_linear(self) -> bool:
        """Whether a small part of a size changes the signal in the same direction as the whole size."""
        return self.linear_fraction <= 0.02

    def is_visible_in(self, scenario: Scenario) -> bool:
        """Whether a recording of this scenario can show the effect."""
        return scenario.family in self.sizes and (
            scenario.family not in self.needs_angle or scenario.angle_sd is not None
        )

    def draw_size(self, family: str, rng: Rng) -> float:
        """A size drawn log-uniformly between smallest and largest."""
        low, high = self.sizes[family]
        return float(np.exp(rng.uniform(np.log(low), np.log(high)))) * (rng.choice([-1, 1]) if self.signed else 1)

    def applied_to(self, truth: Truth, reference: SizeReference, size: float, shape: Shape) -> Truth:
        """The truth with this effect."""
        return truth._replace(**self.law(reference, truth, size, shape))

    def key(self, fields: dict[str, float]) -> dict[str, float]:
        """A law's numbers by their names in the key."""
        named = {name: (*self.parameters.get(name, (name, 1.0)), value) for name, value in fields.items()}
        return {key: value * unit for key, unit, value in named.values()}


@dataclass(frozen=True)
class InjectedEffect:
    """One effect as drawn: its size, its shape and the fields of the truth that they set."""

    effect: Effect
    size: float
    shape: Shape
    fields: dict[str, float]


def all_families(low: float, high: float) -> dict[str, tuple[float, float]]:
    return {"ring": (low, high), "drive": (low, high), "tf": (low, high)}


def comb_families(low: float, high: float) -> dict[str, tuple[float, float]]:
    return {"ring": (low, high), "drive": (low, high)}


def _between(low: float, high: float, u: float) -> float:
    return float(low + (high - low) * u)


def _tau(reference: SizeReference, u: float) -> float:
    """A drift's time constant, from a sixth of the recording to all of it [s]."""
    return reference.scenario.duration * _between(0.16, 1.0, u)


def _beside_harmonics(omega: float, u: float) -> float:
    """A frequency from 0.1 to 12 times ``omega`` that is at least 0.15 ``omega`` off its multiples [rad/s]."""
    ratio = 0.1 * 120**u
    return omega * (np.floor(ratio) + 0.15 + 0.7 * (ratio % 1.0))


def _square_law(s: SizeReference, p: Truth, r: float, u: Shape) -> dict[str, float]:
    at = p.Cb + 0.6 * p.C0
    return {"square_Cp": 1e-12 / r - at, "square_at": at}


def _second_mode(s: SizeReference, p: Truth, r: float, u: Shape) -> dict[str, float]:
    ratio = _between(0.55, 0.88, 2 * u[0]) if u[0] < 0.5 else _between(1.13, 1.9, 2 * u[0] - 1)
    omega = ratio * s.omega
    return {
        "mode_frequency": omega,
        "mode_damping": omega / _between(30, 120, u[1]),
        "mode_coupling": r * s.omega**2,
    }


def _mode_coupling(s: SizeReference, p: Truth, r: float, u: Shape) -> dict[str, float]:
    # The mode at half the frequency is pumped once theta passes 2 omega_q^2 / (Q exchange), r times below the swing.
    omega, quality = 0.5 * s.omega * _between(0.998, 1.002, u[0]), _between(60, 120, u[1])
    return {
        "mode_frequency": omega,
        "mode_damping": omega / quality,
        "mode_coupling": 1e-3 * omega**2,  # invisible, but a parametric mode must start from something
        "mode_exchange": r * 2 * omega**2 / (quality * s.scenario.swing),
    }


def _offset_drift(s: SizeReference, p: Truth, r: float, u: Shape) -> dict[str, float]:
    weights = 2 * u - 1
    weights = weights / np.abs(weights).sum()
    return {f"drift_{i}": r * s.height * w for i, w in enumerate(weights, start=1)}


IN_HERTZ = {
    "drive_corner": ("f_c", 1 / (2 * pi)),
    "readout_corner": ("f_c", 1 / (2 * pi)),
    "tone_frequency": ("f", 1 / (2 * pi)),
    "mode_frequency": ("f2", 1 / (2 * pi)),
}

CATALOGUE: tuple[Effect, ...] = (
    Effect("cubic-stiffness", "mechanics", all_families(0.003, 0.1), signed=True,
           law=lambda s, p, r, u: {"k3": r * p.k / s.scenario.swing**2}),
    Effect("quadratic-stiffness", "mechanics", all_families(0.03, 0.15), signed=True,
           law=lambda s, p, r, u: {"k2": r * p.k / s.scenario.swing}),
    Effect("quintic-stiffness", "mechanics", all_families(0.003, 0.05), signed=True,
           law=lambda s, p, r, u: {"k5": r * p.k / s.scenario.swing**4}),
    Effect("quadratic-drag", "mechanics", all_families(0.2, 1.5),
           law=lambda s, p, r, u: {"b2": r * p.b / (s.scenario.swing * s.omega)}),
    Effect("cubic-damping", "mechanics", all_families(0.2, 1.5),
           law=lambda s, p, r, u: {"b3": r * p.b / s.scenario.swing**2}),
    Effect("coulomb-friction", "mechanics", all_families(0.02, 0.15),
           law=lambda s, p, r, u: {"tau_c": r * p.b * s.scenario.swing * s.omega}),
    Effect("resonance-drift", "mechanics", {"ring": (5e-4, 0.04), "drive": (5e-4, 4e-3), "tf": (5e-4, 0.04)},
           signed=True, shaped=True, parameters={"dk_tau": ("tau", 1)},
           law=lambda s, p, r, u: {"dk": r, "dk_tau": _tau(s, u[0])}),
    Effect("damping-drift", "mechanics", all_families(0.05, 0.5), signed=True, shaped=True,
           parameters={"db_tau": ("tau", 1)}, law=lambda s, p, r, u: {"db": r, "db_tau": _tau(s, u[0])}),
    Effect("viscoelastic", "mechanics", {"ring": (0.02, 0.2), "drive": (0.001, 0.008), "tf": (0.02, 0.2)}, shaped=True,
           law=lambda s, p, r, u: {"k_v": r * p.k, "tau_v": 0.2 * 30 ** float(u[0]) / s.omega}),
    Effect("second-mode", "mechanics", {"ring": (0.02, 0.15), "drive": (0.01, 0.05), "tf": (0.02, 0.15)}, shaped=True,
           parameters=IN_HERTZ, linear_fraction=0.1, power=2, law=_second_mode),
    Effect("mode-coupling", "mechanics", {"drive": (1.5, 4.0), "tf": (3.0, 6.0)}, shaped=True,
           parameters=IN_HERTZ, linear_fraction=1.0, law=_mode_coupling),
    Effect("inertia-scale", "mechanics", {"drive": (0.05, 0.3)}, signed=True, law=lambda s, p, r, u: {"scale": 1 + r}),
    Effect("comb-offset", "capacitance", comb_families(0.002, 0.015), signed=True,
           law=lambda s, p, r, u: {"theta_c": r}),
    Effect("profile-shape", "capacitance", comb_families(0.01, 0.1), signed=True, law=lambda s, p, r, u: {"shape": r}),
    Effect("drive-droop", "drive", {"drive": (0.03, 0.15)}, parameters={"droop": ("g", 1)},
           law=lambda s, p, r, u: {"droop": 1 - r}),
    Effect("drive-lag", "drive", {"drive": (0.1, 0.5), "tf": (0.1, 0.5)},
           parameters=IN_HERTZ, linear_fraction=0.6, law=lambda s, p, r, u: {"drive_corner": s.drive_omega / r}),
    Effect("charging", "drive", comb_families(0.5, 3.0), signed=True, shaped=True,
           parameters={"charge": ("V_c", 1), "charge_tau": ("tau", 1)},
           law=lambda s, p, r, u: {"charge": r, "charge_tau": _tau(s, u[0])}),
    Effect("carrier-torque", "drive", {"drive": (0.01, 0.03)},
           law=lambda s, p, r, u: {"carrier": r * 1350.0}),
    Effect("readout-lag", "readout", all_families(0.02, 0.2), needs_angle=frozenset({"ring"}),
           parameters=IN_HERTZ, linear_fraction=0.6, law=lambda s, p, r, u: {"readout_corner": s.omega / r}),
    Effect("filter-lag", "readout", {"drive": (0.05, 0.25)}, signed=True,
           parameters={"sections": ("s", 1)}, law=lambda s, p, r, u: {"sections": 1 + r}),
    Effect("square-law", "readout", {"drive": (0.055, 0.070)}, law=_square_law, parameters={"square_Cp": ("C_p", 1)}),
    Effect("feedthrough", "readout", {"drive": (0.02, 0.15), "tf": (0.02, 0.15)},
           law=lambda s, p, r, u: {"feedthrough": r * s.height / (30.0 if p.drive_mean else 2.0)}),
    Effect("offset-drift", "readout", all_families(0.03, 0.2), law=_offset_drift, shaped=True),
    Effect("gain-drift", "readout", all_families(0.05, 0.25), signed=True, parameters={"gain_drift": ("drift", 1)},
           law=lambda s, p, r, u: {"gain_drift": r}),
    Effect("saturation", "readout", all_families(0.1, 0.4),
           linear_fraction=1.0, law=lambda s, p, r, u: {"limit": s.middle + (1 - r) * s.height}),
    Effect("sensor-cubic", "readout", {"ring": (0.05, 0.2), "tf": (0.05, 0.2)}, parameters={"sensor_cubic": ("c3", 1)},
           law=lambda s, p, r, u: {"sensor_cubic": r / s.height**2}),
    Effect("interference", "readout", all_families(0.02, 0.1), shaped=True, parameters=IN_HERTZ,
           law=lambda s, p, r, u: {"tone": r * s.height, "tone_frequency": _beside_harmonics(s.omega, float(u[0])),
                                   "tone_phase": 2 * pi * float(u[1])}),
    Effect("carrier-leakage", "readout", {"drive": (0.001, 0.05)}, shaped=True,
           linear_fraction=1.0,
           law=lambda s, p, r, u: {"leak": r * (p.Cb + 0.6 * p.C0), "leak_phase": _between(0.3, 1.5, u[0])}),
    Effect("channel-delay", "timing", {"ring": (10e-6, 150e-6), "drive": (0.1e-6, 3e-6), "tf": (5e-6, 150e-6)},
           needs_angle=frozenset({"ring"}), law=lambda s, p, r, u: {"delay": r}),
    Effect("clock-skew", "timing", all_families(5e-6, 200e-6), signed=True, needs_angle=frozenset({"ring"}),
           law=lambda s, p, r, u: {"skew": r}),
    Effect("angle-nonlinearity", "optics", comb_families(0.005, 0.05), signed=True,
           needs_angle=frozenset({"ring", "drive"}), parameters={"angle_cubic": ("c3", 1)},
           law=lambda s, p, r, u: {"angle_cubic": r / s.scenario.swing**2}),
)  # fmt: skip
