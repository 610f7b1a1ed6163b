"""Frequency response of one axis as a list of steady tones, and its fit by harmonic balance.

The angle A sin(2 pi f t + phase) at every tone is a complex number z. With w = 2 pi f, the linear device and the laws
that depend on amplitude give

    z = sum_m R_m / (w_m^2 - w^2 + i w w_m / Q_m + sum_l c_l phi_l(w, A)) + feedthrough,

where phi_l is the describing function of a law, A the measured amplitude over the largest one, and R_m complex
residues: gain and phase of drive and lock-in amplifier are not known. Residues and feedthrough are eliminated.

Sources: Ewins, Modal Testing (Research Studies Press 2000), section 4.3 (residues of modes); Golub and Pereyra, SIAM J.
Numer. Anal. 10 (1973) 413 (elimination); Nayfeh and Mook, Nonlinear Oscillations (Wiley 1979), section 4.1 (harmonic
balance).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from math import comb
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from scanner.arrays import Array

Complex = NDArray[np.complexfloating[Any, Any]]

HELD_OUT_EVERY = 4
"""One tone in so many is held out, the first and the last are not."""

MODEL_ERROR = 1e-3
"""Error of the response, relative to its rms, that is expected of every model: the accuracy of a lock-in amplifier."""

MAX_QUALITY = 1e7
"""Largest quality factor of a fitted mode: numerical derivatives by its frequency are then rounded to a tenth."""

MIN_SCORE_GAIN = 12.0
"""Gain of the score over a single linear mode from which effects, or the other sign of the phase, are claimed: odds of
400 to 1."""

SECOND_MODE_SHIFTS = (-2.0, -1.0, -0.5, 0.5, 1.0, 2.0)
"""Starts of the second mode's frequency relative to the largest peak, in widths of that peak."""

START_LAW = 0.1
"""Start of a law's shift of frequency or of its damping, in widths of the peak."""

DERIVATIVE_STEP = 1e-5
"""Step of a numerical derivative by a parameter of a fit, which is a number near 1."""

SECOND_MODE, FEEDTHROUGH, DELAY = "second-mode", "feedthrough", "channel-delay"

AMPLITUDE_LAWS: Mapping[str, Callable[[Array, Array], Complex]] = {
    "cubic-stiffness": lambda w, a: 0.75 * a**2 + 0j,
    "cubic-damping": lambda w, a: 0.25j * w * a**2,
    "quadratic-drag": lambda w, a: 8.0j / (3.0 * np.pi) * w**2 * a,
    "coulomb-friction": lambda w, a: 4.0j / np.pi / a + 0.0 * w,
}
"""Describing function phi(w, A) of a law whose torque over J is ``c theta^3``, ``c theta^2 theta'``,
``c abs(theta') theta'`` or ``c sign(theta')``."""

EFFECTS = (SECOND_MODE, DELAY, FEEDTHROUGH, *AMPLITUDE_LAWS)
"""Effects that a frequency response may show. A law of amplitude is not combined with a second mode: the amplitudes of
the modes differ from that of the angle."""

READOUT_SUBSETS = ((), (DELAY,), (FEEDTHROUGH,), (DELAY, FEEDTHROUGH))
"""Combinations of effects of the readout."""

SUBSETS = tuple(
    (*of_motion, *readout)
    for of_motion in ((), (SECOND_MODE,), *combinations(AMPLITUDE_LAWS, 1), *combinations(AMPLITUDE_LAWS, 2))
    for readout in READOUT_SUBSETS
)
"""Combinations of effects that are compared."""


class Response(NamedTuple):
    """Frequency response of one axis.

    Attributes:
        name: of the axis.
        frequency: of the tones [Hz], ascending, shape (n,).
        values: complex amplitude, shape (n,), in rad or in another unit.
        in_rad: whether it is in rad.
        scale: unit of the channel over the unit of ``values``.
        tolerance: relative standard uncertainty of ``values``, by that of the sensor's gain.
    """

    name: str
    frequency: Array
    values: Complex
    in_rad: bool
    scale: float
    tolerance: float = 0.0

    @property
    def held_out(self) -> NDArray[np.bool_]:
        """Tones that are held out, shape (n,)."""
        index = np.arange(self.frequency.size)
        return np.asarray((index % HELD_OUT_EVERY == HELD_OUT_EVERY // 2) & (index < self.frequency.size - 1))

    @property
    def largest(self) -> float:
        """Largest amplitude."""
        return float(np.abs(self.values).max())


@dataclass(frozen=True)
class ResponseFit:
    """Modes and laws fitted to a response.

    Attributes:
        effects: beside the first mode.
        modes: frequency [Hz] and quality factor of every mode, that of the largest peak first, shape (modes, 2).
        residues: R of every mode [unit of the response times (rad/s)^2], shape (modes,).
        feedthrough: a constant of the response, 0 where it is not fitted.
        feedthrough_sd: standard deviation of its magnitude.
        laws: by effect its coefficient c with its standard deviation, for amplitudes relative to the largest.
        delay: of the response, with its standard deviation [s]; 0 where it is not fitted.
        mode_sd: standard deviations of ``modes``.
        score: N ln(misfit) + (parameters) ln N + 2 ln(number of subsets of that size).
        predicted: the response at all tones, shape (n,).
    """

    effects: tuple[str, ...]
    modes: Array
    residues: Complex
    feedthrough: complex
    feedthrough_sd: float
    laws: Mapping[str, tuple[float, float]]
    delay: tuple[float, float]
    mode_sd: Array
    score: float
    predicted: Complex


class _Model(NamedTuple):
    """Response by its nonlinear parameters: shift in widths of the peak and ln Q of fitted modes, the laws, the delay.

    The parameter of the delay is its phase over the width of the peak: that of one tone belongs to the residues.

    Attributes:
        response: of one axis, or the first of several.
        values: complex amplitudes of the axes that have these modes, shape (n, axes).
        effects: of ``EFFECTS``.
        center: frequency of the largest amplitude [Hz].
        width: of the peak over ``center``; the unit of the shifts and laws, so that they are numbers near 1 at any Q.
        nominal: frequency [Hz] and quality factor of the first mode if they are not fitted.
    """

    response: Response
    values: Complex
    effects: tuple[str, ...]
    center: float
    width: float
    nominal: tuple[float, float] | None

    @property
    def laws(self) -> list[str]:
        return [effect for effect in self.effects if effect in AMPLITUDE_LAWS]

    @property
    def modes(self) -> int:
        """Number of modes."""
        return 1 + (SECOND_MODE in self.effects)

    @property
    def fitted_modes(self) -> int:
        return self.modes - (self.nominal is not None)

    def shapes(self) -> list[Complex]:
        """Describing functions of the laws over w_center^2, each with a largest magnitude of 1."""
        w, size = 2.0 * np.pi * self.response.frequency, np.abs(self.response.values) / self.response.largest
        made = [AMPLITUDE_LAWS[law](w, size) for law in self.laws]
        return [each / np.abs(each).max() for each in made]

    def law_scales(self) -> list[float]:
        """Coefficient c of every law over its parameter."""
        w, size = 2.0 * np.pi * self.response.frequency, np.abs(self.response.values) / self.response.largest
        unit = self.width * (2.0 * np.pi * self.center) ** 2
        return [float(unit / np.abs(AMPLITUDE_LAWS[law](w, size)).max()) for law in self.laws]

    @property
    def delay_scale(self) -> float:
        """Delay [s] over its parameter."""
        return 1.0 / (2.0 * np.pi * self.width * self.center)

    def mode_values(self, x: Array) -> Array:
        """Frequency [Hz] and quality factor of every mode, shape (modes, 2)."""
        pairs = x[: 2 * self.fitted_modes].reshape(-1, 2)
        fitted = np.column_stack([self.center * (1.0 + self.width * pairs[:, 0]), np.exp(pairs[:, 1])])
        return fitted if self.nominal is None else np.vstack([self.nominal, fitted])

    def table(self, x: Array) -> Complex:
        """Response of modes and feedthrough of height 1 at all tones, shape (n, modes) or one column more."""
        w = 2.0 * np.pi * self.response.frequency
        added = np.zeros(w.size, complex)
        first = 2 * self.fitted_modes
        for value, shape in zip(x[first : first + len(self.laws)], self.shapes(), strict=True):
            added += value * self.width * (2.0 * np.pi * self.center) ** 2 * shape
        columns = []
        for f0, quality in self.mode_values(x):
            w0 = 2.0 * np.pi * f0
            columns.append(w0**2 / quality / (w0**2 - w**2 + 1j * w0 * w / quality + added))
        if FEEDTHROUGH in self.effects:
            columns.append(np.ones(w.size, complex))
        late = np.exp(-1j * w * self.delay_scale * x[-1]) if DELAY in self.effects else 1.0
        return np.array(columns).T * np.reshape(late, (-1, 1))

    def solve(self, x: Array) -> tuple[Complex, Complex]:
        """Heights of the modes and the feedthrough, by linear least squares, and the response at all tones.

        Returns:
            Shapes (modes, or one more, axes) and (n, axes).
        """
        table, used = self.table(x), ~self.response.held_out
        heights = np.linalg.lstsq(table[used], self.values[used], rcond=None)[0]
        return heights, table @ heights

    def height_variance(self, x: Array, covariance: Array, noise: Array) -> Array:
        """Variance of the magnitude of every height, shape as that of the heights.

        Args:
            covariance: of ``x``.
            noise: variance of real and imaginary part of a tone, shape (axes,).
        """
        used, heights = ~self.response.held_out, self.solve(x)[0]
        inverse = np.linalg.pinv(self.table(x)[used])
        variance = np.sum(np.abs(inverse) ** 2, axis=1)[:, None] * noise
        direction = np.exp(-1j * np.angle(heights))
        steps = DERIVATIVE_STEP * np.eye(x.size)
        slopes = [(self.solve(x + step)[0] - self.solve(x - step)[0]) / (2 * DERIVATIVE_STEP) for step in steps]
        along = np.array([(slope * direction).real for slope in slopes]).reshape(x.size, *heights.shape)
        return np.asarray(variance + np.einsum("ika,ij,jka->ka", along, covariance, along))

    def residual(self, x: Array) -> Array:
        """Error at the fitted tones over the rms of each response, shape (2 tones axes,)."""
        used = ~self.response.held_out
        error = (self.values - self.solve(x)[1])[used] / np.sqrt(np.mean(np.abs(self.values) ** 2, axis=0))
        return np.concatenate([error.real, error.imag]).T.ravel()


def fit_response(
    response: Response, effects: tuple[str, ...], nominal: tuple[float, float] | None = None
) -> ResponseFit:
    """Fit a response with some effects to the tones that are not held out.

    Args:
        response: of one axis.
        effects: of ``EFFECTS``.
        nominal: frequency [Hz] and quality factor of the first mode if they are not fitted.
    """
    return _fit(response, response.values[:, None], effects, nominal)[1][0]


def fit_common_modes(responses: Sequence[Response], effects: tuple[str, ...]) -> tuple[float, list[ResponseFit]]:
    """Fit responses at the same tones with common modes; the score of all, and the fit of each.

    Args:
        responses: of several axes.
        effects: of ``EFFECTS`` without laws of amplitude.
    """
    values = np.column_stack([response.values for response in responses])
    return _fit(responses[0], values, effects, None)


def _fit(
    response: Response, values: Complex, effects: tuple[str, ...], nominal: tuple[float, float] | None
) -> tuple[float, list[ResponseFit]]:
    power = np.sum(np.abs(values) ** 2 / np.mean(np.abs(values) ** 2, axis=0), axis=1)
    center = float(response.frequency[np.argmax(power)])
    width = _half_width(response.frequency, np.linalg.norm(values, axis=1)) / center
    model = _Model(response, values, effects, center, width, nominal)
    x, jacobian = _minimise(model)
    heights, predicted = model.solve(x)
    squares = np.sum(model.residual(x).reshape(values.shape[1], -1) ** 2, axis=1)
    n = 2 * int((~response.held_out).sum())
    free = x.size + 2 * heights.size
    variance = float(squares.sum()) / max(n * squares.size - free, 1) + MODEL_ERROR**2
    covariance = np.linalg.pinv(jacobian.T @ jacobian) * variance
    sd = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    height_sd = np.sqrt(model.height_variance(x, covariance, variance * np.mean(np.abs(values) ** 2, axis=0)))
    modes, count = model.mode_values(x), 2 * model.fitted_modes
    mode_sd = np.zeros_like(modes)
    mode_sd[model.modes - model.fitted_modes :] = sd[:count].reshape(-1, 2)
    mode_sd *= np.column_stack([np.full(model.modes, center * width), modes[:, 1]])
    end = count + len(model.laws)
    coefficients = zip(model.laws, x[count:end], sd[count:end], model.law_scales(), strict=True)
    laws = {law: (float(value * scale), float(spread * scale)) for law, value, spread, scale in coefficients}
    delay = (model.delay_scale * float(x[-1]), model.delay_scale * float(sd[-1])) if DELAY in effects else (0.0, 0.0)
    price = 2.0 * float(np.log(comb(len(EFFECTS), len(effects)))) + free * float(np.log(n * squares.size))
    score = n * float(np.sum(np.log(squares / n + MODEL_ERROR**2))) + price
    fits = []
    for i in range(values.shape[1]):
        order = np.argsort(-np.abs(heights[: model.modes, i]))
        feedthrough, feedthrough_sd = 0j, 0.0
        if FEEDTHROUGH in effects:
            feedthrough, feedthrough_sd = complex(heights[-1, i]), float(height_sd[-1, i])
        residues = heights[: model.modes, i] * (2.0 * np.pi * modes[:, 0]) ** 2 / modes[:, 1]
        sd_of_modes, at_tones = mode_sd[order], predicted[:, i]
        of_readout = feedthrough, feedthrough_sd, laws, delay
        fits.append(ResponseFit(effects, modes[order], residues[order], *of_readout, sd_of_modes, score, at_tones))
    return score, fits


def _minimise(model: _Model) -> tuple[Array, Array]:
    """The parameters of the least misfit from several starts, and the Jacobian of the residual there."""
    from scipy.optimize import least_squares

    log_quality, count = float(np.log(0.5 / model.width)), model.fitted_modes
    delays = int(DELAY in model.effects)
    if not count + len(model.laws) + delays:
        return np.empty(0), np.empty((1, 0))
    signed = [law == "cubic-stiffness" for law in model.laws]
    begins = [
        np.array(
            [*np.ravel([(0.0, log_quality), (shift, log_quality)][model.modes - count : model.modes])]
            + [START_LAW * (sign if each else 1) for each in signed]
            + [0.0] * delays
        )
        for shift in (SECOND_MODE_SHIFTS if model.modes == 2 else (0.0,))
        for sign in ((-1, 1) if any(signed) else (1,))
    ]
    most = 0.5 / model.width
    spacing = float(np.median(np.diff(np.unique(model.response.frequency))))
    latest = np.pi * model.width * model.center / spacing  # half a turn from tone to tone
    low = np.array([*([-most, 0.0] * count), *(-most if each else 0.0 for each in signed), *([0.0] * delays)])
    high = np.array([*([most, np.log(MAX_QUALITY)] * count), *([most] * len(signed)), *([latest] * delays)])
    scale = np.array([*([1.0, 1.0] * count), *([START_LAW] * (len(signed) + delays))])
    fits = [
        least_squares(model.residual, np.clip(begin, low, high), bounds=(low, high), x_scale=scale) for begin in begins
    ]
    best = min(fits, key=lambda fit: fit.cost)
    return np.asarray(best.x), np.asarray(best.jac)


def _half_width(frequency: Array, size: Array) -> float:
    """Distance [Hz] between the tones around the peak at which the power is half of it, at least that of two tones."""
    top = int(np.argmax(size))
    below = (size < size[top] / np.sqrt(2.0)) & (frequency != frequency[top])
    left, right = np.flatnonzero(below[:top]), np.flatnonzero(below[top:])
    low = frequency[left[-1]] if left.size else frequency[0]
    high = frequency[top + right[0]] if right.size else frequency[-1]
    return float(high - low)
