"""Pictures from a detector that drifts, with and without ``--intensity-drift``.

    python -m benchmarks.detector_drift SCANS [--first SEED]

Every scan is the demo's (60 ms, 400 x 400 pixels, 5 MS/s) of one of four tissues. The intensity has white noise of 100
photons a sample, and in addition 1/f noise whose knee is ten times the frequency of the slow axis, or a gain that falls
to half (bleaching). The error of the picture against the scene is divided by that with white noise alone, and so is the
standard deviation of the phase beside the gain.
"""

from __future__ import annotations

import argparse
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from phantoms.experiment import Experiment, simulate_experiment
from phantoms.optics import Detector
from recon.imaging.intensity_drift_equations import DriftKind
from recon.pipeline import reconstruct
from recon.steps.reconstruction import Options, Reconstruction
from scanner.arrays import Array
from scanner.device import AXES
from scanner.recording import Recording

SCENES = ("immunohistochemistry", "retina", "cell", "microaneurysms")

KNEE_OVER_SLOW_AXIS = 10.0
"""Frequency at which 1/f noise and white noise are equal, over the frequency of the slow axis."""

SLOW_AXIS_HZ = 3270.0
"""Frequency of the slow axis of the demo: half of its drive."""

PHOTONS = 100.0
"""Photons a sample at the brightest place: their white noise has a standard deviation of a tenth of the full light."""

BLEACHED_TO = 0.5
"""Gain at the end of the recording."""


def flicker_noise(samples: int, rate: float, knee: float, rng: np.random.Generator) -> NDArray[np.float64]:
    """Noise with the density of white noise of variance 1 times ``knee``/f, shape (samples,)."""
    frequency = np.fft.rfftfreq(2 * samples, 1.0 / rate)
    factor = np.zeros_like(frequency)
    factor[1:] = np.sqrt(knee / frequency[1:])
    return np.fft.irfft(np.fft.rfft(rng.standard_normal(2 * samples)) * factor)[:samples]


def reconstruct_values(recording: Recording, values: Array, kind: DriftKind | None) -> Reconstruction:
    """Reconstruct a recording with other values of the intensity, shape (samples,), and that drift removed."""
    recording = recording.with_channel(replace(recording["intensity"], raw=values))
    return reconstruct(recording, Options(intensity_drift=kind), quiet=True)


def phase_sd(result: Reconstruction, axis: str) -> float:
    """Root mean square of the stated standard deviation of a phase [rad]."""
    return float(np.sqrt(np.mean(result.motion.axes[axis].phase_sd ** 2)))


def rms_error(image: NDArray[np.float32], reference: NDArray[np.float32]) -> float:
    """Root-mean-square difference of visited pixels, without the factor and the offset that no drift determines."""
    used = np.isfinite(image) & np.isfinite(reference)
    slope, offset = np.polyfit(reference[used], image[used], 1)
    return float(np.std((image[used] - offset) / slope - reference[used]))


def measure_scan(seed: int) -> dict[str, list[float]]:
    """Errors and phase sd over those with white noise alone, by drift: as recorded, and with the drift removed."""
    rng = np.random.default_rng([seed, 1])
    bright = Experiment(target=SCENES[seed % len(SCENES)], detector=Detector(gain=1e-3, photons_per_sample=1e6))
    recording, _ = simulate_experiment(bright, seed)
    intensity = recording["intensity"]
    light = intensity.read() / 1e3
    noise = np.sqrt(np.maximum(light, 0.0) / PHOTONS) * rng.standard_normal(light.size)
    flicker = flicker_noise(light.size, intensity.sample_rate, KNEE_OVER_SLOW_AXIS * SLOW_AXIS_HZ, rng)
    gain = np.linspace(1.0, BLEACHED_TO, light.size)
    sd = float(np.sqrt(np.mean(light) / PHOTONS))
    reference = reconstruct_values(recording, light, None).picture.image

    def error(values: Array, kind: DriftKind | None) -> float:
        return rms_error(reconstruct_values(recording, values, kind).picture.image, reference)

    white, best = error(light + noise, None), reconstruct_values(recording, light + noise / gain, None)
    bleached = [reconstruct_values(recording, light * gain + noise, kind) for kind in (None, "gain")]
    best_error = rms_error(best.picture.image, reference)
    return {
        "1/f noise": [error(light + noise + sd * flicker, kind) / white for kind in (None, "offset")],
        "bleaching": [rms_error(result.picture.image, reference) / best_error for result in bleached],
        **{f"phase {axis}": [phase_sd(result, axis) / phase_sd(best, axis) for result in bleached] for axis in AXES},
        "steady": [error(light + noise, kind) / white for kind in ("offset", "gain")],
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("scans", type=int)
    parser.add_argument("--first", type=int, default=0, help="seed of the first scan")
    arguments = parser.parse_args()
    scans = [measure_scan(seed) for seed in range(arguments.first, arguments.first + arguments.scans)]
    for drift, columns in (
        ("1/f noise", ("as recorded", "--intensity-drift offset")),
        *((name, ("as recorded", "--intensity-drift gain")) for name in ("bleaching", "phase x", "phase y")),
        ("steady", ("--intensity-drift offset", "--intensity-drift gain")),
    ):
        ratios = np.array([scan[drift] for scan in scans])
        for column, values in zip(columns, ratios.T, strict=True):
            print(f"{drift:10s} {column:26s} median {np.median(values):.3f}, largest {values.max():.3f}", flush=True)


if __name__ == "__main__":
    main()
