"""Checks of a raster film before its line phase is used: repeated lines, saturated pixels, lines along the columns."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from estimation.rail import upper_rail
from recon.imaging.raster.film_phase import FilmModel, fit_film, own_phase
from scanner.errors import BadInput

MAX_REPEATED_LINES = 0.25
"""Share of lines that equal the line before from which they are repeated: half the share in a film whose lines all
stand twice."""

MIN_COLUMN_SHIFT_SDS = 5.0
"""Displacement of alternate columns in standard errors of a frame from which the lines are taken to run along the
columns. Chance exceeds it in one film of a million; a specimen may deviate further than noise."""

Frames = Sequence[Sequence[NDArray[np.float32]]]
"""Sampled frames, each a list of planes of shape (rows, columns) by detector."""


def check_repeated_lines(path: Path, frames: Frames) -> None:
    """Refuse a film in which lines are repeated, so that neighbours have no phase between them.

    Raises:
        BadInput: they are.
    """
    planes = np.stack([plane for frame in frames for plane in frame])
    varied = np.ptp(planes[:, 1:], axis=2) > 0.0
    share = float(np.mean((planes[:, 1:] == planes[:, :-1]).all(axis=2) & varied))
    if share > MAX_REPEATED_LINES:
        what = f"{share:.0%} of its lines equal the line before in every pixel"
        raise BadInput(what, file=path, hint="keep one of each; a line phase needs every line as it was recorded")


def describe_saturation(frames: Frames) -> list[str]:
    """A note for every detector that is saturated."""
    notes = []
    for detector, planes in enumerate(zip(*frames, strict=True)):
        pixels = np.concatenate([plane.ravel() for plane in planes])
        if (rail := upper_rail(pixels)) is not None:
            name = f" of detector {detector}" if len(frames[0]) > 1 else ""
            notes.append(
                f"{100 * rail[1] / pixels.size:.2g} % of the pixels{name} are at the top value {rail[0]:g}, where it "
                "is saturated: they are lower bounds; record with less gain or light"
            )
    return notes


def describe_columns(frames: Frames, model: FilmModel) -> list[str]:
    """A note if alternate columns are displaced as alternate lines of a film are, and lines are not.

    Args:
        model: fitted to the frames.
    """
    turned = [[np.ascontiguousarray(plane.T) for plane in frame] for frame in frames]
    try:
        shift, sd = _typical_phase(turned, fit_film(turned))
    except BadInput:  # the columns have no phase that can be measured
        return []
    own, own_sd = _typical_phase(frames, model)
    if not abs(shift) / sd > max(MIN_COLUMN_SHIFT_SDS, abs(own) / own_sd):
        return []
    return [
        f"alternate columns are displaced by {shift:.2f} ± {sd:.2f} pixels and alternate lines by {own:.2f} ± "
        f"{own_sd:.2f}: the lines seem to run along the columns; transpose the frames"
    ]


def _typical_phase(frames: Frames, model: FilmModel) -> tuple[float, float]:
    """Median line phase of the frames and standard error of one of them [px]; (nan, nan) if none determines it."""
    phases = [own_phase(list(frame), model, model.typical) for frame in frames]
    found = [(phase.shift, phase.sd) for phase in phases if np.isfinite(phase.shift)]
    shift, sd = np.median(found, axis=0) if found else (np.nan, np.nan)
    return float(shift), float(sd)
