"""A grating in a picture: how long is a period, how well does so small a field tell, and how straight are the lines?"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from recon.imaging.picture import Picture
from scanner.arrays import Array

SURFACE_ORDER = 3  # polynomial in x and y that stands for the sample's tilt and the height's drift
HARMONICS = (1, 2, 3)  # enough of a rectangular profile of any duty cycle
SLABS = 8  # across the lines, for the jackknife: about half a period each
BANDS = 12  # along the lines, for their stray


@dataclass(frozen=True)
class Grating:
    """A grating fitted to a picture; lengths are in the unit of the picture's half angles.

    Attributes:
        wave: wave vector, shape (2,): periods a unit length along x and y.
        pitch_sd: standard deviation of the pitch, by leaving out one slab of the field after the other: the samples
            of one slab share the position's errors, so their number must not count. With this few slabs it errs on
            the wide side (two to three times on exact synthetic gratings).
        along: place along the lines, shape (BANDS,).
        stray: how far the lines lie from straight ones there, shape (BANDS,).
    """

    wave: Array
    pitch_sd: float
    along: Array
    stray: Array

    @property
    def pitch(self) -> float:
        """One period, perpendicular to the lines."""
        return float(1 / np.hypot(*self.wave))

    @property
    def bend(self) -> float:
        """Stray of the lines, rms."""
        return float(np.sqrt(np.mean(self.stray**2)))


def fft_wave(picture: Picture) -> Array:
    """Wave vector of the spectrum's highest peak, shape (2,)."""
    grid, n = picture.grid, 8 * max(picture.image.shape)
    x, y, height = _pixels(picture)
    window = np.cos(np.pi / 2 * np.minimum(np.hypot(x / grid.half_angle_x, y / grid.half_angle_y), 1)) ** 2
    surface = _surface(x, y)
    height = np.clip(height, *np.percentile(height, [1, 98]))  # dust outshines the lines
    flat = np.zeros(picture.image.shape)
    flat[picture.coverage > 0] = window * (height - surface @ _solve(surface, height))
    power = np.abs(np.fft.rfft2(flat, (n, n)))
    row, column = np.unravel_index(np.argmax(power), power.shape)
    fx = np.fft.rfftfreq(n, 2 * grid.half_angle_x / grid.width)[column]
    fy = np.fft.fftfreq(n, 2 * grid.half_angle_y / grid.height)[row]
    return np.array([fx, fy])


def fit_grating(picture: Picture) -> Grating:
    """Least squares of a smooth surface and a periodic profile over the visited pixels, dust left out."""
    x, y, height = _pixels(picture)
    wave, clean = fft_wave(picture), np.ones(x.size, bool)
    for _ in range(3):
        wave = _fit_wave(wave, x[clean], y[clean], height[clean])
        misfit = np.abs(_misfit(wave, x, y, height))
        clean = misfit < 4 * 1.4826 * np.median(misfit)
    x, y, height = x[clean], y[clean], height[clean]

    across = wave @ [x, y]
    slab = np.digitize(across, np.linspace(across.min(), across.max(), SLABS + 1)[1:-1])
    left_out = [_fit_wave(wave, *(each[slab != i] for each in (x, y, height))) for i in range(SLABS)]
    pitches = 1 / np.hypot(*np.transpose(left_out))
    return Grating(wave, float(np.sqrt((SLABS - 1) * np.var(pitches))), *_stray(wave, x, y, height))


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
    # the columns are scaled alike, so the normal equations are accurate enough and ten times faster
    return np.linalg.solve(design.T @ design, design.T @ values)


def _misfit(wave: Array, x: Array, y: Array, height: Array) -> Array:
    """What the best surface and profile of this wave vector leave over: all but the wave vector is linear."""
    design = np.concatenate([_surface(x, y), _profile(2 * np.pi * (wave @ [x, y]))], axis=1)
    return height - design @ _solve(design, height)


def _fit_wave(wave: Array, x: Array, y: Array, height: Array) -> Array:
    from scipy.optimize import least_squares

    scale = 0.03 * np.hypot(*wave)
    return least_squares(_misfit, wave, args=(x, y, height), x_scale=scale, diff_step=1e-4, ftol=1e-6).x


def _stray(wave: Array, x: Array, y: Array, height: Array) -> tuple[Array, Array]:
    """Place along the lines and, from the fundamental's phase there, how far they lie off; each shape (BANDS,)."""
    pitch = 1 / np.hypot(*wave)
    phase, surface = 2 * np.pi * (wave @ [x, y]), _surface(x, y)
    both = np.concatenate([surface, _profile(phase)], axis=1)
    flat = height - surface @ _solve(both, height)[: surface.shape[1]]
    along = pitch * (np.array([-wave[1], wave[0]]) @ [x, y])
    edges = np.quantile(along, np.linspace(0, 1, BANDS + 1))  # as many pixels in each
    band = np.digitize(along, edges[1:-1])
    shifts = []
    for i in range(BANDS):
        here = phase[band == i]
        _, c, s = _solve(np.stack([np.ones_like(here), np.cos(here), np.sin(here)], axis=1), flat[band == i])
        shifts.append(np.arctan2(s, c))
    stray = np.unwrap(shifts) * pitch / (2 * np.pi)
    return (edges[1:] + edges[:-1]) / 2, stray - stray.mean()
