"""Numbers of a scan's optics fitted to its samples, the picture being free."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from estimation.tracker.angle import SlowAngle
from recon.scene import Look, Noise, Projector, Seen, light
from scanner.channel import Channel
from scanner.motion import AngleTrack
from scanner.terms import shifted

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
Numbers = Mapping[str, float]

AXES = ("x", "y")

MOST = 200_000
"""Samples looked at: of a longer recording three runs, at its start, middle and end."""

FOLDS, HELD = 20, 5
"""Blocks of time a scan is cut into; every ``HELD``-th is held out of every fit."""

PATCH = 4
"""Cells along a side of what samples of one place share: detail that the picture does not resolve."""

MISLED = 0.1
"""What detail finer than a cell misleads a place by [cells]."""

SAMPLES_PER_CELL = 6.0
COARSEST, FINEST = 24, 200
"""Cells along a side of the picture: few have a wide reach and no detail, as many as the samples fill tell most."""

NAMES = (
    "late_x", "late_y", "slew_x", "slew_y", "swell_x", "swell_y", "fade", "move_x", "move_y", "delay", "lag",
)  # fmt: skip
"""late: how far an axis's motion lags behind the estimate [s], and slew: the growth of that over the recording [s].
swell: growth of an axis's swing over the recording. fade: exponent of the light's fall over the recording. move: of
the sample over the recording [halves of the swing]. delay, lag: of the intensity [s]."""

AT_REST: Numbers = dict.fromkeys(NAMES, 0.0)


@dataclass(frozen=True, eq=False)
class Scan:
    """Samples of a scan.

    Attributes:
        tracks: angle of both axes at the samples of the whole recording.
        runs: (first, stop) of the runs of samples that are looked at.
        centre, half: of the swing, by axis [rad].
        turn: fraction of the recording at every sample, shape (n,).
        speed: by axis [halves/s], shape (n,).
        intensity: shape (n,).
        rows, held: samples that are fitted, and those held out.
        duration: of the recording [s].
    """

    tracks: Mapping[str, AngleTrack]
    runs: tuple[tuple[int, int], ...]
    centre: Mapping[str, float]
    half: Mapping[str, float]
    turn: Array
    speed: Mapping[str, Array]
    intensity: Array
    rows: Mask
    held: Mask
    duration: float

    @property
    def pieces(self) -> NDArray[np.int64]:
        """Bounds of the runs among the samples."""
        return np.cumsum([0, *(stop - first for first, stop in self.runs)])

    @property
    def fastest(self) -> dict[str, float]:
        """Speed of each axis about the middle of its sweep [halves/s]."""
        return {axis: float(np.percentile(np.abs(self.speed[axis]), 95)) for axis in AXES}

    @property
    def finest(self) -> int:
        """Cells along a side that the samples fill."""
        return int(np.clip(np.sqrt(np.count_nonzero(self.rows) / SAMPLES_PER_CELL), COARSEST, FINEST))

    def place(self, axis: str, late: float) -> Array:
        """Where the mirror stood ``late`` seconds before every sample, in halves of the swing from its centre."""
        return _place(self, axis, late)

    def beginning(self, samples: int) -> Scan:
        """The first ``samples`` alone."""
        first = self.runs[0][0]
        stop = min(first + samples, self.runs[0][1])
        part = slice(0, stop - first)
        return replace(
            self,
            runs=((first, stop),),
            turn=self.turn[part],
            speed={axis: speed[part] for axis, speed in self.speed.items()},
            intensity=self.intensity[part],
            rows=self.rows[part],
            held=self.held[part],
        )


@lru_cache(maxsize=6)
def _place(scan: Scan, axis: str, late: float) -> Array:
    """``Scan.place``; most numbers of the optics leave it as it is."""
    angle = np.concatenate([read_late(scan.tracks[axis], *run, late) for run in scan.runs])
    return np.asarray((angle - scan.centre[axis]) / scan.half[axis])


def read_late(track: AngleTrack, first: int, stop: int, late: float) -> Array:
    """Angles ``late`` seconds before samples ``first`` up to ``stop`` [rad]."""
    if isinstance(track, SlowAngle):
        return SlowAngle(track.motion, track.sample_rate, track.start - late, track.size).read(first, stop)
    margin = int(abs(late) * track.sample_rate) + 4
    low = max(first - margin, 0)
    return shifted(track.read(low, stop + margin), -late * track.sample_rate)[first - low : stop - low]


def scan_of(tracks: Mapping[str, AngleTrack], intensity: Channel) -> Scan:
    """The samples of a recording that its optics are judged by."""
    size = min(intensity.size, *(tracks[axis].size for axis in AXES))
    part = MOST // 3
    runs = ((0, size),) if size <= MOST else tuple((f, f + part) for f in (0, (size - part) // 2, size - part))
    index = np.concatenate([np.arange(*run) for run in runs])
    values = np.concatenate([intensity.read(*run) for run in runs])
    values = values.mean(axis=1) if values.ndim == 2 else values
    angles = {axis: np.concatenate([tracks[axis].read(*run) for run in runs]) for axis in AXES}
    seen = np.isfinite(values) & np.isfinite(angles["x"]) & np.isfinite(angles["y"])
    low, high = ({axis: float(end(angles[axis])) for axis in AXES} for end in (np.nanmin, np.nanmax))
    held = (index * FOLDS // size) % HELD == HELD // 2
    scan = Scan(
        tracks={axis: tracks[axis] for axis in AXES},
        runs=runs,
        centre={axis: (high[axis] + low[axis]) / 2 for axis in AXES},
        half={axis: (high[axis] - low[axis]) / 2 for axis in AXES},
        turn=(index + 0.5) / size,
        speed={},
        intensity=np.where(seen, values, 0.0),
        rows=seen & ~held,
        held=seen & held,
        duration=size / intensity.sample_rate,
    )
    step = 0.5 / intensity.sample_rate
    speed = {axis: (scan.place(axis, -step) - scan.place(axis, step)) / (2 * step) for axis in AXES}
    return replace(scan, speed=speed)


def look(scan: Scan, p: Numbers, cells: int) -> Look:
    """How the samples see the scene with the optics ``p``."""
    places = []
    for axis in AXES:
        place = scan.place(axis, p["delay"] + p[f"late_{axis}"])
        place = place - p[f"slew_{axis}"] * (scan.turn - 0.5) * scan.speed[axis]
        place = place * (1.0 + p[f"swell_{axis}"] * (scan.turn - 0.5)) - p[f"move_{axis}"] * scan.turn
        places.append(0.5 * (place + 1.0) * (cells - 1))
    rate = scan.tracks["x"].sample_rate
    return Look(places[0], places[1], np.exp(-p["fade"] * (scan.turn - 0.5)), max(p["lag"], 0.0) * rate)


def measured_noise(scan: Scan, at: Look, cells: int) -> Noise:
    """Scatter within cells, and contrast between neighbours, from the moments of both."""
    column, row = np.rint(at.u).astype(np.intp), np.rint(at.v).astype(np.intp)
    inside = scan.rows & (column >= 0) & (column < cells) & (row >= 0) & (row < cells)
    cell = (row * cells + column)[inside]
    values = scan.intensity[inside] / at.gain[inside]
    count = np.bincount(cell, minlength=cells**2).astype(np.float64)
    mean, square = (np.bincount(cell, values**power, cells**2) / np.maximum(count, 1) for power in (1, 2))
    scatter = float(((square - mean**2) * count).sum() / np.maximum(count - 1, 0).sum())
    mean, count = mean.reshape(cells, cells), count.reshape(cells, cells)
    excess, pairs = 0.0, 1
    for a, b in ((np.s_[:, :-1], np.s_[:, 1:]), (np.s_[:-1], np.s_[1:])):
        both = (count[a] > 0) & (count[b] > 0)
        excess += ((mean[a] - mean[b]) ** 2 - scatter / np.maximum(count[a], 1) - scatter / np.maximum(count[b], 1))[
            both
        ].sum()
        pairs += int(both.sum())
    return Noise(scatter, max(float(excess) / pairs, 1e-4 * scatter))


@dataclass(frozen=True)
class Fit:
    """Optics fitted.

    Attributes:
        free: names of the free numbers; sd: of their priors.
        p: all numbers.
        seen: scene and residual under them.
        information: of the free numbers, in their own units and without the priors, shape (free, free).
        held_chi2: reduced chi-square of the held-out samples.
    """

    free: tuple[str, ...]
    sd: Array
    p: Numbers
    seen: Seen
    information: Array
    held_chi2: float


def fit(scan: Scan, free: Numbers, p: Numbers, noise: Noise, cells: int, turns: int = 6) -> Fit:
    """Gauss-Newton from ``p`` on, the picture being solved for at every step.

    Args:
        free: standard deviation of the prior, about zero, by name.
        turns: steps at most; 0 leaves ``p`` as it is.
    """
    names, sd = tuple(free), np.array(list(free.values()))
    ways = _ways(scan, cells)
    steps = np.array([ways[name] for name in names]) / sd
    weight = scan.rows / noise.scatter

    def placed(x: Array) -> Numbers:
        return {**p, **dict(zip(names, (x * sd).tolist(), strict=True))}

    def projector(x: Array) -> Projector:
        return Projector(look(scan, placed(x), cells), weight, noise.contrast, cells, scan.pieces)

    x = np.array([p[name] for name in names]) / sd
    here = projector(x)
    seen = here.seen(scan.intensity)
    value = seen.misfit + x @ x
    for turn in range(turns + 1):
        columns = np.empty((scan.intensity.size, x.size))
        for k, step in enumerate(np.diag(steps)):
            ahead, behind = (light(look(scan, placed(x + s), cells), seen.scene, scan.pieces) for s in (step, -step))
            columns[:, k] = here.unexplained((ahead - behind) / (2 * steps[k]))
        information = columns.T @ (weight[:, None] * columns)
        if turn == turns:
            break
        change = np.linalg.solve(information + np.eye(x.size), columns.T @ (weight * seen.residual) - x)
        change *= min(1.0, 2.0 / np.max(np.abs(change) / steps))  # the scene's slope reaches no further than a cell
        gain = 0.0
        for _ in range(4):
            tried = projector(x + change)
            found = tried.seen(scan.intensity, seen.scene)
            better = found.misfit + (x + change) @ (x + change)
            if better < value:
                gain, value, x, seen, here = value - better, better, x + change, found, tried
                break
            change = change / 4
        if gain < 0.1:
            break
    held = float(np.mean(seen.residual[scan.held] ** 2) / noise.scatter)
    shared = _patch_sums(here.look, weight * seen.residual, columns, cells)
    return Fit(names, sd, placed(x), seen, _doubted(information, shared) / np.outer(sd, sd), held)


def _patch_sums(at: Look, score: Array, columns: Array, cells: int) -> Array:
    """``score`` (n,) times ``columns`` (n, k), summed over the samples of every patch of the picture, (patches, k)."""
    across = cells // PATCH + 1
    column, row = (np.clip(place // PATCH, 0, across - 1).astype(np.intp) for place in (at.u, at.v))
    patch, patches = row * across + column, across**2
    sums = np.array([np.bincount(patch, score * each, patches) for each in columns.T])
    return sums.reshape(columns.shape[1], patches).T


def _doubted(information: Array, sums: Array) -> Array:
    """Information of samples whose residuals go together within a patch: H S^-1 H, with S the scatter of ``sums``.

    What the cells do not resolve is no noise: all samples of a place see it. Nothing becomes more certain by this.
    Liang & Zeger 1986, "Longitudinal data analysis using generalized linear models", eq. 7.
    """
    root = np.linalg.cholesky(information + 1e-9 * (1.0 + np.trace(information)) * np.eye(len(information)))
    whitened = np.linalg.solve(root, sums.T)
    scatter, ways = np.linalg.eigh(whitened @ whitened.T)
    ways = root @ ways
    return np.asarray(ways / np.maximum(scatter, 1.0) @ ways.T)


def foretold(scan: Scan, p: Numbers, cells: int) -> float:
    """Mean square error of the held-out samples under the optics ``p``, noise and contrast measured from the scene."""
    noise = measured_noise(scan, look(scan, {**p, "delay": p["delay"] + p["lag"], "lag": 0.0}, cells), cells)
    scene = None
    for _ in range(3):
        seen = Projector(look(scan, p, cells), scan.rows / noise.scatter, noise.contrast, cells, scan.pieces).seen(
            scan.intensity, scene
        )
        scene = seen.scene
        contrast = 0.5 * float(np.mean(np.diff(scene, axis=0) ** 2) + np.mean(np.diff(scene, axis=1) ** 2))
        noise = Noise(float(np.mean(seen.residual[scan.rows] ** 2)), contrast)
    return float(np.mean(seen.residual[scan.held] ** 2))


def _ways(scan: Scan, cells: int) -> dict[str, float]:
    """How far every number goes for half a cell."""
    half_cell, fast = 1.0 / cells, scan.fastest
    ways = {"fade": 0.1, "delay": half_cell / max(fast.values()), "lag": half_cell / max(fast.values())}
    for axis in AXES:
        late = half_cell / fast[axis]
        ways |= {f"late_{axis}": late, f"slew_{axis}": 2 * late, f"swell_{axis}": 2 * half_cell}
        ways |= {f"move_{axis}": half_cell}
    return ways
