"""Line phase of simulated resonant raster films: this program beside two methods that microscopists use.

    python -m benchmarks.line_phase [--frames 40] [--photons 20] [--first SEED] [--bounds]

Films of 512 x 512 pixels whose phase drifts as a random walk. Each method's figure is the displacement between the two
directions that its correction leaves, rms over columns and frames. Whole-pixel phase correlation is one shift a film
from the averaged phase correlation of neighbouring lines, as suite2p's bidiphase. The package ``deinterlacing`` (MIT)
is run frame by frame if it is installed: its correlation and whole-pixel peak, refined by its parabola at that peak
(version 1.0.5 evaluates the parabola at another index, so that its own sub-pixel search returns whole pixels).
"""

from __future__ import annotations

import argparse
import tempfile
import warnings
from pathlib import Path

import cv2
import numpy as np
import tifffile
from scipy.ndimage import gaussian_filter, uniform_filter1d

from phantoms.raster_film import count_photons, scan_raster_frame
from phantoms.targets import TISSUES, load_tissue
from recon.film_correction import correct_film
from recon.imaging.raster.line_phase import column_places, lag_at
from recon.io.film import open_film
from scanner.arrays import Array

SIDE_PX = 512
PICTURE_PX = 1200
BLUR_PX = 1.0
"""Standard deviation of the spot [px of the film]."""
WALK_PX = 0.02
"""Standard deviation of the phase's step from frame to frame."""
FILLS = (0.0, 0.85)
MEAN_SHIFT_PX = 3.5
"""Mean size of the shift in the films, for the bound of the fill [px]."""
COMMON_SMOOTHING_PX = 8
"""Distance, and number of frequencies to either side, over which the differences of lines are averaged [px]."""


def draw_cells(seed: int) -> Array:
    """Soft bright discs of 8 to 16 pixels on a dark ground, as labelled cells, shape (PICTURE_PX, PICTURE_PX)."""
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[:PICTURE_PX, :PICTURE_PX]
    picture = np.full((PICTURE_PX, PICTURE_PX), 0.05)
    for _ in range(120):
        row, column, radius = *rng.uniform(0, PICTURE_PX, 2), rng.uniform(8.0, 16.0)
        picture += rng.uniform(0.2, 1.0) * np.exp(-((np.hypot(y - row, x - column) / radius) ** 4))
    return picture


def draw_scene(name: str, seed: int) -> Array:
    picture = draw_cells(seed) if name == "cells" else load_tissue(name, (PICTURE_PX, PICTURE_PX)) + 0.02
    return np.asarray(gaussian_filter(picture, BLUR_PX * PICTURE_PX / (1.1 * SIDE_PX)))


def whole_pixel_shift(film: Array) -> int:
    """Shift of the highest mean phase correlation between odd lines and the even ones before them [px]."""
    even, odd = (np.fft.fft(film[:, parity::2], axis=-1) for parity in (0, 1))
    cross = even * np.conj(odd)
    correlation = np.fft.ifft(cross / (np.abs(cross) + 1e-10)).real.mean(axis=(0, 1))
    shifts = np.arange(-30, 31)
    return -int(shifts[np.argmax(correlation[shifts])])


def deinterlacing_shifts(film: Array) -> Array | None:
    """Shift of each frame by the package ``deinterlacing`` [px]; None if it is not installed."""
    try:
        from deinterlacing.offsets import calculate_offset_matrix, find_pixel_offset
    except ModuleNotFoundError:
        return None
    shifts = []
    for frame in film:
        correlation = calculate_offset_matrix(frame[None].astype(np.float64))
        peak = int(find_pixel_offset(frame[None], correlation, 15))  # whole pixels; refined by a parabola
        middle = len(correlation) // 2 - peak
        before, at, after = correlation[middle - 1 : middle + 2]
        shifts.append(-peak + 0.5 * (before - after) / (before - 2 * at + after))
    return np.array(shifts)


def left_between(truth: Array, lag: Array, shifts: Array | float, own_lag: Array | float = 1.0) -> float:
    """Displacement that is left between the directions, rms over frames and columns [px]."""
    left = truth[:, None] * lag - np.broadcast_to(shifts, truth.shape)[:, None] * own_lag
    return float(np.sqrt(np.mean(np.square(left))))


def _bound(frame: Array, lag: Array, photons: float) -> float:
    """Cramér-Rao bound of the shift of one frame if the picture were known [px]."""
    counts = frame * (photons / frame.mean())
    return float(1.0 / np.sqrt(np.sum(np.square(lag * np.gradient(counts, axis=1)) / counts / 4.0)))


def _smoothed_bound(bound: float) -> float:
    """Bayesian bound of a frame far from both ends of a film whose phase walks by ``WALK_PX`` a frame [px].

    Args:
        bound: of one frame alone [px].

    Source:
        Integral of the error spectrum of the non-causal Wiener filter of a random walk in white noise.
    """
    walk, noise = WALK_PX**2, bound**2
    return float(np.sqrt(walk * noise / np.sqrt(walk**2 + 4.0 * walk * noise)))


def _common_bound(frame: Array, fill: float, shift: float, photons: float, frames: int) -> float:
    """Bound of an error common to all frames of a film whose picture and fill are not known [px].

    A line of one direction is compared with the mean of its neighbours of the other direction, all frames added up.
    What differs between lines of the picture is noise then, whose spectrum along the lines is that of the picture.

    Args:
        frame: mean brightness without a shift. shift: between the directions at the middle [px].
    """
    u, counts = column_places(SIDE_PX), frame * (photons / frame.mean())
    line, neighbours = counts[1:-1:2], 0.5 * (counts[:-2:2] + counts[2::2])
    photon_noise = 1.5 * line / frames
    scale = np.sqrt(gaussian_filter((line - neighbours) ** 2, COMMON_SMOOTHING_PX) + photon_noise)
    power = np.mean(np.abs(np.fft.fft((line - neighbours) / scale, axis=1)) ** 2, axis=0) / SIDE_PX
    power = uniform_filter1d(power + np.mean(photon_noise / scale**2), 2 * COMMON_SMOOTHING_PX + 1, mode="wrap")
    step = 1e-4
    by_fill = shift * (lag_at(u, fill**2 + step) - lag_at(u, fill**2)) / step
    slopes = [np.gradient(line, axis=1) * each / scale for each in ([lag_at(u, fill**2), by_fill] if fill else [1.0])]
    lines = [np.fft.fft(each, axis=1) / np.sqrt(SIDE_PX) for each in slopes]
    information = [[float(np.sum((a.conj() * b).real / power)) for b in lines] for a in lines]
    return float(np.sqrt(np.linalg.inv(information)[0, 0]))


def bounds(scene: str, fill: float, seed: int, frames: int, photons: float) -> list[str]:
    """One row of the table of bounds."""
    frame = scan_raster_frame(draw_scene(scene, seed), (SIDE_PX, SIDE_PX), 0.0, fill)
    smoothed = _smoothed_bound(_bound(frame, lag_at(column_places(SIDE_PX), fill**2), photons))
    common = _common_bound(frame, fill, MEAN_SHIFT_PX, photons, frames)
    return [scene, f"{fill:g}", *(f"{each:.4f}" for each in (smoothed, common, np.hypot(smoothed, common)))]


def measure(scene: str, fill: float, seed: int, frames: int, photons: float) -> list[str]:
    """One row of the table."""
    rng = np.random.default_rng(seed)
    picture = draw_scene(scene, seed)
    truth = rng.uniform(2.0, 5.0) * rng.choice([-1, 1]) + np.cumsum(rng.normal(0.0, WALK_PX, frames))
    ramp = float(rng.integers(0, 2))
    film = np.array(
        [
            count_photons(scan_raster_frame(picture, (SIDE_PX, SIDE_PX), shift, fill, ramp), photons, seed + k)
            for k, shift in enumerate(truth)
        ]
    )
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "film.tif"
        tifffile.imwrite(path, film, photometric="minisblack")
        result = correct_film(open_film(path), Path(folder) / "corrected.tif")
    u = column_places(SIDE_PX)
    lag = lag_at(u, fill**2)
    error, own = result.shift - truth, result.measured - truth
    package = deinterlacing_shifts(film)
    uncorrected = left_between(truth, lag, 0.0)
    bound = _bound(scan_raster_frame(picture, (SIDE_PX, SIDE_PX), 0.0, fill), lag, photons)
    figures = [
        uncorrected,
        left_between(truth, lag, float(whole_pixel_shift(film))),
        np.nan if package is None else left_between(truth, lag, package),
        left_between(truth, lag, result.shift, lag_at(u, result.model.fill**2)),
        bound,
        float(np.sqrt(np.nanmean(np.square(own)))),
        _smoothed_bound(bound),
        float(np.sqrt(np.mean(np.square(error)))),
        float(np.median(result.sd)),
    ]
    covered = np.mean(np.abs(error) < 1.96 * result.sd)
    covered_alone = np.mean(np.abs(own) < 1.96 * result.measured_sd)
    own_fill = f"{result.model.fill:.3f} ± {result.model.fill_sd:.3f}" if result.model.fill else "0"
    return [scene, f"{fill:g}", own_fill, *(f"{each:.3f}" for each in figures), f"{covered_alone:.0%}, {covered:.0%}"]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--frames", type=int, default=40)
    parser.add_argument("--photons", type=float, default=20.0)
    parser.add_argument("--first", type=int, default=0, metavar="SEED")
    parser.add_argument("--bounds", action="store_true", help="print bounds alone")
    args = parser.parse_args()
    cv2.setNumThreads(1)
    warnings.simplefilter("ignore", RuntimeWarning)
    head = ["scene", "fill", "measured", "uncorrected", "whole pixel", "deinterlacing", "lissajous"]
    head += ["bound of a frame", "error of a frame alone", "bound smoothed", "smoothed", "stated sd"]
    head += ["95 % intervals hold: alone, smoothed"]
    if args.bounds:
        head = ["scene", "fill", "smoothed, picture and fill known", "common, both unknown", "together"]
    print("| " + " | ".join(head) + " |\n|" + " --- |" * len(head))
    for k, scene in enumerate(("cells", *TISSUES)):
        for m, fill in enumerate(FILLS):
            row = (bounds if args.bounds else measure)(
                scene, fill, args.first + 1000 * (2 * k + m), args.frames, args.photons
            )
            print("| " + " | ".join(row) + " |", flush=True)


if __name__ == "__main__":
    main()
