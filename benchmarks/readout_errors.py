"""Phase error and its stated uncertainty when the readout is not what the device file states.

    python -m benchmarks.readout_errors SCANS [--first SEED] [--photons LEAST MOST] [--json FILE]

Every scan has two axes on one electrode whose resonances drift, and none, one or two imperfections of the readout that
the device file does not state. Kind, size, scene and photon level are drawn from the seed. Prints a table by kind.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy import signal

from phantoms.experiment import Experiment, simulate_experiment
from phantoms.optics import Detector
from recon.evaluation import truth_from_simulation
from recon.imaging.blur import compare_with_scene
from recon.imaging.gridding import map_samples
from recon.pipeline import reconstruct
from recon.report.summary import summarise
from recon.steps.reconstruction import Options
from scanner.arrays import Array
from scanner.recording import Recording

SCENES = ("immunohistochemistry", "retina", "cell", "microaneurysms")
DURATION_S = 0.04
Imperfection = Callable[[Array, Array, float, np.random.Generator], Array]


def delayed(sense: Array, drive: Array, rate: float, rng: np.random.Generator) -> Array:
    """A delay of cables and converters, 0.1 to 1.5 µs."""
    frequency = np.fft.rfftfreq(2 * sense.size, 1.0 / rate)
    mirrored = np.concatenate([sense, sense[::-1]])
    turned = np.fft.rfft(mirrored) * np.exp(-2j * np.pi * frequency * rng.uniform(0.1e-6, 1.5e-6))
    return np.fft.irfft(turned)[: sense.size]


def low_passed(sense: Array, drive: Array, rate: float, rng: np.random.Generator) -> Array:
    """A first-order pole of an amplifier, 150 kHz to 1 MHz."""
    decay = np.exp(-2.0 * np.pi * np.exp(rng.uniform(np.log(150e3), np.log(1e6))) / rate)
    return np.asarray(signal.lfilter([1.0 - decay], [1.0, -decay], sense - sense[0])) + sense[0]


def with_feedthrough(sense: Array, drive: Array, rate: float, rng: np.random.Generator) -> Array:
    """Drive voltage of one axis on the electrode, 0.2 to 1 % of the signal, of either sign."""
    share = rng.uniform(0.002, 0.01) * rng.choice([-1.0, 1.0])
    return sense + share * sense.std() * (drive - drive.mean()) / drive.std()


def curved(sense: Array, drive: Array, rate: float, rng: np.random.Generator) -> Array:
    """A characteristic of third, fifth or seventh order, 0.3 to 2 % of the signal."""
    level = (sense - sense.mean()) / (3.0 * sense.std())
    bend = level ** rng.choice([3, 5, 7])
    return sense + rng.uniform(0.003, 0.02) * sense.std() * (bend - bend.mean()) / bend.std()


def fluttering(sense: Array, drive: Array, rate: float, rng: np.random.Generator) -> Array:
    """A gain that flutters by 0.3 to 2 % at 20 to 300 Hz."""
    time = np.arange(sense.size) / rate
    gain = rng.uniform(0.003, 0.02) * np.sin(2.0 * np.pi * rng.uniform(20.0, 300.0) * time + rng.uniform(0.0, 6.28))
    return sense.mean() + (sense - sense.mean()) * (1.0 + gain)


def level_dependent(sense: Array, drive: Array, rate: float, rng: np.random.Generator) -> Array:
    """A gain that follows the signal's power of the last 0.3 to 3 ms by 0.3 to 2 %."""
    change = sense - sense.mean()
    decay = np.exp(-1.0 / (rng.uniform(0.3e-3, 3e-3) * rate))
    power = signal.lfilter([1.0 - decay], [1.0, -decay], change**2 - np.mean(change**2))
    return sense + rng.uniform(0.003, 0.02) * change * power / np.std(power)


def clipped(sense: Array, drive: Array, rate: float, rng: np.random.Generator) -> Array:
    """Rails that cut 1 to 5 % of the samples, one of them or both."""
    low, high = np.quantile(sense, [rng.uniform(0.01, 0.05), 1.0 - rng.uniform(0.01, 0.05)])
    return np.clip(sense, low if rng.random() < 0.7 else -np.inf, high)


def noisy(sense: Array, drive: Array, rate: float, rng: np.random.Generator) -> Array:
    """1/f noise, hum of 50 Hz with harmonics, and a broad amplifier resonance near 200 kHz: 0.3 to 1 % together."""
    white = np.fft.rfft(rng.standard_normal(sense.size))
    frequency = np.fft.rfftfreq(sense.size, 1.0 / rate)
    pink = np.fft.irfft(white / np.sqrt(np.maximum(frequency, 1.0 / DURATION_S)), sense.size)
    peak = rng.uniform(100e3, 400e3)
    ring = np.fft.irfft(
        np.fft.rfft(rng.standard_normal(sense.size)) / (1.0 + 1j * 5.0 * (frequency / peak - 1.0)), sense.size
    )
    time = np.arange(sense.size) / rate
    hum = sum(np.sin(2.0 * np.pi * 50.0 * n * time + rng.uniform(0.0, 6.28)) / n for n in (1, 2, 3))
    share = rng.uniform(0.003, 0.01) * sense.std()
    return sense + share * sum(part / np.std(part) for part in (pink, ring, hum)) / np.sqrt(3.0)


IMPERFECTIONS: dict[str, Imperfection] = {
    "delay": delayed, "pole": low_passed, "feedthrough": with_feedthrough, "curve": curved, "flutter": fluttering,
    "level": level_dependent, "rails": clipped, "noise": noisy,
}  # fmt: skip


def with_sense(recording: Recording, values: Array) -> Recording:
    """The recording with other values of its shared sense channel."""
    channel = replace(recording["sense"], raw=values, gain=1.0, offset=0.0, first=0, stop=values.size)
    return recording.with_channel(channel)


def scan(seed: int, range_of_photons: Sequence[float]) -> dict[str, Any]:
    """Imperfections of one scan, its phase errors [deg], coverage of the 95 % intervals and picture error ratio."""
    rng = np.random.default_rng([22, seed])
    kinds = list(rng.permutation(list(IMPERFECTIONS))[: rng.choice([0, 1, 2], p=[0.1, 0.65, 0.25])])
    photons = float(np.exp(rng.uniform(*np.log(range_of_photons))))
    scene = str(rng.choice(SCENES))
    drift = {axis: float(rng.uniform(-0.002, 0.002)) for axis in "xy"}
    experiment = Experiment(
        target=scene, duration=DURATION_S, drift=drift, detector=Detector(photons_per_sample=photons, bits=12)
    )
    recording, truth = simulate_experiment(experiment, seed)
    sense, drive = recording["sense"].read(), recording[f"drive_{rng.choice(['x', 'y'])}"].read()
    for kind in kinds:
        sense = IMPERFECTIONS[kind](sense, drive, recording["sense"].sample_rate, rng)
    known = truth_from_simulation(truth)
    options = Options(allow_outside=True)  # where both axes drift into resonance, half of the samples are outside
    result = reconstruct(with_sense(recording, sense), options, known, quiet=True)
    summary = summarise(result)
    row: dict[str, Any] = {"seed": seed, "kind": "+".join(kinds) or "none", "scene": scene, "photons": photons}
    true = map_samples(known.angles["x"][0], known.angles["y"][0], recording["intensity"].read(), result.picture.grid)
    row["picture"] = summary["picture"]["rms"] / compare_with_scene(true, known.scene).rms
    for axis in "xy":
        error, motion = result.evaluation[axis].phase, result.motion.axes[axis]
        at = np.linspace(motion.time[0], motion.time[-1], error.size)
        sd = np.interp(at, motion.time, motion.phase_sd)
        row[axis] = {
            "rms_deg": summary[axis]["phase_rmse_deg"],
            "sd_deg": float(np.degrees(np.sqrt(np.mean(sd**2)))),
            "coverage": float(np.mean(np.abs(error) < 1.96 * sd)),
            "amplitude_error": float(np.sqrt(np.mean(motion.amplitude**2) / 2.0) / np.std(known.angles[axis][0])) - 1.0,
            "amplitude_sd": summary[axis]["amplitude_sd_rad"] / summary[axis]["amplitude_rad"],
        }
    return row


HEADINGS = (
    "imperfection", "scans", "phase error x, y, rms: median", "worst", "both within 0.05°", "95 % intervals hold x, y",
    "picture error over that of the true motion: 95 %", "amplitude within its 95 % interval, x and y",
)  # fmt: skip


def table(rows: list[dict[str, Any]]) -> str:
    """Markdown table by kind of imperfection; pairs of imperfections are a separate kind."""
    lines = [HEADINGS, ("---",) * len(HEADINGS)]
    for kind in ("none", *IMPERFECTIONS, "pairs", "all"):
        chosen = [r for r in rows if kind in ("all", r["kind"]) or (kind == "pairs" and "+" in r["kind"])]
        if chosen:
            rms = np.array([[row[axis]["rms_deg"] for axis in "xy"] for row in chosen])
            held = np.mean([[row[axis]["coverage"] for axis in "xy"] for row in chosen], axis=0)
            degrees = ["{:.3f}°, {:.3f}°".format(*values) for values in (np.median(rms, axis=0), rms.max(axis=0))]
            within, ratio = np.mean(rms.max(axis=1) <= 0.05), np.quantile([row["picture"] for row in chosen], 0.95)
            held_text = "{:.1%}, {:.1%}".format(*held)
            amplitudes = [abs(r[a]["amplitude_error"]) < 1.96 * r[a]["amplitude_sd"] for r in chosen for a in "xy"]
            held_amplitudes = f"{sum(amplitudes)} of {len(amplitudes)}"
            lines.append(
                (kind, str(len(chosen)), *degrees, f"{within:.0%}", held_text, f"{ratio:.3f}", held_amplitudes)
            )
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scans", type=int, help="number of scans")
    parser.add_argument("--first", type=int, default=0, help="seed of the first scan")
    parser.add_argument(
        "--photons", type=float, nargs=2, default=(100.0, 1000.0), metavar=("LEAST", "MOST"), help="a sample"
    )
    parser.add_argument("--json", type=Path, help="write one record a scan")
    args = parser.parse_args()
    rows = []
    for seed in range(args.first, args.first + args.scans):
        rows.append(scan(seed, args.photons))
        print(json.dumps(rows[-1]), file=sys.stderr, flush=True)
    print(table(rows))
    if args.json:
        args.json.write_text(json.dumps(rows, indent=1) + "\n")


if __name__ == "__main__":
    main()
