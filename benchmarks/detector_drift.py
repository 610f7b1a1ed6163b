"""Pictures from a detector that drifts, with and without ``--intensity-drift``.

    python -m benchmarks.detector_drift SCANS [--first SEED]

Every scan is the demo's (60 ms, 400 x 400 pixels, 5 MS/s) of one of four tissues. The intensity has white noise of 100
photons a sample, and in addition 1/f noise whose knee is ten times the frequency of the slow axis, or a gain that falls
to half (bleaching). The error of the picture against the scene is divided by that with white noise alone.
"""

from __future__ import annotations

import argparse
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from phantoms.experiment import Experiment, simulate_experiment
from phantoms.optics import Detector
from recon.imaging.intensity_drift import DriftKind
from recon.pipeline import reconstruct
from recon.reconstruction import Options
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


def picture(recording: Recording, kind: DriftKind | None) -> NDArray[np.float32]:
    return reconstruct(recording, Options(intensity_drift=kind), quiet=True).picture.image


def rms_error(image: NDArray[np.float32], reference: NDArray[np.float32]) -> float:
    """Root-mean-square difference of visited pixels, without the factor and the offset that no drift determines."""
    used = np.isfinite(image) & np.isfinite(reference)
    slope, offset = np.polyfit(reference[used], image[used], 1)
    return float(np.std((image[used] - offset) / slope - reference[used]))


def measure_scan(seed: int) -> dict[str, list[float]]:
    """Errors over that with white noise alone, by drift: as recorded, and with the drift removed."""
    rng = np.random.default_rng([seed, 1])
    bright = Experiment(target=SCENES[seed % len(SCENES)], detector=Detector(gain=1e-3, photons_per_sample=1e6))
    recording, _ = simulate_experiment(bright, seed)
    intensity = recording["intensity"]
    light = intensity.read() / 1e3
    noise = np.sqrt(np.maximum(light, 0.0) / PHOTONS) * rng.standard_normal(light.size)
    flicker = flicker_noise(light.size, intensity.sample_rate, KNEE_OVER_SLOW_AXIS * SLOW_AXIS_HZ, rng)
    gain = np.linspace(1.0, BLEACHED_TO, light.size)
    sd = float(np.sqrt(np.mean(light) / PHOTONS))
    reference = picture(recording.with_channel(replace(intensity, raw=light)), None)

    def error(values: NDArray[np.float64], kind: DriftKind | None) -> float:
        return rms_error(picture(recording.with_channel(replace(intensity, raw=values)), kind), reference)

    white, bleached = error(light + noise, None), error(light + noise / gain, None)
    with_flicker, with_bleaching = light + noise + sd * flicker, light * gain + noise
    return {
        "1/f noise": [error(with_flicker, kind) / white for kind in (None, "offset")],
        "bleaching": [error(with_bleaching, kind) / bleached for kind in (None, "gain")],
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
        ("bleaching", ("as recorded", "--intensity-drift gain")),
        ("steady", ("--intensity-drift offset", "--intensity-drift gain")),
    ):
        ratios = np.array([scan[drift] for scan in scans])
        for column, values in zip(columns, ratios.T, strict=True):
            print(f"{drift:10s} {column:26s} median {np.median(values):.3f}, largest {values.max():.3f}", flush=True)


if __name__ == "__main__":
    main()
