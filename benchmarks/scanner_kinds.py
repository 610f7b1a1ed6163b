"""Drifting resonances in simulated scans of every kind of scanner, as the diagnosis names them.

    python -m benchmarks.scanner_kinds SCANS [--first SEED] [--kinds KIND ...]

The devices are those of ``lissajous new-device``, driven so that both axes fill the field, with a sense or position
signal, the drives and an intensity. The stiffness of each axis drifts by 0.02 to 0.2 %, of either sign, or not at all.
An axis whose Q is below 10 hardly shows a drift. Prints a row for each scan.
"""

from __future__ import annotations

import argparse
import time

import numpy as np

from estimation.complete_diagnosis import diagnose_with_optics
from phantoms.experiment import Experiment, simulate_experiment
from phantoms.optics import Detector
from phantoms.waveforms import Sine
from scanner.device import AXES, Device
from scanner.device_templates import new_device
from scanner.recording import Recording
from scanner.steady_drive import steady_drive

DURATION_S_RATE_HZ = {
    "electromagnetic": (0.06, 7e5),
    "piezo": (0.04, 2e6),
    "fibre": (0.25, 2e5),
    "galvo": (0.05, 1e6),
    "parametric": (0.04, 2e6),
}
"""Duration and sampling rate by kind: some dozen periods of the slower axis, some hundred samples of the faster one."""

DRIFTS = (2e-4, 2e-3)
"""Least and largest relative change of a stiffness."""

SHARE_DRIFTING = 0.7
"""Probability that an axis drifts."""


def experiment_of_kind(
    kind: str, drift: dict[str, float], drift_tau: float, target: str = "immunohistochemistry"
) -> Experiment:
    """A scan of a target by a scanner of a kind that fills its field.

    Args:
        drift: relative change of each axis's stiffness.
        drift_tau: its time constant, relative to the duration.
    """
    device = Device.from_toml(new_device(kind, {}))
    half_angles = dict(zip(AXES, device.require_scan().mechanical_half_angles, strict=True))
    duration, rate = DURATION_S_RATE_HZ[kind]
    return Experiment(
        device=device,
        target=target,
        drives={name: Sine(*steady_drive(axis, half_angles[name])) for name, axis in device.axes.items()},
        duration=duration,
        sample_rate=rate,
        drift=drift,
        drift_tau=drift_tau * duration,
        detector=Detector(photons_per_sample=1000.0, bits=12),
    )


def simulate_scan(kind: str, seed: int) -> tuple[Recording, dict[str, float]]:
    """A scan and the relative change of each axis's stiffness."""
    rng, drift = np.random.default_rng([41, seed, len(kind)]), {}
    for axis in AXES:
        size = float(rng.choice([-1, 1]) * np.exp(rng.uniform(*np.log(DRIFTS))))
        drift[axis] = size if rng.random() < SHARE_DRIFTING else 0.0
    target = str(rng.choice(["immunohistochemistry", "retina", "cell"]))
    return simulate_experiment(experiment_of_kind(kind, drift, float(rng.uniform(0.3, 1.0)), target), seed)[0], drift


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scans", type=int, help="of each kind")
    parser.add_argument("--first", type=int, default=0, help="seed of the first scan")
    parser.add_argument("--kinds", nargs="+", default=list(DURATION_S_RATE_HZ), choices=list(DURATION_S_RATE_HZ))
    args = parser.parse_args()
    print("| kind | seed | drift of x, y | named (probability) | processor time, s |\n|---|---|---|---|---|")
    for kind in args.kinds:
        for seed in range(args.first, args.first + args.scans):
            recording, drift = simulate_scan(kind, seed)
            began = time.process_time()
            found = diagnose_with_optics([recording]).findings
            seconds = time.process_time() - began
            named = ", ".join(f"{each.axis} {each.effect} ({each.probability:.2f})" for each in found) or "nothing"
            drifts = ", ".join(f"{100.0 * drift[axis]:.3f} %" for axis in AXES)
            print(f"| {kind} | {seed} | {drifts} | {named} | {seconds:.0f} |", flush=True)


if __name__ == "__main__":
    main()
