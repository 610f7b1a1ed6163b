"""How good a picture behind a slow detector can be: the posterior mean under the exact model of every sample.

The demo's scan of a scene behind a fast detector and one with a low-pass of first order, at the same photons. Known to
the estimate are the true motion, the low-pass (each sample of the light is a weighted mean of the scene at its own and
the previous position, with white photon noise), the variance of the noise and the spectrum of the true scene. The scene
is a stationary Gaussian random field, linear between the pixels' centres. No estimate that is linear in the samples and
treats all parts of the scene alike errs less.
Run: python -m benchmarks.slow_detector_bound SEED... [--photons N] [--bandwidth HZ]
"""

from __future__ import annotations

import argparse
from dataclasses import replace

import numba
import numpy as np
from scipy import fft
from scipy.ndimage import gaussian_filter

from benchmarks.sample_motion import PIXELS, REST_DURATION_S, SCENES, simulate_scan
from benchmarks.slow_detector import record
from phantoms.optics import Detector
from scanner.arrays import Array
from scanner.lowpass import section_coefficients

TOLERANCE, MAX_ITERATIONS = 3e-4, 1000
SPECTRUM_WIDTH = 2.0
"""Smoothing of the true scene's power over its cosine modes, in modes."""


@numba.njit(cache=True)
def _corners(row, column, size):  # type: ignore[no-untyped-def]
    """First row and column of the four pixels around a position, and the position between them."""
    i, j = min(max(int(row), 0), size - 2), min(max(int(column), 0), size - 2)
    return i, j, min(max(row - i, 0.0), 1.0), min(max(column - j, 0.0), 1.0)


@numba.njit(cache=True)
def sample_light(image, rows, columns, earlier):  # type: ignore[no-untyped-def]
    """Light of each sample; ``earlier``: weight of the previous position."""
    light = np.empty(rows.size)
    for k in range(rows.size):
        i, j, u, v = _corners(rows[k], columns[k], image.shape[0])
        top = (1 - v) * image[i, j] + v * image[i, j + 1]
        light[k] = (1 - u) * top + u * ((1 - v) * image[i + 1, j] + v * image[i + 1, j + 1])
    for k in range(rows.size - 1, 0, -1):
        light[k] = (1 - earlier) * light[k] + earlier * light[k - 1]
    return light


@numba.njit(cache=True)
def spread_light(light, rows, columns, earlier, size):  # type: ignore[no-untyped-def]
    """Transpose of :func:`sample_light`."""
    image = np.zeros((size, size))
    for k in range(rows.size):
        value = ((1 - earlier) if k else 1.0) * light[k]
        if k + 1 < rows.size:
            value += earlier * light[k + 1]
        i, j, u, v = _corners(rows[k], columns[k], size)
        image[i, j] += (1 - u) * (1 - v) * value
        image[i, j + 1] += (1 - u) * v * value
        image[i + 1, j] += u * (1 - v) * value
        image[i + 1, j + 1] += u * v * value
    return image


def posterior_mean(light: Array, precision: Array, place: Array, earlier: float, spectrum: Array, mean: float) -> Array:
    """Posterior mean by conjugate gradients over the cosine modes, in units of their prior standard deviations.

    Args:
        light, precision: of each sample, shape (n,).
        place: row and column of each sample, shape (2, n).
        earlier: weight of the previous position in a sample.
        spectrum: prior power of the modes, shape (size, size).
        mean: prior mean.
    """
    size, root = len(spectrum), np.sqrt(spectrum)

    def to_modes(samples: Array) -> Array:
        return np.asarray(root * fft.dctn(spread_light(precision * samples, *place, earlier, size), norm="ortho"))

    def to_image(modes: Array) -> Array:
        return np.asarray(fft.idctn(root * modes, norm="ortho"))

    inverse = 1.0 / (1.0 + spectrum * precision.sum() / size**2)
    residual = to_modes(light - mean)
    solution, conditioned = np.zeros_like(residual), inverse * residual
    direction, energy = conditioned, float(np.vdot(residual, conditioned))
    target = TOLERANCE**2 * energy
    for _ in range(MAX_ITERATIONS):
        product = direction + to_modes(sample_light(to_image(direction), *place, earlier))
        step = energy / float(np.vdot(direction, product))
        solution, residual = solution + step * direction, residual - step * product
        conditioned = inverse * residual
        previous, energy = energy, float(np.vdot(residual, conditioned))
        if energy <= target:
            break
        direction = conditioned + energy / previous * direction
    return mean + to_image(solution)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("seeds", type=int, nargs="+")
    parser.add_argument("--photons", type=float, default=100.0)
    parser.add_argument("--bandwidth", type=float, default=2e5)
    args = parser.parse_args()
    fast = Detector(1.0 / args.photons, args.photons, 0.0)
    print("| scene | fast detector | slow / fast |\n|---|---|---|")
    for seed in args.seeds:
        scan = simulate_scan("rest", args.photons, seed, REST_DURATION_S)
        device, channel = scan.recording.device, scan.recording["intensity"]
        assert device is not None
        half_x, half_y = device.require_scan().mechanical_half_angles
        pairs = (scan.truth["y"], half_y), (scan.truth["x"], half_x)
        place = np.stack([PIXELS / 2 * (angle / half + 1) - 0.5 for angle, half in pairs])
        scene = scan.picture
        power = fft.dctn(scene - scene.mean(), norm="ortho") ** 2
        prior = gaussian_filter(power, SPECTRUM_WIDTH) + 1e-9, float(scene.mean())
        level = np.maximum(gaussian_filter(scene, 1.5), 0.02)
        precision = args.photons / sample_light(level, *place, 0.0)
        decay, previous, new = section_coefficients(args.bandwidth, 1.0 / channel.sample_rate)
        signal = record(scan, seed, replace(fast, bandwidth_hz=args.bandwidth))["intensity"].read()
        light = np.append(signal[:1], (signal[1:] - decay * signal[:-1]) / (1.0 - decay))
        errors = [
            float(np.sqrt(np.mean((posterior_mean(samples, precision, place, earlier, *prior) - scene) ** 2)))
            for samples, earlier in (
                (record(scan, seed, fast)["intensity"].read(), 0.0),
                (light, previous / (previous + new)),
            )
        ]
        print(f"| {SCENES[seed % len(SCENES)]} | {errors[0]:.4f} | {errors[1] / errors[0]:.3f} |", flush=True)


if __name__ == "__main__":
    main()
