"""A measured two-photon frame of a resonant scanner: rows taken in opposite directions do not meet.

    python examples/two_photon.py DATA OUT

DATA holds raw.npy, whose every other row was scanned backwards. A phase error d moves what a sinusoidal sweep of half
width A shows at x from its middle by d sqrt(A² - x²), the other way on the way back: a lag that follows the speed. A
constant shift and that law are fitted to half of the frame's bands of rows and told on the other half; then the
optics that ``diagnose`` judges by are fitted to the samples of the frame, which know nothing of rows.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from estimation.optics.fit import fit_optics
from estimation.optics.samples import MIN_CELLS, NOMINAL, measure_cell_variances, project_samples, read_scan
from scanner.arrays import Array
from scanner.channel import Channel
from scanner.motion import SampledAngle

Law = Callable[[Array, Array], Array]

TURN_RATE = 2 * np.pi * 8000.0
"""The file does not say how fast the mirror swings; this is usual [rad/s]. Phases and pixels do not depend on it."""

BAND = 32
"""Rows in a band; every other band is fitted."""

SWEEP = 900
"""Samples, even in time, that a sweep is resolved into: about one a pixel at its middle."""

LATEST = 1e-6
"""Prior standard deviation of the lateness [s]."""


def constant(p: Array, x: Array) -> Array:
    """A shift of p[0] pixels wherever the beam is."""
    return np.full_like(x, p[0])


def following_speed(p: Array, x: Array) -> Array:
    """Shift at ``x`` from the middle of a sinusoidal sweep of half width p[1] whose phase is off by p[0] [px]."""
    return p[0] * np.sqrt(np.maximum(p[1] ** 2 - x**2, 0.0))


def from_middle(frame: Array) -> Array:
    """Distance of the columns from the middle of the sweep, shape (columns,) [px]."""
    return np.arange(frame.shape[1]) - (frame.shape[1] - 1) / 2


def straightened(frame: Array, shift: Array) -> Array:
    """The frame with forward rows read ``shift`` (columns,) pixels to the right, backward rows to the left."""
    column = np.arange(frame.shape[1], dtype=np.float64)
    return np.array([np.interp(column + (-shift if i % 2 else shift), column, row) for i, row in enumerate(frame)])


def between_rows(frame: Array) -> Array:
    """Rows less the mean of their neighbours, shape (rows - 2, columns)."""
    return frame[1:-1] - (frame[:-2] + frame[2:]) / 2


def rms(values: Array) -> float:
    """Root mean square."""
    return float(np.sqrt(np.mean(values**2)))


def seen_rows(rows: int) -> NDArray[np.bool_]:
    """Which of ``between_rows`` are fitted, shape (rows - 2,)."""
    return np.arange(1, rows - 1) // BAND % 2 == 0


def fitted(frame: Array, law: Law, start: list[float]) -> Array:
    """Parameters of ``law`` under which the fitted bands' rows lie closest to their neighbours."""
    from scipy.optimize import minimize

    seen, x = seen_rows(len(frame)), from_middle(frame)
    found = minimize(
        lambda p: rms(between_rows(straightened(frame, law(p, x)))[seen]),
        start,
        method="Nelder-Mead",
        options={"xatol": 1e-5, "fatol": 1e-4},
    )
    return np.asarray(found.x)


def phase_by_samples(frame: Array, swing: float) -> tuple[float, float]:
    """Phase error of the sweep and its standard deviation [rad], by the samples' agreement in one picture.

    Args:
        swing: half width of the sweep [px].
    """
    rows, x = len(frame), from_middle(frame)
    sweep = np.sin(np.pi * ((np.arange(SWEEP) + 0.5) / SWEEP - 0.5))
    places = [swing * (sweep if i % 2 == 0 else -sweep) for i in range(rows)]
    light = [np.interp(at, x, row, np.nan, np.nan) for at, row in zip(places, frame, strict=True)]
    rate = SWEEP * TURN_RATE / np.pi
    tracks = {
        "x": SampledAngle(np.concatenate(places), rate),
        "y": SampledAngle(np.linspace(-1.0, 1.0, rows * SWEEP), rate),
    }
    intensity = Channel("intensity", "1", rate, 0.0, np.concatenate(light), 0, rows * SWEEP)
    scan = read_scan(tracks, intensity)
    p, cells = NOMINAL, MIN_CELLS
    while True:
        found = fit_optics(
            scan, {"delay_x": LATEST}, p, measure_cell_variances(scan, project_samples(scan, p, cells), cells), cells
        )
        if cells == scan.finest_cells:
            return TURN_RATE * found.parameters["delay_x"], TURN_RATE / float(np.sqrt(found.information[0, 0]))
        p, cells = found.parameters, min(2 * cells, scan.finest_cells)


def draw(frames: dict[str, Array], output: Path) -> None:
    """The middle of the frames side by side."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, panels = plt.subplots(1, len(frames), figsize=(6 * len(frames), 6), layout="constrained")
    rows, columns = next(iter(frames.values())).shape
    part = np.s_[rows // 4 : 3 * rows // 4, columns // 4 : 3 * columns // 4]
    for panel, (name, frame) in zip(panels, frames.items(), strict=True):
        panel.imshow(frame[part], cmap="gray", vmax=np.percentile(frame, 99.8))
        panel.set(title=f"{name}: rows' rms {rms(between_rows(frame)):.1f}", xticks=[], yticks=[])
    figure.savefig(output, dpi=100)
    plt.close(figure)


def main(data: Path, output: Path) -> None:
    """Fit both laws, compare, check against the samples, draw."""
    output.mkdir(parents=True, exist_ok=True)
    frame = np.load(data / "raw.npy").astype(np.float64)
    unseen, x = ~seen_rows(len(frame)), from_middle(frame)
    frames = {"as recorded": frame}
    shift = fitted(frame, constant, [5.0])
    frames["constant shift"] = straightened(frame, constant(shift, x))
    turn, swing = fitted(frame, following_speed, [float(shift[0]) / len(x), 0.6 * len(x)])
    frames["lag following speed"] = straightened(frame, following_speed(np.array([turn, swing]), x))
    print("Rows against the mean of their neighbours, rms: all, and bands not used in the fit")
    for name, each in frames.items():
        rest = between_rows(each)
        print(f"  {name:22} {rms(rest):7.2f} {rms(rest[unseen]):7.2f}")
    print(f"Constant shift: {2 * shift[0]:.2f} px between the directions")
    print(
        f"Lag following the speed: {2 * turn * swing:.2f} px between them at the middle of a sweep of ± {swing:.1f} px"
    )
    print(f"  (columns cover {100 * x[-1] / swing:.0f} % of it), a phase error of {np.degrees(turn):.3f} deg;")
    phase, sd = phase_by_samples(frame, swing)
    print(f"  by the samples' agreement in one picture: {np.degrees(phase):.3f} +- {np.degrees(1.96 * sd):.3f} deg")
    draw(frames, output / "two_photon.png")
    print(f"Picture: {output / 'two_photon.png'}")


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
