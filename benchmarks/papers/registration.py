"""chen2020 II-A and fig 10: a real tissue picture, 400 x 400, mapped with a wrong phase of the fast axis.

Errors as in the paper: none, the UKF's 0.38 degrees, the model's 2.73, and the 0.745 degrees between its laboratory
phase and the one that it found by hand. Each picture comes with its blur in pixels against p/m, and the phase error
that forward and backward sweeps tell from the picture's samples alone.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from benchmarks.papers.figures import Results, entry, figure
from benchmarks.papers.phase import rms
from phantoms.optics import Detector, blur, detect, sample
from phantoms.targets import tissue
from recon.blur import bound, picture_error
from recon.mapping import Grid, Picture, map_samples
from recon.registration import phase_error
from recon.views import visible

Array = NDArray[np.float64]

RATE, DURATION = 5e6, 0.2
FREQUENCIES = 27680.0, 6540.0  # of the motion, as printed
FIELD_UM, PIXELS, HALF_ANGLE = 250.0, 400, 0.18
ERRORS_DEG = (0.0, 0.38, 0.745, 2.73)
SEED = 10


@dataclass(frozen=True)
class Scan:
    """Half the phase-free angles: turns of both axes [rad], and the intensity seen at the true angles."""

    turn_x: Array
    turn_y: Array
    intensity: Array
    scene: Array


def scan(duration: float = DURATION, seed: int = SEED) -> Scan:
    time = np.arange(round(duration * RATE)) / RATE
    turn_x, turn_y = (2 * np.pi * f * time + phase for f, phase in zip(FREQUENCIES, (0.4, 1.1), strict=True))
    scene = blur(tissue(), 0.4, FIELD_UM, FIELD_UM)
    angles = (HALF_ANGLE * np.sin(turn) for turn in (turn_x, turn_y))
    light = sample(scene, *angles, HALF_ANGLE, HALF_ANGLE)
    detector = Detector(photons_per_sample=1000.0, bits=12)
    return Scan(turn_x, turn_y, detect(light, RATE, detector, np.random.default_rng(seed)).astype(np.float64), scene)


@dataclass(frozen=True)
class Mapped:
    """A picture made with a wrong phase, its displacement [px] and the error that registration finds [deg]."""

    picture: Picture
    largest_px: float
    rms_px: float
    found_deg: float
    found_sd_deg: float
    error: float


def mapped(of: Scan, error_deg: float, pixels: int = PIXELS) -> Mapped:
    """The true motion is ``error_deg`` ahead of the phase that the picture is mapped with."""
    grid = Grid(pixels, pixels, HALF_ANGLE, HALF_ANGLE)
    x, y = HALF_ANGLE * np.sin(of.turn_x - np.deg2rad(error_deg)), HALF_ANGLE * np.sin(of.turn_y)
    picture = map_samples(x, y, of.intensity, grid)
    moved = 0.5 * pixels * (np.sin(of.turn_x) - x / HALF_ANGLE)
    (found,) = phase_error(x, y, of.intensity, RATE, grid, HALF_ANGLE, HALF_ANGLE)
    sharpness = picture_error(picture, of.scene).rms
    told = np.rad2deg(found.x.value), np.rad2deg(found.x.sd)
    return Mapped(picture, float(np.abs(moved).max()), rms(moved), *told, sharpness)


def results() -> Results:
    """Entries of ``results.json``, and fig 10."""
    of = scan()
    pictures = {error: mapped(of, error) for error in ERRORS_DEG}
    out: Results = {}
    for error, made in pictures.items():
        key, m = f"chen2020.fig10.error_{error:g}_deg", PIXELS / 2
        out[f"{key}.largest_displacement_px"] = entry(m * np.deg2rad(error), made.largest_px, 1, SEED)
        out[f"{key}.rms_displacement_px"] = entry(None, made.rms_px, 1, SEED)
        out[f"{key}.picture_rms_error"] = entry(None, made.error, 1, SEED)
        out[f"{key}.found_by_registration_deg"] = entry(error, made.found_deg, 1, SEED, sd_deg=made.found_sd_deg)
    for p, paper in ((1, 0.29), (2, 0.57)):
        out[f"chen2020.eq7.bound_400px_p{p}_deg"] = entry(paper, np.rad2deg(bound(p, PIXELS / 2)), 1, 0)
    out["chen2020.eq7.bound_300px_p1_deg"] = entry(0.38, np.rad2deg(bound(1, 150)), 1, 0)
    draw(pictures)
    return out


def draw(pictures: dict[float, Mapped]) -> None:
    with figure("chen2020_fig10", columns=len(pictures), size=(13.0, 3.7)) as axes:
        for drawn, (error, made) in zip(axes[0], pictures.items(), strict=True):
            drawn.imshow(visible(made.picture)[120:280, 120:280], cmap="gray")
            drawn.set(
                title=f"{error:g}° off: {made.largest_px:.2f} px\nfound {made.found_deg:.3f}°", xticks=[], yticks=[]
            )
