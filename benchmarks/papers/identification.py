"""chen2020 IV-A, fig 7, and chen2019 IV-B, fig 4: constants from ringdown and sweep, and their intervals.

Each draw is a new set of noises on the same motion; the identified numbers never see the true device.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from benchmarks.papers.figures import Results, entry, figure
from benchmarks.papers.threshold import sensing_axis
from estimation.identify import Driven, Value, mechanics_from_driven, profile, ringdown
from phantoms.forward import Plan, Start, settled, trajectory
from phantoms.waveforms import Constant, Sine
from scanner.device import Axis
from scanner.devices import load
from scanner.laws import capacitance
from scanner.response import sense

Array = NDArray[np.float64]

DRAWS, SEED = 40, 7
PSD_NOISE = 2e-4
DELAY = 57  # samples of 500 kHz: the paper's 0.114 ms between position detector and sense signal
DECAY_RATE = 500e3


def decay(axis: Axis) -> tuple[Array, Array]:
    """Noiseless ringdown of the chen2019 device: angle [rad] and sense [V]."""
    plan = Plan({"x": Constant(10.0)}, 0.08, DECAY_RATE, substeps=4)
    path = trajectory(axis, plan, Start(0.15, 0.0), 0.0, 0.08)
    return path.angle[:-1:4], sense(axis.require_readout(), [path])[:-1:4]


def driven(axis: Axis) -> list[Driven]:
    """Noiseless driven motion of the chen2020 device at four frequencies."""
    records = []
    for f in (31400.0, 31460.0, 31520.0, 31580.0):
        plan = Plan({"x": Sine(f, 30.0, 30.0)}, 0.004, 5e6, substeps=4)
        angle = trajectory(axis, plan, settled(axis, plan), 0.0, 0.004).angle
        records.append(Driven(angle[:-1:4], plan.drives["x"](np.arange(20000) / 5e6), f / 2, 5e6))
    return records


def held(draws: Sequence[Mapping[str, Value]], truth: Mapping[str, float], paper: str, seed: int) -> Results:
    """Of each constant: the mean error, the spread and how often the 95 % interval holds the truth."""
    out: Results = {}
    for key, value in truth.items():
        found = np.array([d[key].value for d in draws])
        inside = float(np.mean([d[key].ci95[0] <= value <= d[key].ci95[1] for d in draws]))
        size = abs(value) or 1.0
        out[f"{paper}.{key}.error"] = entry(0.0, (found.mean() - value) / size, len(draws), seed, sd=found.std() / size)
        out[f"{paper}.{key}.coverage"] = entry(0.95, inside, len(draws), seed)
    return out


def results() -> Results:
    """Entries of ``results.json``, and the papers' figs 7 and 4."""
    slow, fast = sensing_axis(), load("chen2020-driven").axis("x")
    angle, sense = decay(slow)
    m, comb = slow.require_mechanics(), slow.require_capacitance()
    off = replace(
        slow,
        mechanics=replace(m, k=m.k * 1.004, b=m.b * 0.9),
        capacitance=replace(comb, C0=1.1 * comb.C0, theta0=0.9 * comb.theta0, theta_th=0.0),
    )
    rings, bells, drives = [], [], []
    records = driven(fast)
    for i in range(DRAWS):
        rng = np.random.default_rng(SEED + i)
        seen = angle + PSD_NOISE * rng.standard_normal(angle.size)
        rings.append(ringdown(seen, DECAY_RATE, replace(off, capacitance=comb), 10.0)[0])
        noisy = sense + 0.0435 * rng.standard_normal(sense.size)
        bells.append(profile(off, seen[DELAY:], noisy[:-DELAY], DECAY_RATE, slow.resonance).values)
        moved = [replace(r, angle=r.angle + PSD_NOISE * rng.standard_normal(r.angle.size)) for r in records]
        drives.append(mechanics_from_driven(fast, moved))
    draw(seen, noisy, slow)
    truth = {"theta0": comb.theta0, "theta_th": comb.theta_th, "C0": comb.C0, "delay": DELAY / DECAY_RATE}
    f = fast.require_mechanics()
    return {
        **held(rings, {"k_over_J": m.k / m.J, "b_over_J": m.b / m.J, "J": m.J}, "chen2019.ringdown", SEED),
        **held(bells, truth, "chen2019.profile", SEED),
        **held(drives, {"J": f.J, "b": f.b, "k": f.k}, "chen2020.driven", SEED),
    }


def draw(angle: Array, sense: Array, axis: Axis) -> None:
    """The decay with its fitted envelope, and the capacitance from the integrated sense signal over the angle."""
    values, residual = ringdown(angle, DECAY_RATE, axis, 10.0)
    time = np.arange(angle.size) / DECAY_RATE
    comb, readout = axis.require_capacitance(), axis.require_readout()
    with figure("chen2019_fig4", columns=2, size=(9.0, 3.2)) as axes:
        axes[0, 0].plot(1e3 * time, angle, lw=0.5, label="measured")
        axes[0, 0].plot(
            1e3 * time, 0.15 * np.exp(-0.5 * values["b_over_J"].value * time), "k", lw=0.8, label="fitted decay"
        )
        axes[0, 0].set(xlabel="time [ms]", ylabel="angle [rad]", title=f"residual {1e3 * residual.std():.2f} mrad")
        charge = np.cumsum(sense) / DECAY_RATE / (-readout.R_s * readout.V_bias)  # type: ignore[union-attr]
        C = capacitance(angle, comb.C0, comb.Cb, comb.theta0, comb.theta_th)
        first = slice(0, 1600)  # two cycles: the integral of noise has not yet wandered off
        axes[0, 1].plot(angle[first], 1e12 * (charge[first] - charge[first].mean() + C[first].mean()), ",")
        order = np.argsort(angle[first])
        axes[0, 1].plot(angle[first][order], 1e12 * C[first][order], "k", lw=0.8)
        axes[0, 1].set(xlabel="angle [rad]", ylabel="capacitance [pF]")
        axes[0, 0].legend(fontsize=7)
