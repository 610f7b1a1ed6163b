"""A measured two-photon frame of a resonant scanner: rows of opposite scan direction are displaced against each other.

    python examples/two_photon.py DATA OUT

DATA contains raw.npy, in which every other row was scanned backwards. With a sinusoidal scan of half width A, a phase
error d displaces a sample at x from the middle by d sqrt(A² - x²), proportional to the speed of the beam, and in the
opposite direction on the way back. A constant shift and this law are fitted to half of the frame's bands of rows and
tested on the other half. For comparison, the phase error is fitted to all samples by ``estimation.optics``, which uses
their times and not their rows.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from estimation.optics.fit import fit_optics
from estimation.optics.samples import MIN_CELLS, NOMINAL, measure_cell_variances, project_samples, read_scan
from scanner.angle_tracks import SampledAngle
from scanner.arrays import Array
from scanner.channel import Channel

Law = Callable[[Array, Array], Array]

SCAN_RATE_RAD_S = 2 * np.pi * 8000.0
"""Angular frequency of the scan [rad/s], a typical value: the file does not state it. Phases and pixels do not depend
on it."""

BAND_ROWS = 32
"""Number of rows in a band; every other band is fitted."""

HALF_PERIOD_SAMPLES = 900
"""Equidistant samples in time per half-period: about one per pixel at the middle of the scan."""

DELAY_SD_S = 1e-6
"""Prior standard deviation of the delay [s]."""


def constant_shift(p: Array, x: Array) -> Array:
    """A shift of p[0] pixels at every ``x``."""
    return np.full_like(x, p[0])


def shift_by_speed(p: Array, x: Array) -> Array:
    """Shift [px] at ``x`` from the middle of a sinusoidal scan of half width p[1] [px] with a phase error of p[0]
    [rad]."""
    return p[0] * np.sqrt(np.maximum(p[1] ** 2 - x**2, 0.0))


def column_positions(frame: Array) -> Array:
    """Distance of the columns from the middle of the scan, shape (columns,) [px]."""
    return np.arange(frame.shape[1]) - (frame.shape[1] - 1) / 2


def shift_rows(frame: Array, shift: Array) -> Array:
    """The frame with forward rows sampled ``shift``, shape (columns,), pixels to the right and backward rows to the
    left."""
    column = np.arange(frame.shape[1], dtype=np.float64)
    return np.array([np.interp(column + (-shift if i % 2 else shift), column, row) for i, row in enumerate(frame)])


def row_differences(frame: Array) -> Array:
    """Rows minus the mean of their neighbours, shape (rows - 2, columns)."""
    return frame[1:-1] - (frame[:-2] + frame[2:]) / 2


def rms(values: Array) -> float:
    """Root mean square."""
    return float(np.sqrt(np.mean(values**2)))


def fitted_rows(rows: int) -> NDArray[np.bool_]:
    """Mask of the rows of ``row_differences`` that are fitted, shape (rows - 2,)."""
    return np.arange(1, rows - 1) // BAND_ROWS % 2 == 0


def fit_law(frame: Array, law: Law, start: list[float]) -> Array:
    """Parameters of ``law`` that minimise the rms difference between neighbouring rows in the fitted bands."""
    from scipy.optimize import minimize

    rows, x = fitted_rows(len(frame)), column_positions(frame)
    minimum = minimize(
        lambda p: rms(row_differences(shift_rows(frame, law(p, x)))[rows]),
        start,
        method="Nelder-Mead",
        options={"xatol": 1e-5, "fatol": 1e-4},
    )
    return np.asarray(minimum.x)


def phase_from_samples(frame: Array, half_width: float) -> tuple[float, float]:
    """Phase error of the scan and its standard deviation [rad], from the agreement of all samples of one place.

    Args:
        half_width: of the scan [px].
    """
    rows, x = len(frame), column_positions(frame)
    sweep = np.sin(np.pi * ((np.arange(HALF_PERIOD_SAMPLES) + 0.5) / HALF_PERIOD_SAMPLES - 0.5))
    positions = [half_width * (sweep if i % 2 == 0 else -sweep) for i in range(rows)]
    intensities = [np.interp(position, x, row, np.nan, np.nan) for position, row in zip(positions, frame, strict=True)]
    rate = HALF_PERIOD_SAMPLES * SCAN_RATE_RAD_S / np.pi
    tracks = {
        "x": SampledAngle(np.concatenate(positions), rate),
        "y": SampledAngle(np.linspace(-1.0, 1.0, rows * HALF_PERIOD_SAMPLES), rate),
    }
    intensity = Channel("intensity", "1", rate, 0.0, np.concatenate(intensities), 0, rows * HALF_PERIOD_SAMPLES)
    scan = read_scan(tracks, intensity)
    p, cells = NOMINAL, MIN_CELLS
    while True:
        fit = fit_optics(
            scan,
            {"delay_x": DELAY_SD_S},
            p,
            measure_cell_variances(scan, project_samples(scan, p, cells), cells),
            cells,
        )
        if cells == scan.finest_cells:
            return SCAN_RATE_RAD_S * fit.parameters["delay_x"], SCAN_RATE_RAD_S / float(np.sqrt(fit.information[0, 0]))
        p, cells = fit.parameters, min(2 * cells, scan.finest_cells)


def draw(frames: dict[str, Array], output: Path) -> None:
    """Draw the middle parts of the frames."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, panels = plt.subplots(1, len(frames), figsize=(6 * len(frames), 6), layout="constrained")
    rows, columns = next(iter(frames.values())).shape
    part = np.s_[rows // 4 : 3 * rows // 4, columns // 4 : 3 * columns // 4]
    for panel, (name, frame) in zip(panels, frames.items(), strict=True):
        panel.imshow(frame[part], cmap="gray", vmax=np.percentile(frame, 99.8))
        panel.set(title=f"{name}: rows' rms {rms(row_differences(frame)):.1f}", xticks=[], yticks=[])
    figure.savefig(output, dpi=100)
    plt.close(figure)


def main(data: Path, output: Path) -> None:
    """Fit both laws, compare them, fit the phase error to the samples, draw."""
    output.mkdir(parents=True, exist_ok=True)
    frame = np.load(data / "raw.npy").astype(np.float64)
    held_out, x = ~fitted_rows(len(frame)), column_positions(frame)
    frames = {"as recorded": frame}
    shift = fit_law(frame, constant_shift, [5.0])
    frames["constant shift"] = shift_rows(frame, constant_shift(shift, x))
    phase_error, half_width = fit_law(frame, shift_by_speed, [float(shift[0]) / len(x), 0.6 * len(x)])
    frames["shift by speed"] = shift_rows(frame, shift_by_speed(np.array([phase_error, half_width]), x))
    print("Rows against the mean of their neighbours, rms: all, and bands not used in the fit")
    for name, corrected in frames.items():
        differences = row_differences(corrected)
        print(f"  {name:22} {rms(differences):7.2f} {rms(differences[held_out]):7.2f}")
    print(f"Constant shift: {2 * shift[0]:.2f} px between the directions")
    middle = 2 * phase_error * half_width
    print(f"Shift by speed: {middle:.2f} px between them in the middle of a scan of ± {half_width:.1f} px")
    print(
        f"  (columns cover {100 * x[-1] / half_width:.0f} % of it), a phase error of {np.degrees(phase_error):.3f} deg;"
    )
    phase, sd = phase_from_samples(frame, half_width)
    print(
        f"  from the agreement of the samples of one place: {np.degrees(phase):.3f} +- {np.degrees(1.96 * sd):.3f} deg"
    )
    draw(frames, output / "two_photon.png")
    print(f"Picture: {output / 'two_photon.png'}")


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
