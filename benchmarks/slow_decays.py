"""Free decays with one law of damping or none, diagnosed by their amplitude one at a time and in pairs.

The last line is for a waveform of 40 000 turns.

python -m benchmarks.slow_decays [FIRST_SEED NUMBER]
"""

from __future__ import annotations

import sys
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
WORSE = 1.02
"""Ratio of errors above which a device counts as worse, as in the blind recordings."""
SHARES = {"cubic-damping": (0.09, 0.9), "quadratic-drag": (0.09, 0.9), "coulomb-friction": (0.03, 0.1)}
"""Rate that a law adds at the first amplitude, relative to the nominal one: least and largest."""


RIPPLE_SD, RIPPLE_PERIOD = 2e-3, 1.0
"""Relative error of a detector, which depends on ln A with this period at least."""


def envelopes(seed: int, count: int) -> tuple[str, list[Recording]]:
    """Free decays of one device from amplitudes that halve, by a detector with a ripple; the name of the hidden law."""
    rng, clock = np.random.default_rng(seed), np.arange(0.0, DURATION_S, 0.01)
    law = (None, *LAWS)[seed % (len(LAWS) + 1)]
    coefficient, power, drift = 0.0, 1.0, 0.0
    if law is not None and law.power is not None:
        coefficient, power = DECAY * rng.uniform(*SHARES[law.effect]), law.power
    elif law is not None:
        drift = rng.uniform(0.2, 1.0) * rng.choice([-0.7, 1.0])
    drift_time, noise_sd = rng.uniform(0.1, 0.6), 1e-5 * rng.choice([0.3, 3.0, 30.0])
    period, ripple, phase = RIPPLE_PERIOD * rng.uniform(1.0, 4.0), RIPPLE_SD * rng.normal(), rng.uniform(0.0, 6.3)
    made = []
    for i in range(count):
        solved = solve_decay(-i * np.log(2.0), DECAY, coefficient, power, drift, drift_time, 2000)
        log_a = np.interp(clock / DURATION_S, np.linspace(0.0, 1.0, 2001), solved)
        amplitude = 0.1 * np.exp(log_a + ripple * np.sin(2 * np.pi * log_a / period + phase))
        values = np.abs(amplitude + rng.normal(0.0, noise_sd, clock.size))
        channels = {"amplitude_x": (values, "rad", 100.0, 0.0, {"reference": 5000.0})}
        made.append(Recording.from_arrays(channels, DEVICE))
    return "consistent" if law is None else law.effect, made


def main(first: int, number: int) -> None:
    for count in (1, 2):
        found: Counter[tuple[str, str]] = Counter()
        worse = 0
        for seed in range(first, first + number):
            true, recordings = envelopes(seed, count)
            diagnosis = diagnose_with_optics(recordings)
            found[true, diagnosis.findings[0].effect if diagnosis.findings else "consistent"] += 1
            loop = diagnosis.open_loop["amplitude_x"]
            worse += loop["improved"]["rmse"] > WORSE * loop["nominal"]["rmse"]
        for (true, named), times in sorted(found.items()):
            print(f"{count} decays, {true}: {named} {times}")
        print(f"{count} decays: improved device worse than the nominal one, held-out samples: {worse} of {number}")
    clock, rng = np.arange(400_000) / 5e4, np.random.default_rng(9300)
    solved = solve_decay(0.0, DECAY, 3.0, 2.0, 0.0, 1.0, 4000)
    amplitude = np.exp(np.interp(clock / DURATION_S, np.linspace(0.0, 1.0, 4001), solved))
    signal = amplitude * np.sin(1.0002 * RATE_RAD_S * clock) + rng.normal(0.0, 1e-3, clock.size)
    began = time.perf_counter()
    diagnosis = diagnose_with_optics([Recording.from_arrays({"sense_x": (signal, "V", 5e4)}, DEVICE)])
    print(f"40 000 turns in {time.perf_counter() - began:.1f} s: {diagnosis!r}")


if __name__ == "__main__":
    main(*(int(argument) for argument in sys.argv[1:]) if len(sys.argv) == 3 else (9100, 100))
