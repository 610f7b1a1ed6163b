"""Comparison of what the commands of ``benchmarks.first_pictures`` wrote with the hidden truth."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

import h5py
import numpy as np
import tifffile

from recon.evaluation import AxisEvaluation, evaluate_axis
from recon.imaging.blur import compare_with_scene
from recon.imaging.gridding import map_samples
from recon.imaging.picture import Grid, Picture
from scanner.angle_tracks import SampledAngle
from scanner.arrays import Array
from scanner.motion import AxisMotion


@dataclass(frozen=True)
class Use:
    """Commands of one use, and the truth that its files do not contain.

    Attributes:
        commands: as typed, without the program's name.
        angles: true angles by axis, on the clock of the intensity [rad].
        light: intensity, shape (n,) or (n, detectors).
        scene: noiseless.
        half_angles: of the field [rad].
        rate: of the intensity [Hz].
        check: further cell of the table.
        score: the last cells of the table, where they are not those of one scan.
    """

    commands: list[str]
    angles: dict[str, Array]
    light: Array
    scene: Array
    half_angles: tuple[float, float]
    rate: float
    check: Callable[[Path], str] | None = None
    score: Callable[[Path], list[str]] | None = None


def load_axes(path: Path, use: Use) -> dict[str, AxisEvaluation]:
    """Evaluation of each axis of a motion file."""
    found = {}
    with h5py.File(path) as file:
        for axis, angle in use.angles.items():
            group = file[axis]
            slow = {name: group[name][()] for name in ("time", "phase", "amplitude", "frequency", "phase_sd")}
            clock = group["angle"].attrs
            track = SampledAngle(group["angle"][()].astype(float), float(clock["sample_rate"]), float(clock["start"]))
            found[axis] = evaluate_axis(AxisMotion(**slow, angle=track), angle, use.rate, 0.0)
    return found


def load_picture(out: Path) -> tuple[Array, Array]:
    """Image, mean of its detectors, and coverage of an output folder, shape (height, width) each."""
    coverage = tifffile.imread(out / "coverage.tif")
    image = tifffile.imread(out / "image.tif")
    if image.ndim > 2:
        image = image.mean(int(np.argmin(image.shape)))
    return image, coverage


def picture_ratio(use: Use, axes: Mapping[str, AxisEvaluation], image: Array, coverage: Array) -> float:
    """Error of a picture over that of the picture from the true angles, both against the scene."""
    grid = Grid(image.shape[1], image.shape[0], *use.half_angles)
    light = use.light if use.light.ndim == 1 else use.light.mean(1)
    true = map_samples(use.angles["x"], use.angles["y"], light, grid)
    found = Picture(image, coverage, grid)
    flips = (axes["x"].mirrored, axes["y"].mirrored)
    return compare_with_scene(found, use.scene, *flips).rms / compare_with_scene(true, use.scene).rms


def score_scan(use: Use, axes: Mapping[str, AxisEvaluation], image: Array, coverage: Array) -> list[str]:
    """Cells of the table: phase errors of both axes, picture error ratio."""
    phase = ", ".join(f"{np.degrees(axis.phase_rmse):.3f}°" for axis in axes.values())
    return [phase, f"{picture_ratio(use, axes, image, coverage):.3f}"]
