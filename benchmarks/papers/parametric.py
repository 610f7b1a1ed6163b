"""chen2020 II-B, fig 8: the driven branch with its hysteresis. The constants of Table II cannot oscillate."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from benchmarks.papers.figures import Results, entry, figure
from estimation.identification.fits import DrivenRecord, fit_mechanics, fit_ringdown
from phantoms.forward import InitialState, Plan, settled_state, simulate_trajectory
from phantoms.waveforms import Constant, Sequence, Sine, Sweep, Waveform
from scanner.arrays import Array
from scanner.device import Axis
from scanner.devices import load
from scanner.lock_in import block_length, block_phasors
from scanner.parametric import sine_drive, steady_state, stiffness_modulation, threshold

RATE = 5e6
HIGH, LOW = 31800.0, 31200.0
SWEEP_TIME, SWEEP_RATE = 3.0, 1e6  # s, Hz. Slow against the growth from rest, which takes 3 ms for each factor e
OFFSET = 2e-4  # rad, of the comb. Motion needs an asymmetry to start from rest
BIAS = 23.76


def sweep_branch(axis: Axis, f0: float, f1: float, duration: float = SWEEP_TIME) -> tuple[Array, Array, Array]:
    """Drive frequency [Hz], amplitude [rad] and phase against half the drive [rad, mod pi] along a swept drive."""
    drive = Sweep(f0, f1, duration, 30.0, 30.0)
    plan = Plan({"x": drive}, duration, SWEEP_RATE, substeps=1)
    offset = replace(axis, capacitance=replace(axis.require_capacitance(), theta_th=OFFSET))
    angle = simulate_trajectory(offset, plan, InitialState(0.0, 0.0), 0.0, duration).angle
    block = block_length(f0 / 2, SWEEP_RATE, 10.0)
    time, z = block_phasors(angle, SWEEP_RATE, 0.0, f0 / 2, block)
    centre = 0.5 * drive.angle(time)
    return f0 + (f1 - f0) * time / duration, np.abs(z), np.mod(np.angle(z * np.exp(-1j * centre)), np.pi)


def jump_frequency(frequency: Array, amplitude: Array) -> float:
    """Drive frequency of the largest step in amplitude [Hz]."""
    return float(frequency[np.abs(np.diff(amplitude)).argmax()])


def remaining_amplitude(axis: Axis, drive: Waveform, duration: float = 0.02) -> float:
    """Fraction of an amplitude of 0.15 rad that remains after ``duration`` under the drive."""
    plan = Plan({"x": drive}, duration, RATE, substeps=2)
    angle = simulate_trajectory(axis, plan, InitialState(0.15, 0.0), 0.0, duration).angle
    tail = angle[-round(len(angle) / 20) :]
    return float(np.abs(tail).max() / 0.15)


def inertia_estimates(axis: Axis, seed: int, noise: float = 2e-4) -> dict[str, tuple[float, float]]:
    """J from a ringdown under bias and from driven motion: value and standard deviation [kg m2]."""
    rng = np.random.default_rng(seed)
    drive = Sequence([(Sine(31480.0, 30.0, 30.0), 0.002), (Constant(BIAS), 0.02)])
    plan = Plan({"x": drive}, 0.022, RATE, substeps=2)
    angle = simulate_trajectory(
        axis, plan, settled_state(axis, Plan({"x": Sine(31480.0, 30.0, 30.0)}, 0.0)), 0.0, 0.022
    ).angle
    free = angle[round(0.002 * RATE) * 2 :: 2]
    ring, _ = fit_ringdown(free + noise * rng.standard_normal(free.size), RATE, axis, BIAS)
    records = []
    for f in (31400.0, 31500.0):
        plan = Plan({"x": Sine(f, 30.0, 30.0)}, 0.01, RATE, substeps=2)
        driven_angle = simulate_trajectory(axis, plan, settled_state(axis, plan), 0.0, 0.01).angle
        time = np.arange(driven_angle[::2].size) / RATE
        observed = driven_angle[::2] + noise * rng.standard_normal(time.size)
        records.append(DrivenRecord(observed, plan.drives["x"](time), f / 2, RATE))
    driven = fit_mechanics(axis, records)
    return {"ringdown": (ring["J"].value, ring["J"].sd), "driven": (driven["J"].value, driven["J"].sd)}


def results() -> Results:
    """Entries of ``results.json``; draws the swept branch."""
    printed, axis = load("chen2020").axis("x"), load("chen2020-driven").axis("x")
    drive = sine_drive(31400.0, 30.0, 30.0)
    down, up = sweep_branch(axis, HIGH, LOW), sweep_branch(axis, LOW, HIGH)
    branch = [f for f in np.arange(LOW, HIGH, 10.0) if steady_state(axis, sine_drive(float(f), 30.0, 30.0))]
    draw(down, up)
    seed = 8
    estimates = inertia_estimates(axis, seed)
    J = axis.require_mechanics().J
    return {
        "chen2020.parametric.table2_modulation": entry(None, stiffness_modulation(printed, drive), 1, 0),
        "chen2020.parametric.table2_threshold": entry(None, threshold(printed), 1, 0),
        "chen2020.parametric.table2_amplitude_left_after_20ms": entry(
            None,
            max(remaining_amplitude(printed, Sine(float(f), 30.0, 30.0)) for f in np.arange(31000.0, 31800.0, 50.0)),
            16,
            0,
        ),
        "chen2020.parametric.driven_modulation": entry(None, stiffness_modulation(axis, drive), 1, 0),
        "chen2020.parametric.sustained_from_hz": entry(31110.0, min(branch), len(branch), 0),
        "chen2020.parametric.sustained_to_hz": entry(31500.0, max(branch), len(branch), 0),
        "chen2020.parametric.sweep_down_jump_hz": entry(None, jump_frequency(*down[:2]), 1, 0),
        "chen2020.parametric.sweep_up_jump_hz": entry(None, jump_frequency(*up[:2]), 1, 0),
        "chen2020.parametric.largest_amplitude_rad": entry(None, float(down[1].max()), 1, 0),
        "chen2020.parametric.inertia_sd_from_ringdown": entry(None, estimates["ringdown"][1] / J, 1, seed),
        "chen2020.parametric.inertia_sd_from_driven": entry(None, estimates["driven"][1] / J, 1, seed),
    }


def draw(down: tuple[Array, Array, Array], up: tuple[Array, Array, Array]) -> None:
    with figure("chen2020_parametric", columns=2, size=(9.0, 3.2)) as axes:
        for (f, amplitude, phase), label in ((down, "down"), (up, "up")):
            moving = amplitude > 0.01
            axes[0, 0].plot(f / 1e3, amplitude, label=label)
            axes[0, 1].plot(f[moving] / 1e3, np.rad2deg(phase[moving]), ".", ms=2, label=label)
        axes[0, 0].set(xlabel="drive frequency [kHz]", ylabel="amplitude [rad]")
        axes[0, 1].set(xlabel="drive frequency [kHz]", ylabel="phase against half the drive [deg, mod 180]")
        axes[0, 0].legend(title="sweep")
