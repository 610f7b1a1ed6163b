"""chen2020 IV-A, fig 7, and chen2019 IV-B, fig 4: device constants from ringdown and sweep, with their intervals.

Each draw adds new noise to the same motion. The identification does not use the true device.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from benchmarks.papers.figures import Results, entry, figure
from benchmarks.papers.threshold import sensing_axis
from estimation.identification.agreement import IdentifiedValue
from estimation.identification.capacitance_profile import fit_capacitance_profile
from estimation.identification.fits import (
    DrivenRecord,
    fit_mechanics,
    fit_ringdown,
)
from phantoms.forward import InitialState, Plan, settled_state, simulate_trajectory
from phantoms.waveforms import Constant, Sine
from scanner.arrays import Array
from scanner.device import Axis
from scanner.devices import load
from scanner.forward_model import sense_signal
from scanner.laws import capacitance

DRAWS, SEED = 40, 7
PSD_NOISE = 2e-4
DELAY = 57  # samples of 500 kHz: the paper's 0.114 ms between position detector and sense signal
DECAY_RATE = 500e3


def decay(axis: Axis) -> tuple[Array, Array]:
    """Noiseless ringdown of the chen2019 device: angle [rad] and sense [V]."""
    plan = Plan({"x": Constant(10.0)}, 0.08, DECAY_RATE, substeps=4)
    path = simulate_trajectory(axis, plan, InitialState(0.15, 0.0), 0.0, 0.08)
    return path.angle[:-1:4], sense_signal(axis.require_readout(), [path])[:-1:4]


def driven(axis: Axis) -> list[DrivenRecord]:
    """Noiseless driven motion of the chen2020 device at four frequencies."""
    records = []
    for f in (31400.0, 31460.0, 31520.0, 31580.0):
        plan = Plan({"x": Sine(f, 30.0, 30.0)}, 0.004, 5e6, substeps=4)
        angle = simulate_trajectory(axis, plan, settled_state(axis, plan), 0.0, 0.004).angle
        records.append(DrivenRecord(angle[:-1:4], plan.drives["x"](np.arange(20000) / 5e6), f / 2, 5e6))
    return records


def interval_coverage(
    draws: Sequence[Mapping[str, IdentifiedValue]], truth: Mapping[str, float], paper: str, seed: int
) -> Results:
    """By constant: mean error, standard deviation, and how often the 95 % interval contains the truth."""
    out: Results = {}
    for key, value in truth.items():
        values = np.array([d[key].value for d in draws])
        inside = float(np.mean([d[key].ci95[0] <= value <= d[key].ci95[1] for d in draws]))
        size = abs(value) or 1.0
        out[f"{paper}.{key}.error"] = entry(
            0.0, (values.mean() - value) / size, len(draws), seed, sd=values.std() / size
        )
        out[f"{paper}.{key}.coverage"] = entry(0.95, inside, len(draws), seed)
    return out


def results() -> Results:
    """Entries of ``results.json``; draws the papers' figs 7 and 4."""
    slow, fast = sensing_axis(), load("chen2020-driven").axis("x")
    angle, sense = decay(slow)
    m, comb = slow.require_mechanics(), slow.require_capacitance()
    nominal = replace(
        slow,
        mechanics=replace(m, k=m.k * 1.004, b=m.b * 0.9),
        capacitance=replace(comb, C0=1.1 * comb.C0, theta0=0.9 * comb.theta0, theta_th=0.0),
    )
    rings, bells, drives = [], [], []
    records = driven(fast)
    for i in range(DRAWS):
        rng = np.random.default_rng(SEED + i)
        noisy_angle = angle + PSD_NOISE * rng.standard_normal(angle.size)
        rings.append(fit_ringdown(noisy_angle, DECAY_RATE, replace(nominal, capacitance=comb), 10.0)[0])
        noisy_sense = sense + 0.0435 * rng.standard_normal(sense.size)
        bells.append(
            fit_capacitance_profile(
                nominal, noisy_angle[DELAY:], noisy_sense[:-DELAY], DECAY_RATE, slow.resonance
            ).values
        )
        noisy_records = [replace(r, angle=r.angle + PSD_NOISE * rng.standard_normal(r.angle.size)) for r in records]
        drives.append(fit_mechanics(fast, noisy_records))
    draw(noisy_angle, noisy_sense, slow)
    truth = {"theta0": comb.theta0, "theta_th": comb.theta_th, "C0": comb.C0, "delay": DELAY / DECAY_RATE}
    f = fast.require_mechanics()
    return {
        **interval_coverage(rings, {"k_over_J": m.k / m.J, "b_over_J": m.b / m.J, "J": m.J}, "chen2019.ringdown", SEED),
        **interval_coverage(bells, truth, "chen2019.profile", SEED),
        **interval_coverage(drives, {"J": f.J, "b": f.b, "k": f.k}, "chen2020.driven", SEED),
    }


def draw(angle: Array, sense: Array, axis: Axis) -> None:
    """The decay with its fitted envelope, and the capacitance from the integrated sense signal over the angle."""
    values, residual = fit_ringdown(angle, DECAY_RATE, axis, 10.0)
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
        first = slice(0, 1600)  # two cycles, over which the integrated noise is still small
        axes[0, 1].plot(angle[first], 1e12 * (charge[first] - charge[first].mean() + C[first].mean()), ",")
        order = np.argsort(angle[first])
        axes[0, 1].plot(angle[first][order], 1e12 * C[first][order], "k", lw=0.8)
        axes[0, 1].set(xlabel="angle [rad]", ylabel="capacitance [pF]")
        axes[0, 0].legend(fontsize=7)
