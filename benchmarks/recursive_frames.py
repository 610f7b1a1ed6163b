"""Gain of a posterior picture from ten earlier frames, for scenes at rest, moving and changing.

Scenes and scans are those of :mod:`benchmarks.sparse_pictures`; each frame has its own phases and photons.
The sequences are:

- rest: the scene does not change;
- moving: it moves 0.3 pixels a frame, to the right and down;
- part: before the last frame but four, a rectangle of 60 x 70 pixels gets another part of the scene;
- whole: before the last frame, the scene is turned upside down.

The gain is the PSNR of the last frame with ten earlier ones less its PSNR by itself. Coverage is the fraction of the
pixels whose 95 % interval holds the truth: of the last frame, and, for part, of the rectangle in the frame in which it
changes, with earlier frames and without.
Run: python -m benchmarks.recursive_frames SEED... [--scenes NAME,...]
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable

import numpy as np
from scipy.ndimage import shift

from benchmarks.sparse_pictures import SCENES, coverage, load_scene, psnr, scan, sum_samples
from recon.imaging.picture_kinds.recursive_frames import recursive_picture
from recon.imaging.pixel_noise import measure_sample_noise
from scanner.arrays import Array

FRAMES = 11
SHIFT_PX = 0.18, 0.24
"""Motion from frame to frame, down and to the right: 0.3 pixels."""

RECTANGLE = slice(90, 150), slice(100, 170)
REPLACED_BY = slice(170, 230), slice(20, 90)
PART_CHANGES_AT = 6

CONDITIONS = ((10.0, 0.005), (100.0, 0.010))
"""Photons in a sample of the brightest pixel, and duration of a frame [s]."""


def at_rest(scene: Array, frame: int) -> Array:
    return scene


def moving(scene: Array, frame: int) -> Array:
    moved = shift(scene, [frame * step for step in SHIFT_PX], order=3, mode="reflect")
    return np.asarray(moved.clip(0.0, 1.0))


def part(scene: Array, frame: int) -> Array:
    changed = scene.copy()
    if frame >= PART_CHANGES_AT:
        changed[RECTANGLE] = scene[REPLACED_BY]
    return changed


def whole(scene: Array, frame: int) -> Array:
    return scene[::-1] if frame == FRAMES - 1 else scene


SEQUENCES: dict[str, Callable[[Array, int], Array]] = {"rest": at_rest, "moving": moving, "part": part, "whole": whole}


def run_sequence(sequence: str, scene: Array, photons: float, seconds: float, seed: int) -> dict[str, float]:
    """Gain, coverage and relative cost of one sequence."""
    carried, row = None, {}
    everywhere, rectangle = np.ones(scene.shape, bool), np.zeros(scene.shape, bool)
    rectangle[RECTANGLE] = True
    for frame in range(FRAMES):
        truth = SEQUENCES[sequence](scene, frame)
        pixel, counts = scan(truth, photons, seconds, FRAMES * seed + frame)
        samples, noise = sum_samples(pixel, counts), measure_sample_noise(pixel, counts)
        if noise is None:
            raise ValueError("the scan has too few crossings")
        began = time.process_time()
        estimate, carried = recursive_picture(samples, noise, carried)
        took = time.process_time() - began
        if sequence == "part" and frame == PART_CHANGES_AT:
            row["rectangle"] = coverage(estimate.image, estimate.sd, photons * truth, rectangle)
            single = recursive_picture(samples, noise, None)[0]
            row["single rectangle"] = coverage(single.image, single.sd, photons * truth, rectangle)
    began = time.process_time()
    single, _ = recursive_picture(samples, noise, None)
    row["cost"] = took / (time.process_time() - began)
    row["single"] = psnr(np.nan_to_num(single.image), truth, photons)
    row["gain"] = psnr(estimate.image, truth, photons) - row["single"]
    row["single held"] = coverage(single.image, single.sd, photons * truth, everywhere)
    row["held"] = coverage(estimate.image, estimate.sd, photons * truth, everywhere)
    return row


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("seeds", type=int, nargs="+")
    parser.add_argument("--scenes", default=",".join(SCENES))
    args = parser.parse_args()
    scenes = {name: load_scene(name) for name in args.scenes.split(",")}
    run_sequence("rest", next(iter(scenes.values())), 10.0, 0.005, 0)  # compiles
    print(
        "| sequence | photons, time | single frame [dB] | gain [dB], mean (least) | 95 % single | 95 %, mean (range) |",
        end="",
    )
    print(" 95 % in what changes; single frame | cost in single frames |")
    print("|---" * 8 + "|")
    for sequence in SEQUENCES:
        for photons, seconds in CONDITIONS:
            rows = [
                run_sequence(sequence, scene, photons, seconds, seed)
                for scene in scenes.values()
                for seed in args.seeds
            ]
            print(_format(sequence, f"{photons:g}, {1e3 * seconds:g} ms", rows), flush=True)


def _format(sequence: str, condition: str, rows: list[dict[str, float]]) -> str:
    by_key = {key: np.array([row[key] for row in rows]) for key in rows[0]}
    held = 100 * by_key["held"]
    changed = ""
    if "rectangle" in by_key:
        own, single = 100 * by_key["rectangle"], 100 * by_key["single rectangle"]
        changed = f"{own.mean():.1f} ({own.min():.1f}–{own.max():.1f}); {single.mean():.1f}"
    values = [
        f"{by_key['single'].mean():.2f}",
        f"{by_key['gain'].mean():+.2f} ({by_key['gain'].min():+.2f})",
        f"{100 * by_key['single held'].mean():.1f}",
        f"{held.mean():.1f} ({held.min():.1f}–{held.max():.1f})",
        changed,
        f"{np.median(by_key['cost']):.2f}",
    ]
    return "| " + " | ".join([sequence, condition, *values]) + " |"


if __name__ == "__main__":
    main()
