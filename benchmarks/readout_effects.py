"""Effects of the readout that the picture of an imaging scan names, without angle channels.

    python -m benchmarks.readout_effects HIDDEN CLEAN [--first SEED]

Every scan has two axes on one electrode whose resonances drift. HIDDEN of them have one effect of the readout that the
device file does not state, CLEAN have none. Kind, size, scene and photon level are drawn from the seed. The improved
device of each finding then estimates the motion of a second scan of the same device from the sense signal alone. Only
the part of the diagnosis that uses the picture is run. Prints a table by kind.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable
from typing import Any

import numpy as np

from benchmarks.readout_errors import SCENES
from estimation.estimate import estimate
from estimation.optics.readout_selection import diagnose_readout
from phantoms.experiment import Experiment, simulate_experiment
from phantoms.optics import Detector
from recon.evaluation import evaluate_axis, truth_from_simulation
from recon.reference_phase import measure_reference_phase
from scanner import devices
from scanner.device import AXES, Device
from scanner.motion import Motion

DURATION_S = 0.025
DRIVE_RATE_RAD_S = 2.0 * np.pi * 27680.0
FEEDTHROUGH_UNIT = 0.0145
"""g or h at which the feedthrough is as large as the second harmonic of x in the sense signal."""

Terms = dict[str, dict[str, float]]


def _log_uniform(rng: np.random.Generator, low: float, high: float) -> float:
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))


def _feedthrough(rng: np.random.Generator) -> Terms:
    size, phase = FEEDTHROUGH_UNIT * _log_uniform(rng, 0.005, 0.03), rng.uniform(0.0, 2.0 * np.pi)
    return {"feedthrough": {"g": size * np.cos(phase), "h": size * np.sin(phase), "omega_d": DRIVE_RATE_RAD_S}}


HIDDEN: dict[str, Callable[[np.random.Generator], Terms]] = {
    "delay, 0.1 to 1.5 µs": lambda rng: {"channel-delay": {"delay": _log_uniform(rng, 0.1e-6, 1.5e-6)}},
    "pole, 0.15 to 1 MHz": lambda rng: {"readout-lag": {"f_c": _log_uniform(rng, 150e3, 1e6)}},
    "corner frequencies, 6 to 20 % off": lambda rng: {
        "filter-lag": {"s": float(np.exp(rng.choice([-1.0, 1.0]) * rng.uniform(0.06, 0.18)))}
    },
    "feedthrough, 0.5 to 3 %": _feedthrough,
}
CLASSES = {"channel-delay": "late", "readout-lag": "late", "filter-lag": "filter-lag", "feedthrough": "feedthrough"}
"""Classes of effects. A delay and a pole far above both frequencies act alike."""


def _scan(device: Device, nominal: Device, rng: np.random.Generator, seed: int) -> tuple[Any, Any]:
    experiment = Experiment(
        device=device,
        target=str(rng.choice(SCENES)),
        duration=DURATION_S,
        drift={axis: float(rng.uniform(-0.002, 0.002)) for axis in AXES},
        detector=Detector(photons_per_sample=_log_uniform(rng, 100.0, 1000.0), bits=12),
    )
    recording, truth = simulate_experiment(experiment, seed, nominal)
    return recording, truth_from_simulation(truth)


def _phase_rms(motion: Motion, truth: Any) -> list[float]:
    """Phase errors of x and y [deg]."""
    return [float(np.degrees(evaluate_axis(motion.axes[axis], *truth.angles[axis]).phase_rmse)) for axis in AXES]


def scan(seed: int, hidden: bool) -> dict[str, Any]:
    """What is hidden in one scan, what was found, and the phase errors of a second scan [deg]."""
    rng = np.random.default_rng([2204, seed])
    nominal = devices.load("imaging")
    kind = str(rng.choice(list(HIDDEN))) if hidden else "none"
    terms = HIDDEN[kind](rng) if hidden else {}
    device = nominal.with_terms({"x": terms})
    recording, _ = _scan(device, nominal, rng, seed)
    reference = measure_reference_phase(recording, nominal)
    row: dict[str, Any] = {"seed": seed, "kind": kind, "terms": terms, "found": []}
    if reference is None:
        return row | {"shown": None}
    findings, improved = diagnose_readout(reference)
    row["shown"] = np.degrees([reference.value, reference.sd]).tolist()
    row["found"] = [(f.effect, f.axis, f.probability, [r.effect for r in f.rivals]) for f in findings]
    if hidden:
        again, truth = _scan(device, nominal, rng, seed + 500_000)
        row["second"] = [_phase_rms(estimate(again, each), truth) for each in (nominal, improved)]
    return row


def is_right(row: dict[str, Any]) -> bool:
    """Whether the hidden effect, or one of its class, was found and nothing else."""
    (effect,) = row["terms"]
    return {CLASSES[found[0]] for found in row["found"]} == {CLASSES[effect]}


def is_listed(row: dict[str, Any]) -> bool:
    """Whether an effect of the hidden class was found or is listed as a rival."""
    (effect,) = row["terms"]
    listed = {name for found in row["found"] for name in (found[0], *found[3])}
    return CLASSES[effect] in {CLASSES.get(name) for name in listed}


def table(rows: list[dict[str, Any]]) -> str:
    """Markdown table by kind."""
    lines = [
        "| hidden | scans | found | class right | class right or a rival | "
        "second scan x, y, rms, median: nominal device, improved device |",
        "|---|---|---|---|---|---|",
    ]
    for kind in (*HIDDEN, "none"):
        chosen = [row for row in rows if row["kind"] == kind]
        if not chosen:
            continue
        found = sum(bool(row["found"]) for row in chosen)
        right, listed, second = "", "", ""
        if kind != "none":
            right, listed = (str(sum(map(each, chosen))) for each in (is_right, is_listed))
            median = np.median([row["second"] for row in chosen if "second" in row], axis=0)
            second = "; ".join("{:.3f}°, {:.3f}°".format(*each) for each in median)
        lines.append(f"| {kind} | {len(chosen)} | {found} | {right} | {listed} | {second} |")
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("hidden", type=int, help="number of scans with an effect")
    parser.add_argument("clean", type=int, help="number of scans without one")
    parser.add_argument("--first", type=int, default=0, help="seed of the first scan")
    args = parser.parse_args()
    rows = []
    for i in range(args.hidden + args.clean):
        rows.append(scan(args.first + i, i < args.hidden))
        print(json.dumps(rows[-1]), file=sys.stderr, flush=True)
    print(table(rows))


if __name__ == "__main__":
    main()
