"""Recordings of a linear axis on a test bench, simulated with scipy's integrator instead of the program's.

The bench has one axis at 500 Hz, a linear drive and a position sensor. A multisine drives it for 0.2 s.
"""

from __future__ import annotations

from functools import cache
from itertools import accumulate

import numpy as np
from scipy.integrate import solve_ivp
from scipy.interpolate import CubicSpline
from scipy.signal import lfilter

from scanner.device import Axis, Device
from scanner.recording import Recording
from scanner.stages import Drive, Mechanics, Position

RESONANCE_HZ, SAMPLE_RATE_HZ, SAMPLES = 500.0, 40e3, 8000
STIFFNESS = 1e-12 * (2 * np.pi * RESONANCE_HZ) ** 2
DEVICE = Device(
    "bench",
    {
        "x": Axis(
            Mechanics(1e-12, 1e-12 * 2 * np.pi * RESONANCE_HZ / 40, STIFFNESS),
            drive=Drive("linear", 1e-9),
            readout=Position(20.0, 2e-3),
            tolerance={"k": 0.01, "b": 0.1, "torque_per_volt": 0.05, "gain": 0.03},
            name="x",
        )
    },
)


@cache
def bench_signals(
    k3: float, b2: float, stiffness_modulation: float = 0.0, stop_stiffness: float = 0.0
) -> tuple[np.ndarray, np.ndarray]:
    """Drive voltage [V] and angle [rad] of a device a little off its nominal values, driven by a multisine.

    Args:
        k3: cubic stiffness [N m/rad^3].
        b2: quadratic drag [N m s^2].
        stiffness_modulation: relative amplitude; the stiffness oscillates six times over the recording.
        stop_stiffness: stiffness of a spring that acts beyond 1 mrad on one side, relative to the device's stiffness.
    """
    rng = np.random.default_rng(5)
    lines, phases = 30.0 + 62.5 * np.arange(14), rng.uniform(0, 2 * np.pi, 14)

    def voltage(t):  # type: ignore[no-untyped-def]
        return 1.5 * np.sin(2 * np.pi * np.multiply.outer(t, lines) + phases).sum(-1)

    J, b, k = 1e-12, 1.05 * DEVICE.axis("x").mechanics.b, 1.004 * STIFFNESS

    def rates(t, state):  # type: ignore[no-untyped-def]
        theta, rate = state
        stiffness = k * (1 + stiffness_modulation * np.cos(2 * np.pi * 6 * t * SAMPLE_RATE_HZ / SAMPLES))
        spring = stiffness * theta + k3 * theta**3 + stop_stiffness * k * max(theta - 1e-3, 0.0)
        return [rate, (1e-9 * voltage(t) - b * rate - spring - b2 * abs(rate) * rate) / J]

    time = np.arange(SAMPLES) / SAMPLE_RATE_HZ
    solution = solve_ivp(rates, (0, time[-1]), [1e-4, 0.5], "DOP853", time, rtol=1e-9, atol=1e-12, max_step=1e-4)
    return voltage(time), solution.y[0]


def bench_recording(
    k3: float = 0.0,
    b2: float = 0.0,
    seed: int = 0,
    coloured: bool = False,
    *,
    stiffness_modulation: float = 0.0,
    stop_stiffness: float = 0.0,
    delay: float = 0.0,
    delay_time_constant: float = 0.0,
    backlash: float = 0.0,
    dead_zone: float = 0.0,
    gain_drift: float = 0.0,
    offset_drift: float = 0.0,
    hum: float = 0.0,
    clip_level: float = np.inf,
) -> Recording:
    """A recording of the bench with the stated effects in mechanics and readout.

    Args:
        k3, b2, stiffness_modulation, stop_stiffness: as in :func:`bench_signals`.
        seed: of the noise.
        coloured: add slow noise and hum that the device's ``noise_sd`` does not include.
        delay: delay of the readout at an amplitude of 1 mrad [s]; it is proportional to the squared amplitude.
        delay_time_constant: time constant with which that delay follows the amplitude [s].
        backlash: half-width of a backlash that acts on two fifths of the signal [rad].
        dead_zone: half-width of the angles around 0 that the readout does not show, and by which others are less [rad].
        gain_drift: relative change of the readout's gain over the recording.
        offset_drift: amplitude of a half-wave of offset over the recording [V].
        hum: amplitude at 50 Hz [V].
        clip_level: voltage at which the readout clips [V].
    """
    drive, angle = bench_signals(k3, b2, stiffness_modulation, stop_stiffness)
    time = np.arange(SAMPLES) / SAMPLE_RATE_HZ
    if delay:
        square = angle**2 + (np.gradient(angle, 1 / SAMPLE_RATE_HZ) / (2 * np.pi * RESONANCE_HZ)) ** 2
        if delay_time_constant:
            samples = delay_time_constant * SAMPLE_RATE_HZ
            square = np.array(list(accumulate(square, lambda mean, value: mean + (value - mean) / samples)))
        angle = CubicSpline(time, angle)(time - delay * square / 1e-6)
    if backlash:
        follower = accumulate(
            angle, lambda position, value: float(np.clip(position, value - backlash, value + backlash))
        )
        angle = 0.6 * angle + 0.4 * np.array(list(follower))
    angle = angle - np.clip(angle, -dead_zone, dead_zone)
    rng = np.random.default_rng(seed)
    noise = rng.normal(0, 2e-3, SAMPLES)
    if coloured:
        slow = lfilter([1.0], [1.0, -0.95], rng.normal(0, 1e-3, SAMPLES))
        noise = noise + slow + 1e-3 * np.cos(2 * np.pi * 50 * np.arange(SAMPLES) / SAMPLE_RATE_HZ + 1.0)
    sense = 20.0 * angle * (1 + gain_drift * np.arange(SAMPLES) / SAMPLES) + noise
    sense += offset_drift * np.cos(np.pi * np.arange(SAMPLES) / SAMPLES)
    sense += hum * np.cos(2 * np.pi * 50 * np.arange(SAMPLES) / SAMPLE_RATE_HZ + 1.0)
    sense = np.clip(sense, -clip_level, clip_level)
    channels = {"drive_x": (drive, "V", SAMPLE_RATE_HZ, 0.0), "sense_x": (sense, "V", SAMPLE_RATE_HZ, 0.0)}
    return Recording.from_arrays(channels, device=DEVICE, name="bench <b>")
