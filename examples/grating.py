"""Fit of a grating to a picture: its pitch, the standard deviation of the pitch, and the straightness of the lines."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from recon.imaging.picture import Picture
from scanner.arrays import Array

SURFACE_ORDER = 3  # order of the polynomial in x and y that models the tilt of the sample and the drift of the height
HARMONICS = (1, 2, 3)  # of the profile across the lines; higher ones of a rectangular profile are below the noise
SLABS = 8  # parts of the field across the lines, for the jackknife: about half a period each
BANDS = 12  # parts of the field along the lines, for their deviation from straight lines


@dataclass(frozen=True)
class Grating:
    """A grating fitted to a picture; lengths are in the unit of the picture's half angles.

    Attributes:
        wave: wave vector, shape (2,): periods per unit length along x and y.
        pitch_sd: standard deviation of the pitch by the jackknife over slabs of the field, because the position errors
            of the samples of one slab are correlated. With so few slabs it is too large (by a factor of two to three on
            exact synthetic gratings).
        along: position along the lines, shape (BANDS,).
        deviation: of the lines from straight lines at those positions, shape (BANDS,).
    """

    wave: Array
    pitch_sd: float
    along: Array
    deviation: Array

    @property
    def pitch(self) -> float:
        """One period, perpendicular to the lines."""
        return float(1 / np.hypot(*self.wave))

    @property
    def bend(self) -> float:
        """Rms deviation of the lines from straight lines."""
        return float(np.sqrt(np.mean(self.deviation**2)))


def fft_wave(picture: Picture) -> Array:
    """Wave vector of the spectrum's highest peak, shape (2,)."""
    grid, n = picture.grid, 8 * max(picture.image.shape)
    x, y, height = _pixels(picture)
    window = np.cos(np.pi / 2 * np.minimum(np.hypot(x / grid.half_angle_x, y / grid.half_angle_y), 1)) ** 2
    surface = _surface(x, y)
    height = np.clip(height, *np.percentile(height, [1, 98]))  # dust is higher than the lines
    flat = np.zeros(picture.image.shape)
    flat[picture.coverage > 0] = window * (height - surface @ _solve(surface, height))
    power = np.abs(np.fft.rfft2(flat, (n, n)))
    row, column = np.unravel_index(np.argmax(power), power.shape)
    fx = np.fft.rfftfreq(n, 2 * grid.half_angle_x / grid.width)[column]
    fy = np.fft.fftfreq(n, 2 * grid.half_angle_y / grid.height)[row]
    return np.array([fx, fy])


def fit_grating(picture: Picture) -> Grating:
    """Fit a smooth surface and a periodic profile to the visited pixels by least squares, without outliers (dust)."""
    x, y, height = _pixels(picture)
    wave, clean = fft_wave(picture), np.ones(x.size, bool)
    for _ in range(3):
        wave = _fit_wave(wave, x[clean], y[clean], height[clean])
        misfit = np.abs(_misfit(wave, x, y, height))
        clean = misfit < 4 * 1.4826 * np.median(misfit)
    x, y, height = x[clean], y[clean], height[clean]

    across = wave @ [x, y]
    slab = np.digitize(across, np.linspace(across.min(), across.max(), SLABS + 1)[1:-1])
    left_out = [_fit_wave(wave, *(values[slab != i] for values in (x, y, height))) for i in range(SLABS)]
    pitches = 1 / np.hypot(*np.transpose(left_out))
    return Grating(wave, float(np.sqrt((SLABS - 1) * np.var(pitches))), *_line_deviation(wave, x, y, height))


def _pixels(picture: Picture) -> tuple[Array, Array, Array]:
    """x, y and value of every visited pixel, each shape (n,)."""
    grid = picture.grid
    row, column = np.nonzero(picture.coverage)
    x = ((2 * column + 1) / grid.width - 1) * grid.half_angle_x
    y = ((2 * row + 1) / grid.height - 1) * grid.half_angle_y
    return x, y, picture.image[row, column].astype(np.float64)


def _surface(x: Array, y: Array) -> Array:
    orders = [(i, j) for i in range(SURFACE_ORDER + 1) for j in range(SURFACE_ORDER + 1 - i)]
    return np.stack([(x / np.ptp(x)) ** i * (y / np.ptp(y)) ** j for i, j in orders], axis=1)


def _profile(phase: Array) -> Array:
    return np.stack([wave(h * phase) for h in HARMONICS for wave in (np.cos, np.sin)], axis=1)


def _solve(design: Array, values: Array) -> Array:
    # all columns are of order 1, so that the normal equations are accurate enough; they are ten times faster
    return np.linalg.solve(design.T @ design, design.T @ values)


def _misfit(wave: Array, x: Array, y: Array, height: Array) -> Array:
    """Residual of the best surface and profile for this wave vector; all other parameters are linear."""
    design = np.concatenate([_surface(x, y), _profile(2 * np.pi * (wave @ [x, y]))], axis=1)
    return height - design @ _solve(design, height)


def _fit_wave(wave: Array, x: Array, y: Array, height: Array) -> Array:
    from scipy.optimize import least_squares

    scale = 0.03 * np.hypot(*wave)
    return least_squares(_misfit, wave, args=(x, y, height), x_scale=scale, diff_step=1e-4, ftol=1e-6).x


def _line_deviation(wave: Array, x: Array, y: Array, height: Array) -> tuple[Array, Array]:
    """Position along the lines, and the deviation of the lines there from the phase of the fundamental; shape
    (BANDS,)."""
    pitch = 1 / np.hypot(*wave)
    phase, surface = 2 * np.pi * (wave @ [x, y]), _surface(x, y)
    both = np.concatenate([surface, _profile(phase)], axis=1)
    flat = height - surface @ _solve(both, height)[: surface.shape[1]]
    along = pitch * (np.array([-wave[1], wave[0]]) @ [x, y])
    edges = np.quantile(along, np.linspace(0, 1, BANDS + 1))  # as many pixels in each
    band = np.digitize(along, edges[1:-1])
    shifts = []
    for i in range(BANDS):
        phase_in_band = phase[band == i]
        _, c, s = _solve(
            np.stack([np.ones_like(phase_in_band), np.cos(phase_in_band), np.sin(phase_in_band)], axis=1),
            flat[band == i],
        )
        shifts.append(np.arctan2(s, c))
    deviation = np.unwrap(shifts) * pitch / (2 * np.pi)
    return (edges[1:] + edges[:-1]) / 2, deviation - deviation.mean()
