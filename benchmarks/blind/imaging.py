"""Two-axis imaging scans: parametric drive, one electrode or two, drifting resonances, and an intensity channel.

The scanner has the nominal constants of a published pair of mirrors on one electrode. Effects are injected into x. The
nominal device states the resonances at the start; their drift is an effect like any other and listed in the key.
"""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache
from math import inf, pi, sqrt
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.blind.motion import NODES, READOUT, SECTION_2, THETA, Trajectory, integrate
from benchmarks.blind.scanner_truth import Truth
from benchmarks.blind.scenarios import LEAD_TIME_S, Partner, Rng, Scenario, Tones, initial_states, nominal_device

Array = NDArray[np.float64]

HALF_ANGLE = 0.18
"""Of the field of view, both axes [rad]."""
PARTNER_SETTLE_TIME_S = 0.12
"""Ten time constants of the slow axis's envelope (quality 120 at 3.3 kHz) [s]."""
PHOTONS = 100.0
"""Mean photons a sample at full brightness. Their shot noise is 10 %, as in a dim fluorescence scan."""


def imaging(rng: Rng) -> Scenario:
    """A scan of 40 to 60 ms at 5 MS/s with drive frequencies near 27.68 and 6.54 kHz."""
    shared = bool(rng.random() < 0.5)
    x = _axis(1.28363e-15, rng)
    y = _axis(2.29902e-14, rng)
    offset = (9.9 if shared else 4.95) * rng.normal(1, 0.003)
    gain = -3.574e11 * rng.normal(1, 0.005)
    x, y = (p._replace(offset=offset, a_cir=gain) for p in (x, y))
    drives = [
        Tones(-1.0, 30.0, (30.0,), (f * rng.normal(1, 2e-4),), (rng.uniform(0, 2 * pi),)) for f in (27680.0, 6540.0)
    ]
    partner = Partner(y, drives[1], 0.2, shared, 2.5e6)
    return Scenario(
        family="drive",
        truth=x,
        device=_device(x, y, shared, rng),
        drive=(drives[0],),
        sample_rate=5e6,
        samples=int(rng.integers(200, 301)) * 1000,
        steps_per_second=5e6,
        initial=initial_states(0.2, 0.0, 0.2, 30.0),
        omega=pi * drives[0].frequencies[0],
        swing=0.2,
        angle_sd=None,
        full_scale=10.0,
        partner=partner,
    )


def with_partner_drift(scenario: Scenario, change: float, tau: float) -> Scenario:
    """The scenario with a drift of y's stiffness, relative, with its time constant [s]."""
    assert scenario.partner is not None
    truth = scenario.partner.truth._replace(dk=change, dk_tau=tau)
    return replace(scenario, partner=replace(scenario.partner, truth=truth))


def _axis(J: float, rng: Rng) -> Truth:
    k = 9.6e-6 * rng.normal(1, 2e-4)
    quality = 120 * rng.normal(1, 0.02)
    return Truth(
        J=J,
        b=sqrt(k * J) / quality,
        k=k,
        C0=5.71e-12 * rng.normal(1, 0.003),
        Cb=9.79e-12,
        theta0=0.2 * rng.normal(1, 0.003),
        section_1=2 * pi * 40_800,
        section_2=2 * pi * 41_100,
        drive_mean=30.0,
    )


def _device(x: Truth, y: Truth, shared: bool, rng: Rng) -> dict[str, Any]:
    """The device file's table of both axes, with a shared readout where there is one electrode."""
    readout = {
        "kind": "amdm", "a_cir": x.a_cir, "b_cir": x.offset, "lpf_hz": [40_800.0, 41_100.0],
        "noise_var": 1.92e-4, "bits": 12,
    }  # fmt: skip
    tolerance = {"k": 0.0005, "b": 0.03, "C0": 0.01, "theta0": 0.01, "a_cir": 0.02, "b_cir": 0.02}
    axes = {name: nominal_device(p, readout, tolerance, rng)["x"] for name, p in (("x", x), ("y", y))}
    table: dict[str, Any] = {"name": "blind", **axes}
    if shared:
        table["readout"] = axes["x"].pop("readout")
        axes["y"].pop("readout")
        table["tolerance"] = {name: tolerance[name] for name in ("a_cir", "b_cir")}
        for axis in axes.values():
            axis["tolerance"] = {name: tolerance[name] for name in ("k", "b", "C0", "theta0")}
    table["scan"] = {"half_angle_x": HALF_ANGLE, "half_angle_y": HALF_ANGLE}
    return table


@lru_cache(maxsize=2)
def partner_motion(partner: Partner, duration: float, sections: float, corner: float) -> Trajectory:
    """The settled motion of y over a recording, with its readout.

    Args:
        sections: factor on the corners of the demodulator. corner: of a lag behind it [rad/s].
    """
    truth = partner.truth._replace(sections=sections, readout_corner=corner)
    step = 1 / partner.steps_per_second
    start = -PARTNER_SETTLE_TIME_S - LEAD_TIME_S
    first = start + step * np.arange(round((duration + LEAD_TIME_S - start) / step))
    return integrate(
        truth, partner.drive(first[:, None] + NODES * step), start, step, initial_states(0.2, 0.0, 0.2, 30.0)
    )


def partner_output(partner: Partner, readout: Truth, duration: float, clock: Array) -> Array:
    """Output of ``readout`` for y's capacitance at times (n,), without its offset [V]."""
    motion = partner_motion(partner, duration, readout.sections, readout.readout_corner)
    if readout.readout_corner < inf:
        return motion.at(clock, READOUT)
    return readout.a_cir * motion.at(clock, SECTION_2)


def partner_angle(partner: Partner, duration: float, times: Array) -> Array:
    """y's true angle at times (n,) [rad]."""
    return partner_motion(partner, duration, 1.0, inf).at(times, THETA)


def picture(x: Array, y: Array) -> Array:
    """Brightness of the target, 0 to 1, at angles (n,) [rad]: bars, blobs and a ring, without sharp edges."""
    u, v = x / HALF_ANGLE, y / HALF_ANGLE
    bars = 0.5 * (1 + np.sin(2 * pi * (4 + 8 * np.abs(v)) * u))
    blobs = np.zeros_like(u)
    for a, b, size in ((-0.5, 0.4, 0.15), (0.3, -0.2, 0.08), (0.6, 0.6, 0.2), (-0.2, -0.6, 0.06), (0.1, 0.75, 0.05)):
        blobs = blobs + np.exp(-0.5 * ((u - a) ** 2 + (v - b) ** 2) / size**2)
    ring = np.exp(-0.5 * ((np.hypot(u, v) - 0.7) / 0.03) ** 2)
    return np.clip(0.05 + 0.35 * bars * (v < 0) + 0.6 * blobs + 0.4 * ring, 0.0, 1.0)


def intensity(x: Array, y: Array, rng: Rng) -> Array:
    """Detected light at angles (n,), with shot noise, over full brightness."""
    return rng.poisson(PHOTONS * picture(x, y)) / PHOTONS
