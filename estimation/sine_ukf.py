"""The sine-UKF of wang2019: a steady sinusoidal motion followed in its phase, through whatever sensor shows its angle.

State s, the phase; s(k+1) = s(k) + 2 pi f T + w, z = A sin s + v (eq 14, 16). The paper inverts the sensor with arcsin
(eq 12 to 14), which is two-valued and blind at the turning points; here the phase is the state and is never inverted.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from estimation.signals import intensity_clock
from estimation.steady import axis_from_angle, position_channel, reference_for
from scanner.channel import check_signal
from scanner.device import Device, Position
from scanner.errors import DeviceInvalid
from scanner.motion import Motion
from scanner.recording import Recording

Array = NDArray[np.float64]

_SPREAD = 3.0  # n + kappa for n = 1 state: Julier's choice for a Gaussian


BLOCK_CYCLES = 4.0


@njit(cache=True)
def _ukf(z, step, amplitude, R, Q, s, P, phase):  # type: ignore[no-untyped-def]
    half, centre = 0.5 / _SPREAD, 1.0 - 1.0 / _SPREAD
    for i in range(z.size):
        s += step[i]
        P += Q
        reach = np.sqrt(_SPREAD * P)
        above, middle, below = amplitude * np.sin(s + reach), amplitude * np.sin(s), amplitude * np.sin(s - reach)
        mean = half * (above + below) + centre * middle
        S = half * ((above - mean) ** 2 + (below - mean) ** 2) + centre * (middle - mean) ** 2 + R
        cross = half * reach * (above - below)
        s += cross / S * (z[i] - mean)
        P -= cross * cross / S
        phase[i] = s


def noise_and_wander(angle: Array, turn: Array, amplitude: float, cycle: float) -> tuple[float, float]:
    """White noise of the sensor near the motion's frequency [rad] and the phase's random walk over a sample [rad].

    From the phase of blocks of a few cycles: neighbours differ by noise, distant ones by what the phase has wandered
    too. Noise that a band-pass or a resonance has coloured is weighed at the frequency that matters, which neither the
    samples' variance nor the likelihood of a filter that believes in white noise would do.

    Args:
        angle, turn: as of ``sine_ukf``. cycle: of the motion [samples].
    """
    block = max(8, round(BLOCK_CYCLES * cycle))
    count = angle.size // block
    mixed = angle[: count * block] * np.exp(-1j * turn[: count * block])
    phase = np.unwrap(np.angle(mixed.reshape(count, block).sum(axis=1)))
    far = max(2, count // 4)
    if count < 2 * far:
        return float(np.std(angle) / np.sqrt(2.0)), 0.0
    near, distant = (float(np.mean((phase[lag:] - phase[:-lag]) ** 2)) for lag in (1, far))
    white = amplitude * np.sqrt(0.25 * near * block)  # the block's phase has variance 2 R / (A^2 block)
    return float(white), float(np.sqrt(max(distant - near, 0.0) / ((far - 1) * block)))


def sine_ukf(angle: Array, turn: Array, amplitude: float, noise_sd: float, wander: float) -> Array:
    """Phase of a noisy sine.

    Args:
        angle: sensor's angle, shape (n,) [rad].
        turn: 2 pi f t at its samples, shape (n,) [rad]: the reference phase that the motion runs along.
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


def delay(reference: Array, estimate: Array, rate: float) -> float:
    """Time by which ``estimate`` is late against ``reference`` [s], by least squares of the error on the rate of
    change.

    A delay leaves an error in quadrature to the motion, periodic and invisible to any filter: the periodic error of
    wang2019 fig 4. An amplitude error, in phase with the motion, is fitted beside it and does not disturb it.
    """
    moving = estimate - estimate.mean()
    slope = np.gradient(moving, 1.0 / rate)
    basis = np.stack([slope, moving, np.ones_like(moving)], axis=1)
    size = np.linalg.norm(basis, axis=0)
    return float(np.linalg.lstsq(basis / size, reference - estimate, rcond=None)[0][0] / size[0])


def sine_ukf_motion(recording: Recording, device: Device) -> Motion:
    """Motion of every axis that has an angle channel or a position readout, its amplitude taken as steady.

    Raises:
        DeviceInvalid: a capacitive readout, which shows the phase twice over. ChannelMissing: an axis has no sensor.
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
        channel, scale, zero, _ = position_channel(recording, axis, name)
        check_signal(channel)
        angle = (channel.read() - zero) / scale
        reference = reference_for(recording, device, name, channel)
        turn = reference.phase(channel.time())
        basis = np.stack([np.sin(turn), np.cos(turn), np.ones_like(turn)], axis=1)
        fitted, *_ = np.linalg.lstsq(basis, angle, rcond=None)
        amplitude = float(np.hypot(*fitted[:2]))
        cycle = channel.sample_rate / reference.frequency
        noise, wander = noise_and_wander(angle - fitted[2], turn, amplitude, cycle)
        phase = sine_ukf(angle - fitted[2], turn, amplitude, noise, wander)
        clock = intensity_clock(recording, channel)
        axes[name] = axis_from_angle(amplitude * np.sin(phase) + fitted[2], channel, reference, noise, clock)
        info[name] = {"amplitude": amplitude, "offset": float(fitted[2]), "phase_wander_a_sample": wander}
    return Motion(axes, "sine-ukf", info)
