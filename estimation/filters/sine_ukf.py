"""The sine-UKF of wang2019: the phase of a sinusoidal motion of constant amplitude, from a position sensor.

The state is the phase s: s(k+1) = s(k) + 2 pi f T + w, z = A sin s + v (eq 14, 16). The paper inverts the sensor with
arcsin (eq 12 to 14), which is two-valued and singular at the turning points; here no inversion is needed.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numba import njit

from estimation.filters.baselines import find_position_signal, reference_from_drive_or_signal
from estimation.filters.measured_motion import axis_motion_from_angle
from estimation.signals import intensity_clock
from scanner.arrays import Array
from scanner.device import Device
from scanner.errors import DeviceInvalid
from scanner.motion import Motion
from scanner.recording import Recording
from scanner.replaced_samples import with_samples
from scanner.signal_check import check_signal
from scanner.stages import Position

SIGMA_POINT_SPREAD = 3.0
"""n + kappa for n = 1 state: Julier's choice, which is exact to fourth order for a Gaussian."""

NOISE_BLOCK_CYCLES = 4.0
"""Cycles of the motion per block whose phase measures noise and random walk."""


@njit(cache=True)
def _ukf(z, step, amplitude, R, Q, s, P, phase):  # type: ignore[no-untyped-def]
    half, centre = 0.5 / SIGMA_POINT_SPREAD, 1.0 - 1.0 / SIGMA_POINT_SPREAD
    for i in range(z.size):
        s += step[i]
        P += Q
        reach = np.sqrt(SIGMA_POINT_SPREAD * P)
        above, middle, below = amplitude * np.sin(s + reach), amplitude * np.sin(s), amplitude * np.sin(s - reach)
        mean = half * (above + below) + centre * middle
        S = half * ((above - mean) ** 2 + (below - mean) ** 2) + centre * (middle - mean) ** 2 + R
        cross = half * reach * (above - below)
        s += cross / S * (z[i] - mean)
        P -= cross * cross / S
        phase[i] = s


def measure_noise_and_phase_walk(angle: Array, turn: Array, amplitude: float, cycle: float) -> tuple[float, float]:
    """White noise of the sensor near the motion's frequency and random walk of the phase.

    Phases of neighbouring blocks of a few cycles differ by noise, those of distant blocks also by the random walk.
    Noise that is not white is so measured at the motion's frequency, where it matters.

    Args:
        angle, turn: as of ``track_sine_phase``. cycle: period of the motion [samples].

    Returns:
        standard deviation of the noise per sample [rad], and of the walk per sample [rad].
    """
    block = max(8, round(NOISE_BLOCK_CYCLES * cycle))
    count = angle.size // block
    mixed = angle[: count * block] * np.exp(-1j * turn[: count * block])
    phase = np.unwrap(np.angle(mixed.reshape(count, block).sum(axis=1)))
    far = max(2, count // 4)
    if count < 2 * far:
        return float(np.std(angle) / np.sqrt(2.0)), 0.0
    near, distant = (float(np.mean((phase[lag:] - phase[:-lag]) ** 2)) for lag in (1, far))
    white = amplitude * np.sqrt(0.25 * near * block)  # the block's phase has variance 2 R / (A^2 block)
    return float(white), float(np.sqrt(max(distant - near, 0.0) / ((far - 1) * block)))


def track_sine_phase(angle: Array, turn: Array, amplitude: float, noise_sd: float, wander: float) -> Array:
    """Phase of a noisy sine by the unscented Kalman filter.

    Args:
        angle: sensor's angle, shape (n,) [rad].
        turn: reference phase 2 pi f t at its samples, shape (n,) [rad].
        amplitude: of the motion [rad]. noise_sd: of the sensor, white, a sample [rad].
        wander: standard deviation of the phase's random walk over a sample [rad].

    Returns:
        phase s, shape (n,) [rad].
    """
    step = np.diff(turn, prepend=2 * turn[0] - turn[1])
    n = min(angle.size, max(64, int(8 * 2 * np.pi / abs(step[1]))))
    basis = np.stack([np.sin(turn[:n]), np.cos(turn[:n])], axis=1)
    sine, cosine = np.linalg.lstsq(basis, angle[:n], rcond=None)[0]
    first = turn[0] - step[0] + float(np.arctan2(cosine, sine))
    phase = np.empty(angle.size)
    _ukf(angle, step, amplitude, noise_sd**2, wander**2, first, 2.0 / n * (noise_sd / amplitude) ** 2, phase)
    return phase


def estimate_delay(reference: Array, estimate: Array, rate: float) -> float:
    """Time by which ``estimate`` lags behind ``reference`` [s], by least squares of the error on the rate of change.

    A delay causes an error in quadrature to the motion, the periodic error of wang2019 fig 4. An amplitude error is in
    phase with the motion; it is fitted as well and does not bias the delay.
    """
    moving = estimate - estimate.mean()
    slope = np.gradient(moving, 1.0 / rate)
    basis = np.stack([slope, moving, np.ones_like(moving)], axis=1)
    size = np.linalg.norm(basis, axis=0)
    return float(np.linalg.lstsq(basis / size, reference - estimate, rcond=None)[0][0] / size[0])


def estimate_sine_ukf(recording: Recording, device: Device) -> Motion:
    """Motion of every axis from its angle channel or position readout, with constant amplitude.

    Raises:
        DeviceInvalid: a capacitive readout, whose signal has twice the phase. ChannelMissing: an axis has no sensor.
    """
    axes, info = {}, {}
    for name, axis in device.axes.items():
        if axis.readout is not None and not isinstance(axis.readout, Position) and f"angle_{name}" not in recording:
            raise DeviceInvalid(
                f"is {axis.readout.kind}; sine-ukf needs a position readout or an angle channel",
                file=device.source,
                channel=f"{name}.readout.kind",
                hint="choose ekf or ukf",
            )
        channel, scale, zero, _ = find_position_signal(recording, axis, name)
        check_signal(channel)
        angle = (channel.read() - zero) / scale
        reference = reference_from_drive_or_signal(recording, device, name, channel)
        turn = reference.phase(channel.time())
        basis = np.stack([np.sin(turn), np.cos(turn), np.ones_like(turn)], axis=1)
        fitted, *_ = np.linalg.lstsq(basis, angle, rcond=None)
        amplitude = float(np.hypot(*fitted[:2]))
        cycle = channel.sample_rate / reference.frequency
        noise, wander = measure_noise_and_phase_walk(angle - fitted[2], turn, amplitude, cycle)
        phase = track_sine_phase(angle - fitted[2], turn, amplitude, noise, wander)
        clock = intensity_clock(recording, channel)
        filtered = with_samples(channel, amplitude * np.sin(phase) + fitted[2])
        axes[name] = replace(axis_motion_from_angle(filtered, reference, noise, clock), angle_noise_sd=0.0)
        info[name] = {"amplitude": amplitude, "offset": float(fitted[2]), "phase_wander_a_sample": wander}
    return Motion(axes, "sine-ukf", info)
