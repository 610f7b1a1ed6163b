"""Free decays with one law of damping or none, diagnosed by their amplitude; and a waveform of 40 000 turns.

python -m benchmarks.slow_decays
"""

from __future__ import annotations

import time
from collections import Counter

import numpy as np

from estimation.complete_diagnosis import diagnose_with_optics
from estimation.slow.decay import LAWS, solve_decay
from scanner.device import Axis, Device
from scanner.recording import Recording
from scanner.stages import Mechanics, Position

RATE_RAD_S, QUALITY, DURATION_S = 2 * np.pi * 5000.0, 2e4, 8.0
DECAY = DURATION_S * RATE_RAD_S / QUALITY / 2.0
"""Decay of ln A over the recording by the nominal damping."""
MECHANICS = Mechanics(1e-10, 1e-10 * RATE_RAD_S / QUALITY, 1e-10 * RATE_RAD_S**2)
DEVICE = Device("beam", {"x": Axis(MECHANICS, readout=Position(10.0, 1e-3), name="x")})
SEEDS = range(9100, 9200)
SHARES = {"cubic-damping": (0.09, 0.9), "quadratic-drag": (0.09, 0.9), "coulomb-friction": (0.03, 0.1)}
"""Rate that a law adds at the first amplitude, relative to the nominal one: least and largest."""


def envelope(seed: int) -> tuple[str, Recording]:
    rng, clock = np.random.default_rng(seed), np.arange(0.0, DURATION_S, 0.01)
    law = (None, *LAWS)[seed % (len(LAWS) + 1)]
    coefficient, power, drift = 0.0, 1.0, 0.0
    if law is not None and law.power is not None:
        coefficient, power = DECAY * rng.uniform(*SHARES[law.effect]), law.power
    elif law is not None:
        drift = rng.uniform(0.2, 1.0) * rng.choice([-0.7, 1.0])
    solved = solve_decay(0.0, DECAY, coefficient, power, drift, rng.uniform(0.1, 0.6), 2000)
    amplitude = 0.1 * np.exp(np.interp(clock / DURATION_S, np.linspace(0.0, 1.0, 2001), solved))
    noise_sd = 1e-5 * rng.choice([0.3, 3.0, 30.0])
    values = np.abs(amplitude + rng.normal(0.0, noise_sd, clock.size))
    channels = {"amplitude_x": (values, "rad", 100.0, 0.0, {"reference": 5000.0})}
    return "consistent" if law is None else law.effect, Recording.from_arrays(channels, DEVICE)


def main() -> None:
    found: Counter[tuple[str, str]] = Counter()
    for seed in SEEDS:
        true, recording = envelope(seed)
        findings = diagnose_with_optics([recording]).findings
        found[true, findings[0].effect if findings else "consistent"] += 1
    for (true, named), count in sorted(found.items()):
        print(f"{true}: {named} {count}")
    clock, rng = np.arange(400_000) / 5e4, np.random.default_rng(9300)
    solved = solve_decay(0.0, DECAY, 3.0, 2.0, 0.0, 1.0, 4000)
    amplitude = np.exp(np.interp(clock / DURATION_S, np.linspace(0.0, 1.0, 4001), solved))
    signal = amplitude * np.sin(1.0002 * RATE_RAD_S * clock) + rng.normal(0.0, 1e-3, clock.size)
    began = time.perf_counter()
    diagnosis = diagnose_with_optics([Recording.from_arrays({"sense_x": (signal, "V", 5e4)}, DEVICE)])
    print(f"40 000 turns in {time.perf_counter() - began:.1f} s: {diagnosis!r}")


if __name__ == "__main__":
    main()
