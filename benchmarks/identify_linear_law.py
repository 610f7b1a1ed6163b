"""The test of the linear law in ``identify``: notes and coverage for linear resonators and with a cubic spring.

    python -m benchmarks.identify_linear_law [RECORDINGS] [--first SEED]

Half of the recordings are of linear resonators, half of resonators with a cubic stiffness that changes k by 1e-4 to 1
line widths. All are at 1 kHz with a Q of 5 to 300 and noise of 0.02 to 10 % of the largest signal: free decays of a
position sensor, or sweeps over twice the line width on both sides.
"""

from __future__ import annotations

import argparse
from dataclasses import replace

import numpy as np

from benchmarks.papers.sine import linear_axis
from estimation.diagnosis.identifiability import DISCRIMINATION_SIGMA
from estimation.identification.calibrate import Identification, identify
from estimation.least_squares import Z_95
from phantoms.forward import InitialState, Plan, simulate
from phantoms.waveforms import Constant, Sweep
from scanner.device import Axis, Device
from scanner.recording import Recording
from scanner.stages import Position

RATE, RESONANCE_HZ, LARGEST = 5e4, 1000.0, 0.05


def draw(seed: int, linear: bool) -> tuple[str, Axis, Recording]:
    """Kind of motion, the linear part of the resonator, and a recording."""
    rng = np.random.default_rng(seed)
    kind, quality = str(rng.choice(["decay", "sweep"])), float(np.exp(rng.uniform(np.log(5.0), np.log(300.0))))
    noise = 10.0 * LARGEST * 10.0 ** rng.uniform(-3.7, -1.0)
    axis = replace(linear_axis(RESONANCE_HZ, quality), readout=Position(10.0, noise))
    m = axis.require_mechanics()
    k3 = rng.choice([-1.0, 1.0]) * 10.0 ** rng.uniform(-4.0, 0.0) / quality * m.k / (0.75 * LARGEST**2)
    true = axis if linear else replace(axis, terms={"cubic-stiffness": {"k3": float(k3)}})
    seconds = round(min(max(3.0 * quality / (np.pi * RESONANCE_HZ), 0.03), 0.4), 3)
    plan, start = Plan({"x": Constant(0.0)}, seconds, RATE), InitialState(LARGEST, 0.0)
    if kind == "sweep":
        volt = LARGEST * m.b * m.resonance * 2 * np.pi / float(axis.require_drive().torque_per_volt or 0.0)
        span, seconds = min(2.0 / quality, 0.5) * RESONANCE_HZ, round(max(3.0 * seconds, 0.2), 3)
        drive = Sweep(RESONANCE_HZ - span, RESONANCE_HZ + span, seconds, volt)
        plan, start = Plan({"x": drive}, seconds, RATE), InitialState(0.0, 0.0)
    full, _ = simulate(Device("d", {"x": true}), plan, start={"x": start}, seed=seed)
    names = ["sense_x"] if kind == "decay" else ["sense_x", "drive_x"]
    return kind, axis, Recording.from_arrays({name: (full[name].read(), "V", RATE) for name in names})


def errors(axis: Axis, found: Identification) -> np.ndarray:
    """Errors of k/J and b/J in their standard deviations, shape (2,)."""
    m, values = axis.require_mechanics(), found.values["x"]
    truth = {"k_over_J": m.k / m.J, "b_over_J": m.b / m.J}
    return np.array([abs(values[key].value - value) / values[key].sd for key, value in truth.items()])


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("recordings", type=int, nargs="?", default=400)
    parser.add_argument("--first", type=int, default=93000)
    args = parser.parse_args()
    print("| resonator | motion | recordings | notes | 95 % intervals that hold k/J, b/J | both within 4.5 sd |")
    print("|---|---|---|---|---|---|")
    found: dict[tuple[str, str], list[tuple[bool, np.ndarray]]] = {}
    for seed in range(args.first, args.first + args.recordings):
        linear = seed % 2 == 0
        kind, axis, recording = draw(seed, linear)
        result = identify([recording], Device("d", {"x": axis}))
        name = "linear" if linear else "cubic stiffness"
        found.setdefault((name, kind), []).append((bool(result.nonlinear), errors(axis, result)))
    for (name, kind), rows in sorted(found.items(), reverse=True):
        z = np.array([each for _, each in rows])
        held = ", ".join(f"{share:.0%}" for share in np.mean(z < Z_95, axis=0))
        near = np.mean(np.all(z < DISCRIMINATION_SIGMA, axis=1))
        print(f"| {name} | {kind} | {len(rows)} | {sum(note for note, _ in rows)} | {held} | {near:.0%} |")


if __name__ == "__main__":
    main()
