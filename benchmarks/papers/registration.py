"""chen2020 II-A and fig 10: a real tissue picture, 400 x 400, mapped with a wrong phase of the fast axis.

Phase errors as in the paper: none, 0.38 degrees (UKF), 2.73 degrees (model), and 0.745 degrees (between its laboratory
phase and the phase adjusted by hand). The results are the displacement in pixels against the bound p/m, and the phase
error that is measured from forward and backward sweeps of the picture alone.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from benchmarks.papers.figures import Results, entry, figure
from benchmarks.papers.phase import rms
from phantoms.optics import Detector, blur_by_spot, detect, sample_scene
from phantoms.targets import load_tissue
from recon.imaging.blur import compare_with_scene, phase_bound
from recon.imaging.gridding import map_samples
from recon.imaging.picture import Grid, Picture
from recon.imaging.scan_phase.bidirectional_phase import measure_phase_errors
from recon.report.figures import fill_small_holes
from scanner.arrays import Array

RATE, DURATION = 5e6, 0.2
FREQUENCIES = 27680.0, 6540.0  # of the motion, as printed
FIELD_UM, PIXELS, HALF_ANGLE = 250.0, 400, 0.18
ERRORS_DEG = (0.0, 0.38, 0.745, 2.73)
SEED = 10


@dataclass(frozen=True)
class Scan:
    """A simulated scan: phases of both axes [rad], and the intensity at the true angles."""

    phase_x: Array
    phase_y: Array
    intensity: Array
    scene: Array


def simulate_scan(duration: float = DURATION, seed: int = SEED) -> Scan:
    time = np.arange(round(duration * RATE)) / RATE
    phase_x, phase_y = (2 * np.pi * f * time + phase for f, phase in zip(FREQUENCIES, (0.4, 1.1), strict=True))
    scene = blur_by_spot(load_tissue(), 0.4, FIELD_UM, FIELD_UM)
    angles = (HALF_ANGLE * np.sin(phase) for phase in (phase_x, phase_y))
    light = sample_scene(scene, *angles, HALF_ANGLE, HALF_ANGLE)
    detector = Detector(photons_per_sample=1000.0, bits=12)
    return Scan(phase_x, phase_y, detect(light, RATE, detector, np.random.default_rng(seed)).astype(np.float64), scene)


@dataclass(frozen=True)
class MappedPicture:
    """A picture mapped with a wrong phase, its displacement [px] and the error measured by registration [deg]."""

    picture: Picture
    largest_px: float
    rms_px: float
    measured_deg: float
    measured_sd_deg: float
    error: float


def map_with_phase_error(scan: Scan, error_deg: float, pixels: int = PIXELS) -> MappedPicture:
    """The picture of a scan, mapped with a phase of x that lags the true one by ``error_deg``."""
    grid = Grid(pixels, pixels, HALF_ANGLE, HALF_ANGLE)
    x, y = HALF_ANGLE * np.sin(scan.phase_x - np.deg2rad(error_deg)), HALF_ANGLE * np.sin(scan.phase_y)
    picture = map_samples(x, y, scan.intensity, grid)
    displacement = 0.5 * pixels * (np.sin(scan.phase_x) - x / HALF_ANGLE)
    (registered,) = measure_phase_errors(x, y, scan.intensity, RATE, grid, HALF_ANGLE, HALF_ANGLE)
    sharpness = compare_with_scene(picture, scan.scene).rms
    measured = np.rad2deg(registered.x.value), np.rad2deg(registered.x.sd)
    return MappedPicture(picture, float(np.abs(displacement).max()), rms(displacement), *measured, sharpness)


def results() -> Results:
    """Entries of ``results.json``; draws fig 10."""
    scan = simulate_scan()
    pictures = {error: map_with_phase_error(scan, error) for error in ERRORS_DEG}
    out: Results = {}
    for error, picture in pictures.items():
        key, m = f"chen2020.fig10.error_{error:g}_deg", PIXELS / 2
        out[f"{key}.largest_displacement_px"] = entry(m * np.deg2rad(error), picture.largest_px, 1, SEED)
        out[f"{key}.rms_displacement_px"] = entry(None, picture.rms_px, 1, SEED)
        out[f"{key}.picture_rms_error"] = entry(None, picture.error, 1, SEED)
        out[f"{key}.found_by_registration_deg"] = entry(
            error, picture.measured_deg, 1, SEED, sd_deg=picture.measured_sd_deg
        )
    for p, paper in ((1, 0.29), (2, 0.57)):
        out[f"chen2020.eq7.bound_400px_p{p}_deg"] = entry(paper, np.rad2deg(phase_bound(p, PIXELS / 2)), 1, 0)
    out["chen2020.eq7.bound_300px_p1_deg"] = entry(0.38, np.rad2deg(phase_bound(1, 150)), 1, 0)
    draw(pictures)
    return out


def draw(pictures: dict[float, MappedPicture]) -> None:
    with figure("chen2020_fig10", columns=len(pictures), size=(13.0, 3.7)) as axes:
        for drawn, (error, picture) in zip(axes[0], pictures.items(), strict=True):
            drawn.imshow(fill_small_holes(picture.picture)[120:280, 120:280], cmap="gray")
            drawn.set(
                title=f"{error:g}° off: {picture.largest_px:.2f} px\nmeasured {picture.measured_deg:.3f}°",
                xticks=[],
                yticks=[],
            )
