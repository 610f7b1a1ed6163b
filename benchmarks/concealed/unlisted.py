"""Effects that stand in no catalogue, at every stage that these recordings have: the right name for each is unknown."""

from __future__ import annotations

from math import pi

from benchmarks.concealed.effects import Effect, Scene, Shape, combs, everywhere
from benchmarks.concealed.scanner_truth import Truth


def _kink(s: Scene, p: Truth, r: float, u: Shape) -> dict[str, float]:
    return {"kink_stiffness": r * p.k, "kink_angle": s.world.swing * (0.35 + 0.35 * float(u[0]))}


def _warming(s: Scene, p: Truth, r: float, u: Shape) -> dict[str, float]:
    return {"warming": r / (0.5 * s.world.swing**2), "memory": s.world.duration * (0.05 + 0.2 * float(u[0]))}


def _wander(s: Scene, p: Truth, r: float, u: Shape) -> dict[str, float]:
    return {"wander": r, "wander_frequency": 2 * pi * (3 + 6 * float(u[0])) / s.world.duration}


def _stray(s: Scene, p: Truth, r: float, u: Shape) -> dict[str, float]:
    angle = s.world.swing * (0.15 + 0.25 * float(u[0]))
    return {"parasitic": r * p.C0 / s.world.swing, "parasitic_angle": angle}


def _slew(s: Scene, p: Truth, r: float, u: Shape) -> dict[str, float]:
    fastest = s.drive_omega * (30.0 if p.drive_mean else 2.0)
    return {"slew": fastest * (1 - r), "drive_corner": 80 * s.drive_omega}


def _compression(s: Scene, p: Truth, r: float, u: Shape) -> dict[str, float]:
    return {"compression": r / (60.0 if p.drive_mean else 2.0) ** 2}


def _rate(s: Scene, p: Truth, r: float, u: Shape) -> dict[str, float]:
    return {"rate_gain": r}


def _play(s: Scene, p: Truth, r: float, u: Shape) -> dict[str, float]:
    return {"play": 0.4 + 0.4 * float(u[0]), "play_width": r * s.height}


def _ripple(s: Scene, p: Truth, r: float, u: Shape) -> dict[str, float]:
    return {"ripple": r, "ripple_frequency": 2 * pi * (4 + 9 * float(u[0])) / s.world.duration}


def _jitter(s: Scene, p: Truth, r: float, u: Shape) -> dict[str, float]:
    return {"jitter": r / s.omega, "jitter_frequency": 2 * pi * (3 + 6 * float(u[0])) / s.world.duration}


def _swing_delay(s: Scene, p: Truth, r: float, u: Shape) -> dict[str, float]:
    return {"swing_delay": r / s.omega / (0.5 * s.world.swing**2), "memory": 8 * pi / s.omega}


def _edge(s: Scene, p: Truth, r: float, u: Shape) -> dict[str, float]:
    return {"edge": s.world.swing * (0.5 + 0.2 * float(u[0])), "edge_loss": r}


UNLISTED: tuple[Effect, ...] = tuple(
    Effect(name, stage, sizes, law, needs_angle=frozenset(needs), listed=False, gentle=1.0 if law is _slew else 0.02)
    for name, stage, sizes, law, needs in (
        ("one-sided-stop", "mechanics", everywhere(0.05, 0.3), _kink, ()),
        ("warming-damping", "mechanics", everywhere(0.4, 1.5), _warming, ()),
        ("shaken-stiffness", "mechanics", {"ring": (2e-3, 0.01), "drive": (3e-4, 1.5e-3), "tf": (2e-3, 0.01)}, _wander,
         ()),
        ("saturating-stray", "capacitance", combs(0.02, 0.12), _stray, ()),
        ("slew-limit", "drive", {"drive": (0.05, 0.25), "tf": (0.1, 0.5)}, _slew, ()),
        ("drive-compression", "drive", {"drive": (0.02, 0.08), "tf": (0.1, 0.4)}, _compression, ()),
        ("rate-sign-gain", "readout", {"ring": (0.03, 0.12), "drive": (0.005, 0.03), "tf": (0.03, 0.12)}, _rate, ()),
        ("play-in-readout", "readout", {"ring": (0.04, 0.15), "tf": (0.03, 0.12)}, _play, ()),
        ("supply-ripple", "readout", everywhere(0.02, 0.1), _ripple, ()),
        ("swing-dependent-delay", "timing", everywhere(0.03, 0.2), _swing_delay, ("ring",)),
        ("wandering-clock", "timing", everywhere(0.01, 0.08), _jitter, ("ring",)),
        ("spot-off-the-edge", "optics", combs(0.05, 0.3), _edge, ("ring", "drive")),
    )
)  # fmt: skip
