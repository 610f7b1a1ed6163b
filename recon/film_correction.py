"""Line phase of every frame of a film, and the film corrected by it, frame by frame."""

from __future__ import annotations

import csv
import sys
import time
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from recon.imaging.raster.film_checks import check_repeated_lines, describe_columns, describe_saturation
from recon.imaging.raster.film_equations import PooledEquations
from recon.imaging.raster.film_phase import FilmModel, fit_film, frame_phase, share_equations, with_reference
from recon.imaging.raster.line_phase import BLOCKS_ACROSS, MAX_SHIFT_SD_PX
from recon.imaging.raster.line_shift import correct_frame, to_dtype
from recon.imaging.raster.phase_smoothing import smooth_phases
from recon.io.film import Film, write_film
from recon.io.output import finite
from scanner.arrays import Array
from scanner.errors import BadInput
from scanner.wording import counted

SAMPLED_FRAMES = 16
"""Frames, spread over the film, that determine the smoothing and where the fit of the fill begins."""

REFERENCE_FRAMES = 64
"""Frames, spread over the film, whose mean is the reference. It has 1/64 of the noise of a frame, so that at 20 photons
a pixel its gradient adds less than 2 % to the standard error."""

MAX_ROWS_GROWTH = 1.01
"""Difference of lines and their neighbours, corrected over recorded, from which a note says that the correction made it
larger. Without a shift the two are equal."""

Item = TypeVar("Item")

MIN_SIDE_PX = 2 * BLOCKS_ACROSS
"""Least number of lines and columns: two in each of the blocks whose scatter gives the standard error."""


@dataclass(frozen=True)
class CorrectedFilm:
    """Line phase of a film and the account of its correction.

    Attributes:
        film: as recorded.
        model: what the frames share.
        shift, sd: of each frame after smoothing over time [px], shape (frames,).
        measured, measured_sd: of each frame before smoothing [px]; (nan, inf) where it determines none.
        before, after: picture of one frame as recorded and corrected, summed over channels, shape (rows, columns); of
            the sampled frames the one that determines its phase best, as others may be blank.
        rows_rms: root mean square of the lines less the mean of their neighbours in the sampled frames: as recorded,
            corrected, and corrected by the same shift in all columns.
        counts: totals of the film, of the corrected film, and of what lay beyond the border.
        clipped: pixels that did not fit into the film's type.
        doubts: notes on films that are not as they should be: saturated pixels, lines along the columns.
        means: the pixels hold means, and no totals are kept.
        seconds: computing time.
    """

    film: Film
    model: FilmModel
    shift: Array
    sd: Array
    measured: Array
    measured_sd: Array
    before: Array
    after: Array
    rows_rms: tuple[float, float, float]
    counts: tuple[float, float, float]
    clipped: int
    doubts: list[str]
    means: bool
    seconds: float

    @property
    def undetermined(self) -> int:
        """Number of frames that do not determine their own phase."""
        return int(np.count_nonzero(~np.isfinite(self.measured)))

    def write_phases(self, path: Path) -> None:
        """Write phase.csv: a line a frame."""
        columns = (self.shift, self.sd, self.measured, self.measured_sd)
        with path.open("w", newline="", encoding="utf-8") as file:
            writer = csv.writer(file)
            writer.writerow(["frame", "shift_px", "sd_px", "measured_px", "measured_sd_px"])
            for k, values in enumerate(zip(*columns, strict=True)):
                writer.writerow([k, *(f"{value:.5f}" if np.isfinite(value) else "" for value in values)])

    def summary(self) -> dict[str, Any]:
        """Content of summary.json."""
        fill = self.model.fill
        per_degree = np.degrees(fill / self.film.shape[-1]) if fill else None
        rows, columns = self.film.shape[-2:]
        content = {
            "frames": self.film.frames,
            "channels": self.film.channels,
            "lines": rows,
            "columns": columns,
            "shift_px": {
                "median": np.median(self.shift),
                "min": self.shift.min(),
                "max": self.shift.max(),
                "sd": np.median(self.sd),
            },
            "phase_deg": None if per_degree is None else np.median(self.shift) * per_degree,
            "lag": "follows the speed of a sinusoidal sweep" if fill else "the same in all columns",
            "fill_fraction": {"value": fill, "sd": self.model.fill_sd} if fill else None,
            "rows_rms": dict(zip(("recorded", "corrected", "one_shift_for_all_columns"), self.rows_rms, strict=True)),
            "values": "means" if self.means else "counts",
            "counts": None
            if self.means
            else dict(zip(("recorded", "corrected", "beyond_border"), self.counts, strict=True)),
            "undetermined": self.undetermined,
            "notes": self._notes(),
            "seconds": self.seconds,
        }
        summary: dict[str, Any] = finite(content)
        return summary

    def _notes(self) -> list[str]:
        notes, rows = list(self.doubts), self.film.shape[-2]
        border = int(np.ceil(np.abs(self.shift).max() / 2))
        if border:
            data = "NaN or 0" if self.means else "part of the counts"
            wide = counted(border, "column")
            notes.append(f"a border of up to {wide} was recorded in one direction only ({data} in there)")
        if rows % 2:
            notes.append(
                f"the number of lines, {rows}, is odd: if frames begin in alternate directions, the shift alternates "
                "in sign; each frame is corrected by its own"
            )
        if self.undetermined:
            notes.append(
                f"frames that do not determine their own phase to {MAX_SHIFT_SD_PX} pixels: {self.undetermined} of "
                f"{self.film.frames}; they are corrected by that of the frames around them"
            )
        if self.rows_rms[1] > MAX_ROWS_GROWTH * self.rows_rms[0]:
            notes.append(
                "the lines differ more after the correction: these values are no counts, but lie on a baseline or are "
                "means; use --values means, or subtract the baseline"
            )
        if self.clipped:
            notes.append(
                f"{counted(self.clipped, 'pixel')} of the corrected film clipped to the range of {self.film.dtype}"
            )
        return notes


def correct_film(film: Film, output: Path, means: bool = False, quiet: bool = False) -> CorrectedFilm:
    """Measure the line phase of every frame, write the corrected film, and return the account.

    One frame is in memory at a time, besides ``SAMPLED_FRAMES`` at the beginning. The file is read three times, and
    ``REFERENCE_FRAMES`` of it once more.

    Args:
        film: to correct.
        output: path of the corrected film (TIFF).
        means: the pixels hold means over their time, not counts.
        quiet: show no progress.

    Raises:
        BadInput: the frames are too small, damaged, or do not determine a line phase.
    """
    began = time.perf_counter()
    rows, columns = film.shape[-2:]
    if min(rows, columns) < MIN_SIDE_PX:
        what = f"has frames of {rows} lines of {columns} pixels"
        raise BadInput(what, file=film.path, hint=f"at least {MIN_SIDE_PX} of each are needed")
    sampled = _spread(film.frames, SAMPLED_FRAMES)
    samples = [_as_channels(frame) for frame in film.read(sampled)]
    check_repeated_lines(film.path, samples)
    try:
        model = fit_film(samples)
    except BadInput as error:
        error.file = film.path
        raise
    doubts = [*describe_columns(samples, model), *describe_saturation(samples)]
    members = _spread(film.frames, REFERENCE_FRAMES)
    frames = _progress(zip(members, film.read(members), strict=True), "reference", len(members), quiet)
    known = dict(zip(sampled, samples, strict=True))
    model = with_reference(model, ((k, _as_channels(frame)) for k, frame in frames), known)
    model, measured, measured_sd = _measure(film, model, quiet)
    shift, sd = _smooth(measured, measured_sd, rows, model.detail_sd)
    sd, measured_sd = (np.hypot(each, model.fill_error) for each in (sd, measured_sd))
    account = _Account()
    with tqdm(
        total=film.frames, desc="correct", unit="frame", file=sys.stderr, leave=False, disable=quiet or None
    ) as bar:
        write_film(output, film, _corrected_planes(film, shift, model.fill**2, means, account, bar))
    shown = int(np.argmin(measured_sd[sampled]))
    before: Array = np.asarray(np.sum(samples[shown], axis=0, dtype=np.float64))
    return CorrectedFilm(
        film=film,
        model=model,
        shift=shift,
        sd=sd,
        measured=measured,
        measured_sd=measured_sd,
        before=before,
        after=correct_frame(before, shift[sampled[shown]], model.fill**2, means)[0],
        rows_rms=_rows_rms(samples, shift[sampled], model.fill**2, means),
        counts=(account.recorded, account.corrected, account.beyond),
        clipped=account.clipped,
        doubts=doubts,
        means=means,
        seconds=time.perf_counter() - began,
    )


@dataclass
class _Account:
    """Totals that are added up while the film is written."""

    recorded: float = 0.0
    corrected: float = 0.0
    beyond: float = 0.0
    clipped: int = 0


def _as_channels(frame: NDArray[Any]) -> list[NDArray[np.float32]]:
    return [np.ascontiguousarray(plane, np.float32) for plane in frame]


def _spread(frames: int, count: int) -> list[int]:
    """At most ``count`` indices of frames, spread over the film."""
    return [int(k) for k in np.unique(np.linspace(0, frames - 1, min(frames, count)).round())]


def _progress(each: Iterable[Item], name: str, total: int, quiet: bool) -> Iterable[Item]:
    bar: Iterable[Item] = tqdm(each, name, total, unit="frame", file=sys.stderr, leave=False, disable=quiet or None)
    return bar


def _measure(film: Film, model: FilmModel, quiet: bool) -> tuple[FilmModel, Array, Array]:
    """The model with what all frames share, and line phase of each frame and its standard error [px], (frames,)."""
    value, sd, by_fill = np.full(film.frames, np.nan), np.full(film.frames, np.inf), np.full(film.frames, np.nan)
    pooled, before = PooledEquations(film.shape[-1], model.fill**2), model.typical
    for k, frame in enumerate(_progress(film.read(range(film.frames)), "measure", film.frames, quiet)):
        phase, equations = frame_phase(_as_channels(frame), k, model, before)
        value[k], sd[k] = phase
        by_fill[k] = pooled.add(phase, equations)
        if np.isfinite(phase.shift):
            before = phase.shift
    if not np.isfinite(value).any():
        raise BadInput("no frame determines a line phase", file=film.path)
    return *share_equations(model, pooled, value, by_fill), sd


def _smooth(value: Array, sd: Array, rows: int, shared_sd: float) -> tuple[Array, Array]:
    """Smooth over time; frames of an odd number of lines may alternate in direction, and are smoothed apart."""
    if rows % 2 == 0 or len(value) < 4 or not all(np.isfinite(value[k::2]).any() for k in (0, 1)):
        return smooth_phases(value, sd, shared_sd)
    smooth, smooth_sd = np.empty_like(value), np.empty_like(sd)
    for k in (0, 1):
        smooth[k::2], smooth_sd[k::2] = smooth_phases(value[k::2], sd[k::2], shared_sd)
    return smooth, smooth_sd


def _corrected_planes(
    film: Film, shift: Array, fill_squared: float, means: bool, account: _Account, bar: Any
) -> Iterator[NDArray[Any]]:
    """Yield the corrected planes in the film's order and type, and add up their totals."""
    for frame, distance in zip(film.read(range(film.frames)), shift, strict=True):
        for plane in frame:
            corrected, beyond = correct_frame(plane, distance, fill_squared, means)
            written, clipped = to_dtype(corrected, film.dtype, means)
            account.recorded += float(plane.sum(dtype=np.float64))
            account.corrected += float(np.nansum(written, dtype=np.float64))
            account.beyond += beyond
            account.clipped += clipped
            yield written
        bar.update()


def _rows_rms(
    samples: list[list[NDArray[np.float32]]], shift: Array, fill_squared: float, means: bool
) -> tuple[float, float, float]:
    """Lines less the mean of their neighbours, rms: recorded, corrected, corrected by one shift for all columns."""
    border = int(np.ceil(np.abs(shift).max() / 2)) + 1
    squares: tuple[list[float], ...] = ([], [], [])
    for frame, distance in zip(samples, shift, strict=True):
        for plane in frame:
            versions: list[NDArray[Any]] = [plane]
            versions += [correct_frame(plane, distance, each, means)[0] for each in (fill_squared, 0.0)]
            for own, picture in zip(squares, versions, strict=True):
                inner = picture[:, border:-border]
                own.append(float(np.mean(np.square(inner[1:-1] - (inner[:-2] + inner[2:]) / 2))))
    recorded, corrected, constant = (float(np.sqrt(np.mean(each))) for each in squares)
    return recorded, corrected, constant
