"""Effects that no catalogue lists, at every stage of these recordings. The right answer to each is ``unknown``."""

from __future__ import annotations

from math import pi

from benchmarks.blind.effects import Effect, Shape, SizeReference, all_families, comb_families
from benchmarks.blind.scanner_truth import Truth


def _one_sided_stop(s: SizeReference, p: Truth, r: float, u: Shape) -> dict[str, float]:
    return {"kink_stiffness": r * p.k, "kink_angle": s.scenario.swing * (0.35 + 0.35 * float(u[0]))}


def _warming_damping(s: SizeReference, p: Truth, r: float, u: Shape) -> dict[str, float]:
    return {"warming": r / (0.5 * s.scenario.swing**2), "memory": s.scenario.duration * (0.05 + 0.2 * float(u[0]))}


def _shaken_stiffness(s: SizeReference, p: Truth, r: float, u: Shape) -> dict[str, float]:
    return {"wander": r, "wander_frequency": 2 * pi * (3 + 6 * float(u[0])) / s.scenario.duration}


def _saturating_stray(s: SizeReference, p: Truth, r: float, u: Shape) -> dict[str, float]:
    angle = s.scenario.swing * (0.15 + 0.25 * float(u[0]))
    return {"parasitic": r * p.C0 / s.scenario.swing, "parasitic_angle": angle}


def _slew_limit(s: SizeReference, p: Truth, r: float, u: Shape) -> dict[str, float]:
    fastest = s.drive_omega * (30.0 if p.drive_mean else 2.0)
    return {"slew": fastest * (1 - r), "drive_corner": 80 * s.drive_omega}


def _drive_compression(s: SizeReference, p: Truth, r: float, u: Shape) -> dict[str, float]:
    return {"compression": r / (60.0 if p.drive_mean else 2.0) ** 2}


def _rate_sign_gain(s: SizeReference, p: Truth, r: float, u: Shape) -> dict[str, float]:
    return {"rate_gain": r}


def _readout_play(s: SizeReference, p: Truth, r: float, u: Shape) -> dict[str, float]:
    return {"play": 0.4 + 0.4 * float(u[0]), "play_width": r * s.height}


def _supply_ripple(s: SizeReference, p: Truth, r: float, u: Shape) -> dict[str, float]:
    return {"ripple": r, "ripple_frequency": 2 * pi * (4 + 9 * float(u[0])) / s.scenario.duration}


def _wandering_clock(s: SizeReference, p: Truth, r: float, u: Shape) -> dict[str, float]:
    return {"jitter": r / s.omega, "jitter_frequency": 2 * pi * (3 + 6 * float(u[0])) / s.scenario.duration}


def _swing_delay(s: SizeReference, p: Truth, r: float, u: Shape) -> dict[str, float]:
    return {"swing_delay": r / s.omega / (0.5 * s.scenario.swing**2), "memory": 8 * pi / s.omega}


def _spot_off_edge(s: SizeReference, p: Truth, r: float, u: Shape) -> dict[str, float]:
    return {"edge": s.scenario.swing * (0.5 + 0.2 * float(u[0])), "edge_loss": r}


SINE_STIFFNESS = Effect(
    "sine-stiffness", "mechanics", {"tf": (1.0, 1.0)}, lambda s, p, r, u: {"pendulum": r}, listed=False,
    linear_fraction=1.0, also_right=("cubic-stiffness", "quintic-stiffness", "gravity-stiffness"),
)  # fmt: skip
"""A pendulum's torque k sin(theta), which a cubic and a quintic spring describe up to about a right angle."""

OUT_OF_CATALOGUE: tuple[Effect, ...] = tuple(
    Effect(name, stage, sizes, law, needs_angle=frozenset(needs), listed=False,
           linear_fraction=1.0 if law is _slew_limit else 0.02)
    for name, stage, sizes, law, needs in (
        ("one-sided-stop", "mechanics", all_families(0.05, 0.3), _one_sided_stop, ()),
        ("warming-damping", "mechanics", all_families(0.4, 1.5), _warming_damping, ()),
        ("shaken-stiffness", "mechanics", {"ring": (2e-3, 0.01), "drive": (3e-4, 1.5e-3), "tf": (2e-3, 0.01)},
         _shaken_stiffness, ()),
        ("saturating-stray", "capacitance", comb_families(0.02, 0.12), _saturating_stray, ()),
        ("slew-limit", "drive", {"drive": (0.05, 0.25), "tf": (0.1, 0.5)}, _slew_limit, ()),
        ("drive-compression", "drive", {"drive": (0.02, 0.08), "tf": (0.1, 0.4)}, _drive_compression, ()),
        ("rate-sign-gain", "readout", {"ring": (0.03, 0.12), "drive": (0.005, 0.03), "tf": (0.03, 0.12)},
         _rate_sign_gain, ()),
        ("play-in-readout", "readout", {"ring": (0.04, 0.15), "tf": (0.03, 0.12)}, _readout_play, ()),
        ("supply-ripple", "readout", all_families(0.02, 0.1), _supply_ripple, ()),
        ("swing-dependent-delay", "timing", all_families(0.03, 0.2), _swing_delay, ("ring",)),
        ("wandering-clock", "timing", all_families(0.01, 0.08), _wandering_clock, ("ring",)),
        ("spot-off-the-edge", "optics", comb_families(0.05, 0.3), _spot_off_edge, ("ring", "drive")),
    )
)  # fmt: skip
