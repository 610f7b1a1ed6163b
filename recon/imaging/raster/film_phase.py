"""Line phase of a film: what its frames share (the lag's shape, the smoothing), and the phase over time.

The lag's shape is first fitted to a sample of frames, each compared with its own lines. Frames that determine their
phase then form a reference picture (:mod:`recon.imaging.raster.film_reference`), with which all frames are compared.
What all frames share is determined by the sum of their equations.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from estimation.least_squares import Z_95
from recon.imaging.raster.film_equations import ColumnLag, PooledEquations
from recon.imaging.raster.film_reference import FilmReference, Frame, empty_reference
from recon.imaging.raster.line_phase import (
    MAX_FILL_SQUARED,
    MAX_SHIFT_SD_PX,
    SMOOTHING_SDS_PX,
    UNDETERMINED,
    Instrument,
    LinePhase,
    ShiftEquations,
    estimate_line_phase,
    search_shift,
    shift_equations,
    solve_line_phase,
    standard_errors,
)
from scanner.arrays import Array
from scanner.errors import BadInput

MIN_MIRRORED_GAIN = 0.2
"""By how much lines have to correlate better with their mirrored neighbours to be reported as not reversed."""

MAX_FILL_ITERATIONS = 20
"""Steps of the fill's iteration; about five are needed."""


@dataclass(frozen=True)
class FilmModel:
    """What all frames of a film share.

    Attributes:
        smoothing: standard deviation of the Gaussian for a frame's own lines that gives the least standard error [px].
        own_sd: median standard error of the sampled frames that determine their phase, each by itself [px].
        fill: fraction of the sweep's width that the columns cover; 0 if the shift is the same in all columns.
        fill_sd: its standard error; nan if the film does not determine it.
        typical: median shift of the frames [px].
        lag: measured lag in groups of columns; nan before the sum of all frames' equations is known.
        detail_sd: error of the shift by the specimen's own detail, which frames of one specimen share [px].
        fill_error: error of the shift by that of the fill, which all frames share [px].
        reference: with which the frames are compared; None for a film of one frame.
    """

    smoothing: float
    own_sd: float
    fill: float
    fill_sd: float
    typical: float
    lag: ColumnLag
    detail_sd: float = 0.0
    fill_error: float = 0.0
    reference: FilmReference | None = None


def own_phase(frame: Frame, model: FilmModel, before: float) -> LinePhase:
    """Estimate the line phase of one frame from its own lines.

    Args:
        frame: pictures by detector.
        model: of the film.
        before: shift of the frame before [px]. The frame's own search is used where it fits better.
    """
    own = [model.smoothing] * len(frame)
    estimates = [estimate_line_phase(frame, start, model.fill**2, own) for start in _starts(frame, before)]
    return min(
        (each for each in estimates if each.sd < MAX_SHIFT_SD_PX), key=lambda each: each.sd, default=UNDETERMINED
    )


def frame_phase(frame: Frame, index: int, model: FilmModel, before: float) -> tuple[LinePhase, ShiftEquations | None]:
    """Estimate the line phase of one frame by the film's reference, or by its own lines where these are more precise.

    Own lines are tried where the reference determines the phase less precisely than a frame of this film typically does
    by itself. The reference then shows something else than the frame.

    Args:
        frame: pictures by detector.
        index: of the frame in the film.
        model: of the film.
        before: shift of the frame before [px]. The frame's own search is used where it fits better.

    Returns:
        The phase, and the equations at it, as ``solve_line_phase``.
    """
    starts, fill_squared = _starts(frame, before), model.fill**2
    found = []
    if model.reference is not None:
        for start in starts:
            instruments = model.reference.instruments(index, frame, start)
            found.append(solve_line_phase(frame, start, fill_squared, instruments))
    if not found or min(phase.sd for phase, _ in found) > model.own_sd:
        own = [model.smoothing] * len(frame)
        found += [solve_line_phase(frame, start, fill_squared, own) for start in starts]
    best = min(found, key=lambda each: each[0].sd)
    return best if best[0].sd < MAX_SHIFT_SD_PX else (UNDETERMINED, None)


def _starts(frame: Frame, before: float) -> list[float]:
    found = search_shift(np.sum(frame, axis=0))
    return [before, found] if abs(found - before) > 1.0 else [before]


def fit_film(frames: Sequence[Frame]) -> FilmModel:
    """Fit what the frames share to a sample of them, each compared with its own lines.

    Frames that determine no phase, such as those before the light was on, are left out.

    Raises:
        BadInput: no frame determines a line phase, or the lines of the second direction are not reversed.
    """
    frames = [frame for frame in frames if _varies_along_lines(frame)]
    if not frames:
        raise _too_little_structure()
    _check_reversed(frames)
    start = _common_shift(frames)
    trials = {
        smoothing: [estimate_line_phase(frame, start, 0.0, [smoothing] * len(frame)) for frame in frames]
        for smoothing in SMOOTHING_SDS_PX
    }
    sds = {k: np.minimum([phase.sd for phase in found], MAX_SHIFT_SD_PX) for k, found in trials.items()}
    determined = np.min(list(sds.values()), axis=0) < MAX_SHIFT_SD_PX
    if not determined.any():
        raise _too_little_structure()
    smoothing = min(sds, key=lambda k: (np.median(sds[k][determined]), np.mean(sds[k])))
    shifts = [phase.shift if phase.sd < MAX_SHIFT_SD_PX else np.nan for phase in trials[smoothing]]
    used = [(frame, shift) for frame, shift in zip(frames, shifts, strict=True) if np.isfinite(shift)]
    own: list[Sequence[Instrument]] = [[smoothing] * len(frame) for frame, _ in used]
    fill_squared, sd = _fit_fill(used, own, 0.0)
    typical = float(np.nanmedian(shifts))
    fill, fill_sd = _significant_fill(fill_squared, sd)
    return FilmModel(
        smoothing=smoothing,
        own_sd=float(np.median(sds[smoothing][determined])),
        fill=fill,
        fill_sd=fill_sd,
        typical=typical,
        lag=PooledEquations(frames[0][0].shape[1], fill**2).lag(),
    )


def _varies_along_lines(frame: Frame) -> bool:
    """Whether the values of a line differ in some line; blank frames have no shift."""
    return bool(np.ptp(np.sum(frame, axis=0), axis=1).any())


def _too_little_structure() -> BadInput:
    hint = "sum frames or channels, or take a film of a specimen with structure along the lines"
    return BadInput("the frames have too little structure or too much noise to determine a line phase", hint=hint)


def with_reference(model: FilmModel, frames: Iterable[tuple[int, Frame]], sampled: Mapping[int, Frame]) -> FilmModel:
    """Add a reference picture to the model, and fit the fill with it.

    Args:
        model: without a reference.
        frames: with their indices; those that determine their phase form the reference.
        sampled: frames of these indices that determine its smoothing and the fill.
    """
    reference: FilmReference | None = None
    before = model.typical
    for index, frame in frames:
        phase = own_phase(frame, model, before)
        if np.isfinite(phase.shift):
            reference = reference or empty_reference(frame, model.fill**2, model.smoothing)
            reference.add(index, frame, phase.shift)
            before = phase.shift
    if reference is None or len(reference.members) < 2:
        return model
    members = {index: member.shift for index, member in reference.members.items() if index in sampled}
    if not members:
        return replace(model, reference=reference)
    sds = {}
    for smoothing in SMOOTHING_SDS_PX:
        trial = replace(reference, smoothing=smoothing)
        sds[smoothing] = np.median(
            [
                _precision(sampled[k], shift, model.fill**2, trial.instruments(k, sampled[k], shift))
                for k, shift in members.items()
            ]
        )
    reference = replace(reference, smoothing=min(sds, key=lambda each: float(sds[each])))
    used = [(sampled[k], shift) for k, shift in members.items()]
    instruments = [reference.instruments(k, sampled[k], shift) for k, shift in members.items()]
    fill_squared, sd = _fit_fill(used, instruments, model.fill**2)
    fill, fill_sd = _significant_fill(fill_squared, sd)
    return replace(model, fill=fill, fill_sd=fill_sd, reference=reference)


def _precision(frame: Frame, shift: float, fill_squared: float, instruments: Sequence[Instrument]) -> float:
    """Standard error of a frame's shift [px], by the equations at a shift near it."""
    pairs = zip(frame, instruments, strict=True)
    equations = [shift_equations(each, shift, fill_squared, instrument) for each, instrument in pairs]
    score = np.sum([each.score[:, :2] for each in equations], axis=0)
    slope = np.sum([each.slope[:, :2, :2] for each in equations], axis=0)
    return float(standard_errors(score, slope, np.linalg.solve(slope.sum(axis=0), score.sum(axis=0)))[0])


def share_equations(model: FilmModel, pooled: PooledEquations, value: Array, by_fill: Array) -> tuple[FilmModel, Array]:
    """The model with what the sum of all frames' equations determines, and the shifts that belong to its fill.

    Args:
        model: with which the frames were estimated.
        pooled: their equations.
        value: shift of each frame [px], shape (n,); nan where undetermined.
        by_fill: its change with fill² [px], shape (n,).
    """
    found = pooled.fill()
    fill, fill_sd = _significant_fill(model.fill**2 + found.step, found.sd)
    value = value + by_fill * (fill**2 - model.fill**2)
    shared = replace(
        model,
        fill=fill,
        fill_sd=fill_sd,
        typical=float(np.nanmedian(value)),
        detail_sd=pooled.detail_sd(),
        fill_error=abs(float(np.nanmean(by_fill))) * min(found.sd, MAX_FILL_SQUARED / 2),
        lag=pooled.lag(),
    )
    return shared, value


def _significant_fill(fill_squared: float, sd: float) -> tuple[float, float]:
    """Fill and its standard error; (0, nan) where it does not differ from 0."""
    if fill_squared > Z_95 * sd:
        return float(np.sqrt(fill_squared)), float(sd / (2.0 * np.sqrt(fill_squared)))
    return 0.0, np.nan


def _common_shift(frames: Sequence[Frame]) -> float:
    """Median of the whole-pixel shifts of the frames [px]."""
    return float(np.median([search_shift(np.sum(frame, axis=0)) for frame in frames]))


def _fit_fill(
    used: Sequence[tuple[Frame, float]], instruments: Sequence[Sequence[Instrument]], start: float
) -> tuple[float, float]:
    """fill² and its standard error.

    Shift and tilt of each frame are eliminated.
    """
    fill_squared, shifts = start, [shift for _, shift in used]
    for _ in range(MAX_FILL_ITERATIONS):
        score, slope = 0.0, 0.0
        for index, ((frame, _), by) in enumerate(zip(used, instruments, strict=True)):
            pairs = zip(frame, by, strict=True)
            equations = [shift_equations(each, shifts[index], fill_squared, instrument) for each, instrument in pairs]
            blocks = np.sum([each.score for each in equations], axis=0)
            slopes = np.sum([each.slope for each in equations], axis=0)
            total = slopes.sum(axis=0)
            known = np.linalg.solve(total[:2, :2], blocks.sum(axis=0)[:2])
            shifts[index] += float(np.clip(known[0], -1.0, 1.0))
            projection = total[2, :2] @ np.linalg.inv(total[:2, :2])
            left = blocks - slopes[:, :, :2] @ known
            score = score + left[:, 2] - left[:, :2] @ projection
            slope += total[2, 2] - projection @ total[:2, 2]
        if not slope > 0.0:
            return 0.0, np.inf
        old, fill_squared = fill_squared, float(np.clip(fill_squared + np.sum(score) / slope, 0.0, MAX_FILL_SQUARED))
        if abs(fill_squared - old) < 1e-4:
            break
    score = np.asarray(score) - np.mean(score)
    return fill_squared, float(np.sqrt(np.sum(np.square(score)))) / slope


def _check_reversed(frames: Sequence[Frame]) -> None:
    """Check that odd lines show the specimen in the direction of even ones."""
    direct, mirrored = [], []
    for frame in frames:
        lines = np.asarray(np.sum(frame, axis=0, dtype=np.float64))
        even, odd = lines[0::2].mean(axis=0), lines[1::2].mean(axis=0)
        direct.append(_best_correlation(even, odd))
        mirrored.append(_best_correlation(even, odd[::-1]))
    if np.median(mirrored) > np.median(direct) + MIN_MIRRORED_GAIN:
        hint = "reverse every other line first"
        raise BadInput("lines of odd number fit their neighbours better mirrored: they are not reversed", hint=hint)


def _best_correlation(a: Array, b: Array) -> float:
    """Largest correlation coefficient of two profiles over shifts of up to an eighth of their length."""
    a, b = a - a.mean(), b - b.mean()
    reach = len(a) // 8
    full = np.correlate(a, b, "full")[len(a) - 1 - reach : len(a) + reach]
    return float(full.max() / max(np.sqrt((a @ a) * (b @ b)), 1e-300))
