"""Resonance, damping and inertia from every kind of reference: error, stated standard deviation, coverage.

    python -m benchmarks.identify_references [SEEDS] [--first SEED]

A mirror at 1 kHz, Q 50, J known to 20 %, at 50 kS/s. Decays last 0.1 s; the drive sweeps from 950 to 1050 Hz in
0.4 s, 20 times the decay time. All sensors have noise of 1 % of the largest signal of the decay. One lock-in amplifier
averages 2 ms about the time of each value, the other has four low-passes of 0.5 ms, whose delay of 2 ms is in its
values.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable

import numpy as np
from scipy.signal import lfilter

from estimation.identification.calibrate import identify
from phantoms.forward import InitialState, Plan, simulate
from phantoms.waveforms import Constant, Sweep, Waveform
from scanner.device import Axis, Device
from scanner.recording import Recording
from scanner.stages import Acceleration, Drive, Mechanics, MotionSensor, Position, Velocity

RATE, RESONANCE_HZ, QUALITY, INERTIA = 5e4, 1000.0, 50.0, 1e-10
W = 2 * np.pi * RESONANCE_HZ
TRUE = Mechanics(INERTIA, INERTIA * W / QUALITY, INERTIA * W**2)
NOMINAL = Mechanics(1.2 * INERTIA, 1.2 * INERTIA * W / 30.0, 1.224 * INERTIA * W**2)
SENSORS: dict[str, tuple[MotionSensor, str]] = {
    "angle": (Position(10.0, 0.01), "rad"),
    "velocity": (Velocity(10.0 / W, 0.01), "rad/s"),
    "acceleration": (Acceleration(10.0 / W**2, 0.01), "rad/s2"),
}
LOCK_IN_HZ = 500.0
LOCK_INS = {"lock-in": None, "lock-in, 4th order": 5e-4}
"""Time constant of four low-passes [s]; None: an average over the time between two values."""
DECAY: tuple[Waveform, float, InitialState] = (Constant(0.0), 0.1, InitialState(0.1, 0.0))
SWEEP: tuple[Waveform, float, InitialState] = (Sweep(950.0, 1050.0, 0.4, 10.0), 0.4, InitialState(0.0, 0.0))


def device(mechanics: Mechanics, readout: MotionSensor) -> Device:
    return Device("mirror", {"x": Axis(mechanics, drive=Drive("linear", 1e-7), readout=readout, name="x")})


def recorded(kind: str, plan: tuple[Waveform, float, InitialState], seed: int) -> Recording:
    """A recording with the reference of that kind, and the drive where it oscillates."""
    drive, seconds, start = plan
    sensor, unit = SENSORS["angle" if kind in LOCK_INS else kind]
    full, _ = simulate(device(TRUE, sensor), Plan({"x": drive}, seconds, RATE), start={"x": start}, seed=seed)
    values = full["sense_x"].read() / sensor.gain
    if kind not in LOCK_INS:
        channels = {f"{kind}_x": (values, unit, RATE)}
    else:
        channels = lock_in(2j * values * np.exp(-1j * W * full["sense_x"].time()), LOCK_INS[kind])
    if plan is SWEEP:
        channels["drive_x"] = (full["drive_x"].read(), "V", RATE)
    return Recording.from_arrays(channels)


def lock_in(mixed: np.ndarray, time_constant: float | None) -> dict[str, tuple]:
    """Amplitude and phase channels of a demodulated signal (n,), as ``LOCK_INS`` says."""
    length = round(RATE / LOCK_IN_HZ)
    if time_constant is None:
        values, first = mixed.reshape(-1, length).mean(axis=1), 0.5 * (length - 1) / RATE
    else:
        pole = np.exp(-1.0 / (RATE * time_constant))
        for _ in range(4):
            mixed = lfilter([1.0 - pole], [1.0, -pole], mixed)
        values, first = mixed[length - 1 :: length], (length - 1) / RATE
    about = (LOCK_IN_HZ, first, {"reference": RESONANCE_HZ})
    return {"amplitude_x": (np.abs(values), "rad", *about), "phase_x": (np.angle(values), "rad", *about)}


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("seeds", type=int, nargs="?", default=40)
    parser.add_argument("--first", type=int, default=7400)
    args = parser.parse_args()
    print("| reference | motion | error of f0, its sd | error of Q, its sd | error of J, its sd | in 95 % of f0, Q |")
    print("|---|---|---|---|---|---|")
    for kind in (*SENSORS, *LOCK_INS):
        for name, plan in (("decay", DECAY), ("sweep", SWEEP)):
            results = [
                identify([recorded(kind, plan, seed)], device(NOMINAL, Position(1.0, 0.0))).values["x"]
                for seed in range(args.first, args.first + args.seeds)
            ]
            print(f"| `{kind}` | {name} | {_row(results, name)} |")


def _row(results: list[dict], name: str) -> str:
    """Root-mean-square errors and mean standard deviations in percent, and the coverage."""
    true = {"k_over_J": W**2, "b_over_J": W / QUALITY, "J": INERTIA}
    scales: dict[str, Callable[[float], float]] = {
        "k_over_J": lambda x: 50.0 * x, "b_over_J": lambda x: 100.0 * x, "J": lambda x: 100.0 * x
    }  # fmt: skip
    cells, inside = [], []
    for key, value in true.items():
        if key == "J" and name == "decay":
            cells.append("not determined")
            continue
        relative = np.array([result[key].value / value - 1.0 for result in results])
        sd = np.array([result[key].sd / value for result in results])
        error, stated = scales[key](float(np.sqrt(np.mean(relative**2)))), scales[key](float(sd.mean()))
        cells.append(f"{error:.2g} %, {stated:.2g} %")
        if key != "J":
            inside.append(f"{np.mean(np.abs(relative) < 1.96 * sd):.0%}")
    return " | ".join([*cells, ", ".join(inside)])


if __name__ == "__main__":
    main()
