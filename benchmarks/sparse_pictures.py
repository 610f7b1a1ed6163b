"""Pictures of scans that leave pixels unvisited: mean, kernel and posterior against filling, inpainting and others.

Scenes of scikit-image, 256 x 256 pixels, scanned at 5450 and 6700 Hz with random phases, 5 MS/s, Poisson counts.
Between the centres of pixels the scene is interpolated linearly. PSNR refers to the scene's largest value. The tuned
kernel has the width and total variation the strength with the least error against the true scene; nothing else uses
the truth. The proximal operator of total variation and biharmonic inpainting are scikit-image's.
Run: python -m benchmarks.sparse_pictures SEED... [--scenes NAME,...]
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable

import numpy as np
from scipy.ndimage import distance_transform_edt, map_coordinates

from recon.imaging.picture import Grid, Picture, fill_holes
from recon.imaging.picture_kinds.held_out import SplitSums, held_out_ranges, hold_out_neighbours
from recon.imaging.picture_kinds.kernel_picture import kernel_picture
from recon.imaging.picture_kinds.posterior_picture import posterior_picture
from recon.imaging.pixel_noise import measure_sample_noise
from recon.imaging.smoothing import kernel_mean
from scanner.arrays import Array

PIXELS = 256
SAMPLE_RATE_HZ = 5e6
FREQUENCIES_HZ = 5450.0, 6700.0

SCENES = ("camera", "coins", "moon", "astronaut", "retina")
"""The scenes of the goal. The constants of the estimators were chosen with others."""

CONDITIONS = ((10.0, 0.002), (10.0, 0.005), (100.0, 0.010))
"""Photons in a sample of the brightest pixel, and duration [s]."""

TUNED_WIDTHS_PX = np.geomspace(0.4, 16.0, 40)
FILL_RADIUS_PX = 16


TV_STRENGTHS = np.geomspace(0.03, 0.5, 6)
"""Strengths of total variation that are compared, in standard deviations of a sample at half the largest intensity."""

TV_ITERATIONS = 80
"""Iterations of total variation. Twice as many change the PSNR by 0.1 dB at most."""

TV_WEIGHT_SAMPLES = 4
"""Samples in a pixel from which on it has the full weight in total variation: larger ratios converge slowly."""


def load_scene(name: str) -> Array:
    """A picture of scikit-image in [0, 1], its central square scaled to ``PIXELS``."""
    from skimage import color, data, transform

    image = np.asarray(getattr(data, name)())
    image = color.rgb2gray(image) if image.ndim == 3 else image.astype(float)
    side = min(image.shape)
    top, left = ((size - side) // 2 for size in image.shape)
    image = transform.resize(image[top : top + side, left : left + side], (PIXELS, PIXELS), anti_aliasing=True)
    return np.asarray(image / image.max())


def scan(scene: Array, photons: float, seconds: float, seed: int) -> tuple[Array, Array]:
    """Pixel and counts of every sample."""
    rng = np.random.default_rng(seed)
    time_s = np.arange(round(seconds * SAMPLE_RATE_HZ)) / SAMPLE_RATE_HZ
    x, y = (
        np.minimum((np.sin(2 * np.pi * f * time_s + rng.uniform(0, 2 * np.pi)) + 1) * PIXELS / 2, PIXELS - 1e-9)
        for f in FREQUENCIES_HZ
    )
    values = map_coordinates(scene, [y - 0.5, x - 0.5], order=1, mode="nearest")
    return y.astype(int) * PIXELS + x.astype(int), rng.poisson(photons * np.maximum(values, 0.0)).astype(float)


def sum_samples(pixel: Array, counts: Array) -> SplitSums:
    """Sums by pixel, with the held-out samples."""
    held = np.concatenate([np.arange(*part) for part in held_out_ranges(0, pixel.size)])

    def images(part: Array | slice) -> tuple[Array, Array]:
        sums = np.bincount(pixel[part], counts[part], PIXELS**2), np.bincount(pixel[part], minlength=PIXELS**2)
        return tuple(each.reshape(PIXELS, PIXELS).astype(float) for each in sums)  # type: ignore[return-value]

    return hold_out_neighbours(SplitSums(*images(slice(None)), *images(held)))


def nearest(samples: SplitSums, means: Array) -> Array:
    """Mean, and the nearest visited pixel where there is none."""
    rows, columns = distance_transform_edt(samples.counts == 0, return_distances=False, return_indices=True)
    return means[rows, columns]


def filled(samples: SplitSums, means: Array) -> Array:
    """``--fill``, and the nearest pixel where it does not reach."""
    picture = Picture(means.astype(np.float32), samples.counts.astype(np.uint32), Grid(PIXELS, PIXELS, 1.0, 1.0))
    image = fill_holes(picture, FILL_RADIUS_PX)[0]
    return np.where(np.isfinite(image), image, nearest(samples, means))


def inpainted(samples: SplitSums, means: Array) -> Array:
    """OpenCV's Navier-Stokes inpainting."""
    import cv2

    holes = (samples.counts == 0).astype(np.uint8)
    return np.asarray(cv2.inpaint(np.nan_to_num(means).astype(np.float32), holes, 3, cv2.INPAINT_NS))


def biharmonic(samples: SplitSums, means: Array) -> Array:
    """scikit-image's biharmonic inpainting."""
    from skimage.restoration import inpaint_biharmonic

    scale = float(np.nanmax(means))
    return np.asarray(inpaint_biharmonic(np.nan_to_num(means) / scale, samples.counts == 0) * scale)


def total_variation(samples: SplitSums, means: Array, strength: float) -> Array:
    """Least squares with a total variation penalty, by accelerated proximal gradients (Beck & Teboulle 2009)."""
    from skimage.restoration import denoise_tv_chambolle

    weight = np.minimum(samples.counts, TV_WEIGHT_SAMPLES) / TV_WEIGHT_SAMPLES
    known, image = np.nan_to_num(means), nearest(samples, means)
    point, momentum = image, 1.0
    for _ in range(TV_ITERATIONS):
        following = denoise_tv_chambolle(point - weight * (point - known), weight=strength, max_num_iter=20)
        larger = 0.5 * (1.0 + np.sqrt(1.0 + 4.0 * momentum**2))
        point = following + (momentum - 1.0) / larger * (following - image)
        image, momentum = following, larger
    return image


FILLED: dict[str, Callable[[SplitSums, Array], Array]] = {
    "mean + nearest": nearest,
    f"--fill {FILL_RADIUS_PX}": filled,
    "OpenCV inpainting": inpainted,
    "biharmonic inpainting": biharmonic,
}

COLUMNS = (*FILLED, "tuned kernel", "tuned total variation", "kernel", "posterior")


def psnr(image: Array, scene: Array, photons: float) -> float:
    """Peak signal-to-noise ratio [dB]."""
    return float(-10 * np.log10(np.mean((image / photons - scene) ** 2)))


def coverage(image: Array, sd: Array, truth: Array, part: Array) -> float:
    """Fraction of the pixels of ``part`` whose 95 % interval holds the truth."""
    return float(np.mean(np.abs(image - truth)[part] < 1.96 * sd[part]))


def run_case(scene: Array, photons: float, seconds: float, seed: int) -> dict[str, float]:
    """PSNR by method, coverage of the intervals, fill and computing time."""
    pixel, counts = scan(scene, photons, seconds, seed)
    samples, noise = sum_samples(pixel, counts), measure_sample_noise(pixel, counts)
    if noise is None:
        raise ValueError("the scan has too few crossings")
    visited = samples.counts > 0
    means = np.where(visited, samples.sums / np.maximum(samples.counts, 1), np.nan)
    row = {"fill": float(visited.mean())}
    row |= {name: psnr(method(samples, means), scene, photons) for name, method in FILLED.items()}
    tuned = (kernel_mean(samples.sums, samples.counts, width) for width in TUNED_WIDTHS_PX)
    row["tuned kernel"] = max(psnr(image, scene, photons) for image in tuned)
    strengths = TV_STRENGTHS * np.sqrt(0.5 * photons)
    row["tuned total variation"] = max(
        psnr(total_variation(samples, means, each), scene, photons) for each in strengths
    )
    for name, method in (("kernel", kernel_picture), ("posterior", posterior_picture)):
        began = time.process_time()
        estimate = method(samples, noise)
        row[f"{name} ms"] = 1e3 * (time.process_time() - began)
        image = np.where(np.isfinite(estimate.image), estimate.image, nearest(samples, means))
        row[name] = psnr(image, scene, photons)
        for label, part in (("visited", visited), ("unvisited", ~visited)):
            row[f"{name} {label}"] = coverage(image, estimate.sd, photons * scene, part)
    return row


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("seeds", type=int, nargs="+")
    parser.add_argument("--scenes", default=",".join(SCENES))
    args = parser.parse_args()
    scenes = {name: load_scene(name) for name in args.scenes.split(",")}
    run_case(next(iter(scenes.values())), 10.0, 0.005, 0)  # compiles
    print("| photons, time | scene | " + " | ".join(("fill", *COLUMNS)), end="")
    print(" | least gain | kernel 95 % | posterior 95 % | posterior ms |")
    print("|---" * (len(COLUMNS) + 7) + "|")
    for photons, seconds in CONDITIONS:
        rows = []
        for name, scene in scenes.items():
            runs = [run_case(scene, photons, seconds, seed) for seed in args.seeds]
            rows.append({key: float(np.mean([run[key] for run in runs])) for key in runs[0]})
            rows[-1]["gain"] = min(run["posterior"] - run["tuned kernel"] for run in runs)
            print(_format(f"{photons:g}, {1e3 * seconds:g} ms", name, rows[-1]), flush=True)
        mean = {key: float(np.mean([row[key] for row in rows])) for key in rows[0]}
        mean["gain"] = min(row["gain"] for row in rows)
        print(_format(f"{photons:g}, {1e3 * seconds:g} ms", "**mean**", mean), flush=True)


def _format(condition: str, name: str, row: dict[str, float]) -> str:
    values = [f"{row['fill']:.0%}", *(f"{row[key]:.2f}" for key in (*COLUMNS, "gain"))]
    intervals = [
        f"{100 * row[f'{k} visited']:.1f} / {100 * row[f'{k} unvisited']:.1f}" for k in ("kernel", "posterior")
    ]
    return "| " + " | ".join([condition, name, *values, *intervals, f"{row['posterior ms']:.0f}"]) + " |"


if __name__ == "__main__":
    main()
