"""Measured scans with a part left out: how well pictures of the rest predict it.

An AFM spiral of which every fourth turn is used, and the rows of one direction of a two-photon frame of which every
second one is used. The error is that in the pixels left out, against their measured values. Pitch and profile of the
grating in the pictures of the spiral are compared with those in the raster scan of the same grating.
Run: python -m benchmarks.sparse_measured DATA
"""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.ndimage import distance_transform_edt

from estimation.estimate import estimate
from recon.imaging.intensity_gridding import grid_intensity
from recon.imaging.picture import Grid, Picture
from recon.imaging.picture_kinds.held_out import SplitSums
from recon.imaging.picture_kinds.kernel_picture import kernel_picture
from recon.imaging.picture_kinds.picture_estimate import estimate_picture
from recon.imaging.picture_kinds.posterior_picture import posterior_picture
from recon.imaging.pixel_noise import SampleNoise, measure_noise
from recon.io.convert import convert
from scanner.arrays import Array

EXAMPLES = Path(__file__).parent.parent / "examples"
MAPPING = EXAMPLES / "afm_spiral.toml"
ESTIMATORS = {"kernel": kernel_picture, "posterior": posterior_picture}
TURN_SAMPLES = 1000
PIXELS = 128
PHASE_BINS = 16
"""Parts of a period of the grating in which its profile is averaged."""

ROW_NOISE = SampleNoise(0.0, 1.2, 0.0)
"""Noise of the two-photon frame, which has no repeated visits: from the differences of a row to the mean of its two
neighbours, which is an upper bound."""


def rms(values: Array) -> float:
    return float(np.sqrt(np.mean(values**2)))


def nearest(image: Array, visited: Array) -> Array:
    """The image, with the value of the nearest visited pixel in the others."""
    rows, columns = distance_transform_edt(~visited, return_distances=False, return_indices=True)
    return np.asarray(image[rows, columns])


def grating_profile(picture: Picture) -> tuple[str, Array]:
    """Pitch of the grating with its standard deviation, and height by phase [nm], shape (``PHASE_BINS``,)."""
    sys.path.insert(0, str(EXAMPLES))
    from grating import _pixels, _profile, _solve, _surface, fit_grating

    grating = fit_grating(picture)
    x, y, height = _pixels(picture)
    phase, surface = 2 * np.pi * (grating.wave @ [x, y]), _surface(x, y)
    both = np.concatenate([surface, _profile(phase)], axis=1)
    flat = height - surface @ _solve(both, height)[: surface.shape[1]]
    clean = np.abs(flat) < 4 * 1.4826 * np.median(np.abs(flat))  # dust
    cosine, sine = _solve(_profile(phase), flat)[:2]
    bins = ((phase - np.arctan2(sine, cosine)) / (2 * np.pi) % 1.0 * PHASE_BINS).astype(int)
    heights = np.array([flat[clean & (bins == k)].mean() for k in range(PHASE_BINS)])
    return f"{grating.pitch:.3f} ± {grating.pitch_sd:.3f} µm", heights


def afm_spiral(file: Path) -> None:
    """Print the error in the pixels of the turns left out [nm], the fraction of intervals that hold them, and the
    grating."""
    sys.path.insert(0, str(EXAMPLES))
    from afm_spiral import raster_picture

    pitch, raster = grating_profile(raster_picture(file.with_name("raster_20hz.mat")))
    print(f"AFM raster: pitch {pitch}")
    with convert(file, MAPPING) as recording:
        assert recording.device is not None
        scan, motion, height = recording.device.require_scan(), estimate(recording), recording["intensity"]
        grid = Grid(PIXELS, PIXELS, scan.half_angle_x, scan.half_angle_y)
        turns = range(0, height.size, TURN_SAMPLES)
        left_out = [(first, min(first + TURN_SAMPLES, height.size)) for k, first in enumerate(turns) if k % 4]
        whole, part = grid_intensity(motion, height, grid, []), grid_intensity(motion, height, grid, left_out)
        noise = measure_noise(motion, height, grid)
        tested = (whole.coverage > 0) & (part.coverage == 0)
        print(f"AFM spiral, nearest: {rms((nearest(part.image, part.coverage > 0) - whole.image)[tested]):.2f} nm")
        for kind in ESTIMATORS:
            estimated = estimate_picture(kind, part, noise, motion, height, left_out)
            valid = tested & np.isfinite(estimated.picture.image)
            error = (estimated.picture.image - whole.image)[valid]
            held = np.mean(np.abs(error) < 1.96 * estimated.sd[valid])
            print(f"AFM spiral, {kind}: {rms(error):.2f} nm, {held:.1%} within 95 % intervals")
            inside = (whole.coverage > 0) & np.isfinite(estimated.picture.image)
            pitch, profile = grating_profile(replace(estimated.picture, coverage=inside.astype(np.uint32)))
            away, sd = profile - raster, float(np.median(estimated.sd[inside]))
            print(f"  pitch {pitch}, profile {rms(away):.1f} nm rms and {np.abs(away).max():.1f} nm at most from the")
            print(f"  raster's; sd of a pixel {sd:.1f} nm")
        print(f"AFM spiral, mean of all turns: pitch {grating_profile(whole)[0]}")


def two_photon(file: Path) -> None:
    """Print the error in the rows left out, in counts."""
    rows = np.load(file).astype(float)[::2]
    kept = np.arange(len(rows)) % 2 == 0
    counts = np.repeat(kept[:, None], rows.shape[1], axis=1).astype(float)
    segments = np.arange(rows.shape[1]) // 32 + 16 * np.arange(len(rows))[:, None]
    held = counts * (segments % 11 == 0)
    samples = SplitSums(rows * counts, counts, rows * held, held)
    between = 0.5 * (np.roll(rows, 1, axis=0) + np.roll(rows, -1, axis=0))
    inner = np.flatnonzero(~kept)[:-1]
    print(f"two-photon rows, linear: {rms((between - rows)[inner]):.2f}")
    for kind, estimator in ESTIMATORS.items():
        print(f"two-photon rows, {kind}: {rms((estimator(samples, ROW_NOISE).image - rows)[inner]):.2f}")


def main(data: Path) -> None:
    afm_spiral(data / "afm_spiral" / "spiral_20hz.mat")
    two_photon(data / "two_photon_bidirectional" / "raw.npy")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
