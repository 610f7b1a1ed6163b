"""Crossings of the threshold angle by a derivative-of-Gaussian filter with non-maximum suppression (chen2019 II-B).

The signal of a transimpedance readout, -R_s V_bias C' θ', crosses zero in the same direction whenever the comb is at
its largest capacitance: C' changes sign at theta_th, in a direction that reverses with the motion. The steepest rise is
found as the largest response of the filter and marks the crossing independently of the signal's offset.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from scanner.arrays import Array
from scanner.device import Axis
from scanner.laws import capacitance_slope, transimpedance_voltage
from scanner.stages import Transimpedance

DETECTION_SIGMA = 4.0
"""Response, in standard deviations of the response to noise, above which a crossing counts: one false crossing in
30 000 independent samples."""

KERNEL_HALF_WIDTH_SIGMA = 4.0
"""Largest half width of the kernel, in standard deviations of its Gaussian: beyond it the kernel is below 1e-3."""


@dataclass(frozen=True)
class CrossingDetector:
    """Parameters of the derivative-of-Gaussian filter and of the non-maximum suppression.

    Attributes:
        sigma: of the Gaussian, sigma_DOG [samples].
        width: of the filter, w_DOG [samples]; longer than 8 sigma changes nothing.
        suppress: a response counts if it is the largest within this distance on either side [samples].
        noise_sd: of the signal [V], for the detection threshold.
    """

    sigma: float
    width: int
    suppress: int
    noise_sd: float

    @property
    def kernel(self) -> Array:
        """Filter, shape (2 h + 1,): correlated with the signal it gives the smoothed signal's rise [V/sample]."""
        half = int(min(self.width // 2, np.ceil(KERNEL_HALF_WIDTH_SIGMA * self.sigma)))
        t = np.arange(-half, half + 1)
        shape = t * np.exp(-0.5 * (t / self.sigma) ** 2)
        return shape / (shape @ t)

    @property
    def latency(self) -> int:
        """Samples from a crossing to its detection: half the kernel and the distance of the suppression."""
        return self.kernel.size // 2 + self.suppress


def detector_response(signal: Array, detector: CrossingDetector) -> Array:
    """Response of the filter, shape (n,) [V/sample]; NaN where it would need samples beyond the ends."""
    from scipy.signal import fftconvolve

    kernel = detector.kernel
    out = np.full(signal.size, np.nan)
    if signal.size >= kernel.size:
        half = kernel.size // 2
        out[half : signal.size - half] = fftconvolve(signal, kernel[::-1], mode="valid")
    return out


def find_crossings(signal: Array, detector: CrossingDetector) -> Array:
    """Positions of the crossings in a whole signal, between samples [samples], increasing, shape (m,)."""
    from scipy.ndimage import maximum_filter1d

    rise = detector_response(signal, detector)
    filled = np.nan_to_num(rise, nan=-np.inf)
    top = maximum_filter1d(filled, 2 * detector.suppress + 1, mode="constant", cval=-np.inf)
    threshold = DETECTION_SIGMA * detector.noise_sd * float(np.linalg.norm(detector.kernel))
    found = np.flatnonzero((filled == top) & (filled > threshold))
    found = found[_inside(found, filled, detector.suppress)]
    before, at, after = filled[found - 1], filled[found], filled[found + 1]
    return found + 0.5 * (before - after) / (before - 2 * at + after)


def _inside(found: NDArray[np.intp], filled: Array, reach: int) -> NDArray[np.bool_]:
    """Whether the suppression window of each crossing lies within the responses, shape (m,)."""
    low, high = found - reach, found + reach
    inside = (low >= 0) & (high < filled.size)
    return inside & np.isfinite(filled[np.where(inside, low, 0)]) & np.isfinite(filled[np.where(inside, high, 0)])


def find_crossings_in_blocks(blocks: Iterable[Array], detector: CrossingDetector) -> Iterator[tuple[Array, int]]:
    """The crossings of ``find_crossings``, found while the signal arrives in blocks.

    Args:
        blocks: consecutive pieces of the signal.

    Yields:
        after each block, the positions of the crossings new since the last [samples from the signal's start], and the
        number of samples that had arrived. Each is known ``detector.latency`` samples late, to within a block.
    """
    reach = detector.latency
    buffer, start, known = np.empty(0), 0, -np.inf
    for block in blocks:
        buffer = np.concatenate([buffer, block])
        found = find_crossings(buffer, detector) + start
        new = found[found > known + 0.5]
        if new.size:
            known = float(new[-1])
        yield new, start + buffer.size
        drop = max(0, buffer.size - 2 * reach - 1)
        buffer, start = buffer[drop:], start + drop


@dataclass(frozen=True)
class CrossingCalibration:
    """Angle at a detected crossing, and its variance, over the rate of the motion.

    Attributes:
        rates: magnitude of theta' at the threshold, shape (m,), increasing [rad/s].
        angles: of the mirror when the response is largest [rad]. It differs slightly from a nonzero theta_th: the
            signal is steepest where C'' theta'^2 + C' theta'' is largest, and theta'' is zero at theta = 0.
        variances: of that angle, for the signal's noise [rad^2].
    """

    rates: Array
    angles: Array
    variances: Array


def calibrate_crossings(
    axis: Axis, detector: CrossingDetector, frequency: float, step: float, floor: float = 0.0
) -> CrossingCalibration:
    """Run the detector over noiseless crossings of every amplitude.

    Args:
        axis: with a transimpedance readout. frequency: of the motion [Hz]. step: between samples [s].
        floor: standard deviation of theta_th itself [rad].
    """
    comb, readout = axis.require_capacitance(), axis.require_readout()
    assert isinstance(readout, Transimpedance)
    amplitudes = np.geomspace(max(2.0 * abs(comb.theta_th), 0.01 * comb.theta0), 4.0 * comb.theta0, 48)
    w, half = 2 * np.pi * frequency, detector.kernel.size // 2
    reach = half + round(0.1 / (frequency * step))
    time = np.arange(-reach, reach + 1) * step
    rates, angles, variances = np.empty((3, amplitudes.size))
    for i, amplitude in enumerate(amplitudes):
        turn = w * time + np.arcsin(comb.theta_th / amplitude)
        theta, omega = amplitude * np.sin(turn), amplitude * w * np.cos(turn)
        slope = capacitance_slope(theta, comb.C0, comb.theta0, comb.theta_th)
        signal = transimpedance_voltage(slope, omega, readout.R_s, readout.V_bias)
        signal *= np.sign(readout.R_s * readout.V_bias * omega[reach] ** 2)
        rise = np.correlate(signal, detector.kernel, mode="valid")
        top = int(rise.argmax())
        window = np.gradient(signal, step)[top : top + 2 * half + 1]
        rates[i], angles[i] = omega[reach], theta[top + half]
        variances[i] = omega[top + half] ** 2 * timing_variance(window, detector, step) + floor**2
    return CrossingCalibration(rates, angles, variances)


def timing_variance(rise: Array, detector: CrossingDetector, step: float) -> float:
    """Variance of a crossing's time by Canny's formula (chen2019 eq 3) [s^2].

    The formula's integrals are sums over the filter's samples, so that white noise of ``noise_sd`` a sample enters with
    its own density. Sampling itself adds nothing, because crossings are placed between samples.

    Args:
        rise: dy/dt of the noiseless signal at the filter's samples about the crossing, shape (2 h + 1,) [V/s].
        step: between samples [s].
    """
    slope = np.gradient(detector.kernel)  # a sample
    edge = float(slope @ rise) * step  # d2 response / dt2 [V / sample^2]
    return float(detector.noise_sd**2 * (slope @ slope) / edge**2) * step**2
