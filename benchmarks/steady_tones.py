"""Frequency responses with one effect or none, diagnosed: names, and false alarms.

python -m benchmarks.steady_tones [FIRST_SEED NUMBER]

The responses of the laws are solved for the amplitude at every tone, by bisection along the stable branch from below.
"""

from __future__ import annotations

import sys
from collections import Counter

import numpy as np

from estimation.complete_diagnosis import diagnose_with_optics
from scanner.arrays import Array
from scanner.device import Axis, Device
from scanner.recording import Recording
from scanner.stages import Mechanics, Position

RESONANCE_HZ, QUALITY, TONES = 800.0, 300.0, 41
RATE = 2 * np.pi * RESONANCE_HZ
AXIS = Axis(Mechanics(1.0, RATE / QUALITY, RATE**2), readout=Position(10.0, 1e-4), name="x")
DEVICE = Device("lever", {"x": AXIS})
KINDS = (
    "consistent",
    "second-mode",
    "feedthrough",
    "channel-delay",
    "cubic-stiffness",
    "cubic-damping",
    "quadratic-drag",
)


def response(kind: str, rng: np.random.Generator) -> tuple[Array, Array]:
    """Frequencies [Hz] and complex angles [rad] at the tones, with noise and an error of gain of the lock-in."""
    f0, quality = RESONANCE_HZ * (1 + 1e-3 * rng.normal()), QUALITY * rng.uniform(0.8, 1.2)
    frequency = np.linspace(f0 - 5.0, f0 + 5.0, TONES)
    w, w0 = 2 * np.pi * frequency, 2 * np.pi * f0
    width, strength = 1.0 / quality, rng.uniform(0.3, 1.2)

    def dynamic(a: Array) -> Array:
        """Dynamic stiffness over w0^2 at amplitude ``a`` relative to the linear peak."""
        linear = 1 - (w / w0) ** 2 + 1j * w / w0 / quality
        if kind == "cubic-stiffness":
            return linear + width * strength * a**2
        if kind == "cubic-damping":
            return linear + 1j * width * strength * a**2
        return linear + 1j * width * strength * a if kind == "quadratic-drag" else linear

    low, high = np.zeros(TONES), np.full(TONES, 2.0)
    for _ in range(60):  # a |D(a)| = width, the smallest root
        middle = 0.5 * (low + high)
        above = middle * np.abs(dynamic(middle)) > width
        low, high = np.where(above, low, middle), np.where(above, middle, high)
    z = width / dynamic(low)
    if kind == "second-mode":
        w2 = 2 * np.pi * (f0 + rng.choice([-1, 1]) * rng.uniform(0.7, 3.0))
        residue = rng.uniform(0.1, 0.5) * np.exp(2j * np.pi * rng.uniform())
        z = z + residue * width / (1 - (w / w2) ** 2 + 1j * w / w2 / quality)
    if kind == "feedthrough":
        z = z + rng.uniform(0.03, 0.15) * np.exp(2j * np.pi * rng.uniform())
    if kind == "channel-delay":
        z = z * np.exp(-1j * w * rng.uniform(1e-3, 10e-3))
    noise = 10 ** rng.uniform(-3.3, -2.3)
    z = z * (1 + 1e-3 * np.sin(frequency * rng.uniform(0.3, 1.0) + rng.uniform(0, 6.3)))
    z = z + noise * (rng.normal(size=TONES) + 1j * rng.normal(size=TONES))
    return frequency, 0.1 * z * np.exp(2j * np.pi * rng.uniform())


def recording(frequency: Array, angle: Array) -> Recording:
    extra = {"reference": "frequency"}
    channels = {
        "frequency": (frequency, "Hz", 1.0),
        "amplitude_x": (np.abs(angle), "rad", 1.0, 0.0, extra),
        "phase_x": (np.angle(angle), "rad", 1.0, 0.0, extra),
    }
    return Recording.from_arrays(channels, DEVICE)


def main(first: int, number: int) -> None:
    found: Counter[tuple[str, str]] = Counter()
    worse = 0
    for seed in range(first, first + number):
        kind = KINDS[seed % len(KINDS)]
        diagnosis = diagnose_with_optics([recording(*response(kind, np.random.default_rng(seed)))])
        found[kind, diagnosis.findings[0].effect if diagnosis.findings else diagnosis.verdict] += 1
        loop = diagnosis.open_loop["amplitude_x"]
        worse += loop["improved"]["rmse"] > loop["nominal"]["rmse"]
    for (kind, named), count in sorted(found.items()):
        print(f"{kind}: {named} {count}")
    print(f"improved device worse than the nominal one, held-out tones: {worse} of {number}")


if __name__ == "__main__":
    main(*(int(argument) for argument in sys.argv[1:]) if len(sys.argv) == 3 else (9500, 60))
