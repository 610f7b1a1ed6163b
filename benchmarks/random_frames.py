"""Posterior pictures of frames with random scene, light, duration and phases, against a kernel tuned to the truth.

Frames as in :mod:`benchmarks.sparse_pictures`. The goal is a gain of 0.3 dB in every frame.
Run: python -m benchmarks.random_frames COUNT --first SEED
"""

from __future__ import annotations

import argparse

import numpy as np

from benchmarks.sparse_pictures import (
    SCENES,
    TUNED_WIDTHS_PX,
    coverage,
    load_scene,
    nearest,
    psnr,
    scan,
    sum_samples,
)
from recon.imaging.picture_kinds.kernel_picture import kernel_mean
from recon.imaging.picture_kinds.posterior_picture import posterior_picture
from recon.imaging.pixel_noise import measure_sample_noise
from scanner.arrays import Array

ALL_SCENES = (
    *SCENES,
    "grass", "brick", "coffee", "clock", "hubble_deep_field", "gravel",
    "chelsea", "rocket", "page", "text", "cell", "immunohistochemistry", "microaneurysms",
)  # fmt: skip

PHOTONS = 3.0, 10.0, 30.0, 100.0
"""Photons in a sample of the brightest pixel."""

DURATIONS_S = 0.0015, 0.002, 0.003, 0.005, 0.01, 0.015

GOAL_DB = 0.3


def run_frame(scene: Array, photons: float, seconds: float, seed: int) -> tuple[float, float, float]:
    """Gain over the tuned kernel [dB], and coverage of the 95 % intervals of visited and unvisited pixels."""
    pixel, counts = scan(scene, photons, seconds, seed)
    samples, noise = sum_samples(pixel, counts), measure_sample_noise(pixel, counts)
    if noise is None:
        raise ValueError("the scan has too few crossings")
    estimate, visited = posterior_picture(samples, noise), samples.counts > 0
    means = np.where(visited, samples.sums / np.maximum(samples.counts, 1), np.nan)
    image = np.where(np.isfinite(estimate.image), estimate.image, nearest(samples, means))
    tuned = (kernel_mean(samples.sums, samples.counts, width) for width in TUNED_WIDTHS_PX)
    gain = psnr(image, scene, photons) - max(psnr(each, scene, photons) for each in tuned)
    held = (coverage(image, estimate.sd, photons * scene, part) for part in (visited, ~visited))
    return gain, *held  # type: ignore[return-value]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("count", type=int)
    parser.add_argument("--first", type=int, required=True, metavar="SEED")
    options = parser.parse_args()
    scenes = {name: load_scene(name) for name in ALL_SCENES}
    results: dict[float, list[tuple[float, float, float]]] = {photons: [] for photons in PHOTONS}
    for seed in range(options.first, options.first + options.count):
        rng = np.random.default_rng([seed, 1])
        name, photons, seconds = rng.choice(ALL_SCENES), float(rng.choice(PHOTONS)), float(rng.choice(DURATIONS_S))
        results[photons].append(run_frame(scenes[name], photons, seconds, seed))
        if (gain := results[photons][-1][0]) < GOAL_DB:
            print(f"seed {seed}: {name}, {photons:g} photons, {1e3 * seconds:g} ms: {gain:+.2f} dB", flush=True)
    print("\n| photons | frames | gain [dB], mean (least) | below the goal | intervals, visited / unvisited |")
    print("|---|---|---|---|---|")
    for photons, frames in results.items():
        if frames:
            gain, of_visited, of_unvisited = np.array(frames).T
            print(
                f"| {photons:g} | {gain.size} | {gain.mean():.2f} ({gain.min():.2f}) | {np.sum(gain < GOAL_DB)} "
                f"| {100 * of_visited.mean():.1f} / {100 * of_unvisited.mean():.1f} |"
            )


if __name__ == "__main__":
    main()
