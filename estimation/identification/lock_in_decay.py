"""Resonance and damping from a free decay that a lock-in amplifier recorded as amplitude and phase."""

from __future__ import annotations

import numpy as np

from estimation.identification.agreement import (
    Differences,
    IdentifiedValue,
    amplitude_columns,
    difference_by_extra_columns,
    widen,
)
from estimation.identification.fits import MAX_RINGDOWN_RESIDUAL_RATIO
from estimation.lock_in_channels import lock_in_phasor
from scanner.arrays import Array, Complex
from scanner.device import Axis
from scanner.errors import BadInput
from scanner.recording import Recording

DECAY_START = 0.8
"""Amplitude over the largest at which the decay begins. The drive is off by then, and the filter of the amplifier,
which rounds the beginning, has settled if its response is short against the decay: with a delay of an eighth of the
decay time Q is 0.02 % off, and 0.13 % from 0.97 on."""


CORRELATION_WINDOW = 3.0
"""Lag up to which the autocorrelation is summed, over its sum: that of a low-pass of any order is complete to 0.3 %
there, and the sum has little noise."""


def fit_lock_in_decay(recording: Recording, axis: Axis) -> dict[str, IdentifiedValue]:
    """``k_over_J`` [1/s2] and ``b_over_J`` [1/s] from ``amplitude_x`` and ``phase_x``, by Z = Z0 exp((i d - g) t).

    The filter of a lock-in amplifier makes samples depend on each other, hundreds of them where the output has many in
    its time constant: standard deviations are increased by the correlation of the residual.

    Raises:
        BadInput: the amplitude does not decay, or not exponentially.
    """
    from scipy.optimize import least_squares

    channel = recording[f"amplitude_{axis.name}"]
    time, phasor, frequency = lock_in_phasor(recording, axis)
    size = np.abs(phasor)
    first = int(np.argmax(size))
    first += int(np.argmax(size[first:] < DECAY_START * size[first]))
    time, phasor = time[first:] - time[first], phasor[first:]
    if phasor.size < 8:
        hint = "record the decay for longer, with the drive off"
        raise BadInput("shows no free decay", file=channel.file, channel=channel.name, hint=hint)
    size = np.abs(phasor)
    decay, detuning = _first_guess(time, phasor, size)

    def residual(x: Array) -> Array:
        shape = np.exp((1j * x[1] - np.exp(x[0])) * time)
        left = phasor - shape * (np.vdot(shape, phasor) / np.vdot(shape, shape))
        return np.concatenate([left.real, left.imag])

    fit = least_squares(residual, [np.log(decay), detuning], x_scale="jac")
    left = fit.fun.reshape(2, -1)
    if np.sqrt(2.0 * np.mean(left**2)) > MAX_RINGDOWN_RESIDUAL_RATIO * np.sqrt(np.mean(size[: size.size // 4] ** 2)):
        hint = "cut the record to the decay alone; `lissajous diagnose` finds a damping that depends on the amplitude"
        raise BadInput("does not follow an exponential decay", file=channel.file, channel=channel.name, hint=hint)
    dependence = _samples_per_independent_one(left)
    variance = float(np.sum(left**2)) / max(left.size / dependence - 4.0, 1.0)
    sd = np.sqrt(variance * np.diag(np.linalg.inv(fit.jac.T @ fit.jac)))
    g, w = float(np.exp(fit.x[0])), 2 * np.pi * frequency + float(fit.x[1])
    found = [IdentifiedValue(w**2 + g**2, float(2.0 * w * sd[1])), IdentifiedValue(2.0 * g, float(2.0 * g * sd[0]))]
    change = _amplitude_dependence(time, phasor, g, float(fit.x[1]), dependence)
    return dict(zip(("k_over_J", "b_over_J"), widen(found, change.select([1, 0], [2.0 * w, 2.0])), strict=True))


def _samples_per_independent_one(residual: Array) -> float:
    """Factor by which correlation increases the variance of a mean, at least 1.

    The autocorrelation is summed up to the lag of ``CORRELATION_WINDOW`` times the sum.

    Source: Sokal, in Functional Integration (Plenum 1997), section 3: automatic windowing.

    Args:
        residual: components of one stationary noise, shape (components, n).
    """
    count = residual.shape[1]
    spectrum = np.fft.rfft(residual, 2 * count)
    lags = np.fft.irfft(np.sum(np.abs(spectrum) ** 2, axis=0))[:count]
    sums = 2.0 * np.cumsum(lags / max(float(lags[0]), 1e-300)) - 1.0
    enough = np.arange(count) >= CORRELATION_WINDOW * sums
    return max(1.0, float(sums[np.argmax(enough)] if enough.any() else sums.max()))


def _amplitude_dependence(
    time: Array, phasor: Complex, decay: float, detuning: float, dependence: float
) -> Differences:
    """Changes of decay rate [1/s] and detuning [rad/s] if both may depend on the amplitude.

    Args:
        time: [s], phasor: both of shape (n,). decay: [1/s], detuning: [rad/s], as fitted.
        dependence: factor of the variances by the correlation of neighbouring samples.
    """
    shape = np.exp((1j * detuning - decay) * time)
    shape *= np.vdot(shape, phasor) / np.vdot(shape, shape)
    columns = np.stack([-time * shape, 1j * time * shape, shape, 1j * shape], axis=1)
    by_log_amplitude, by_phase, residual = (
        np.concatenate([each.real, each.imag]) for each in (shape, 1j * shape, phasor - shape)
    )
    extra = amplitude_columns(np.tile(time, 2), 2.0 * decay, by_phase, by_log_amplitude)
    change = difference_by_extra_columns(np.concatenate([columns.real, columns.imag]), extra, residual)
    return Differences(change.difference[:2], change.sd[:2] * np.sqrt(dependence))


def _first_guess(time: Array, phasor: Complex, size: Array) -> tuple[float, float]:
    """Decay rate [1/s] and detuning [rad/s], by straight lines through log amplitude and phase above the noise."""
    large = size > 0.1 * size[0]
    large[np.argmin(large) if not large.all() else large.size :] = False
    if large.sum() < 3:
        large[:3] = True
    slope = np.polyfit(time[large], np.log(np.maximum(size[large], 1e-300)), 1)[0]
    detuning = np.polyfit(time[large], np.unwrap(np.angle(phasor[large])), 1)[0]
    return max(-float(slope), 1e-3 / float(time[-1])), float(detuning)
