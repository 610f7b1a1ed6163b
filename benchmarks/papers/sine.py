"""wang2019, figs 4 to 10: the sine-UKF on CW1012 (piezoresistive bridge) and on A7M20.1 (transfer function).

Truth is the equation of motion by Runge-Kutta under the drive. The reference (LDV) adds noise and the low-frequency
vibration that the paper mentions. The sensor chain has a delay. The delay's periodic error is the paper's: sqrt(2)
times the deviation of its UKF, over the motion's largest rate.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from benchmarks.papers.figures import Results, entry, figure
from estimation.filters.sine_ukf import estimate_delay, measure_noise_and_phase_walk, track_sine_phase
from phantoms.forward import InitialState, Plan, simulate_trajectory
from phantoms.waveforms import Sine
from scanner.arrays import Array
from scanner.device import Axis
from scanner.drift import Drift, exponential
from scanner.integrator.nodes import to_nodes
from scanner.integrator.trajectories import integrate
from scanner.stages import Drive, Mechanics

RATE = 1e6  # the oscilloscope's
SEED = 2019
TRIALS = 5
DEG = np.pi / 180


@dataclass(frozen=True)
class Record:
    """True angle, sensor and reference at the same samples [rad]; the motion's frequency [Hz]."""

    angle: Array
    sensor: Array
    reference: Array
    frequency: float


def linear_axis(resonance: float, quality: float, name: str = "x") -> Axis:
    """A mirror of unit inertia with a linear drive of 1 N m / V."""
    w = 2 * np.pi * resonance
    return Axis(Mechanics(1.0, w / quality, w * w), drive=Drive("linear", 1.0), name=name)


def driven(axis: Axis, frequency: float, amplitude: float, duration: float, drift: Drift) -> tuple[Array, Sine]:
    """Angle at the samples under a sine drive that gives ``amplitude``, settled, and the drive."""
    m = axis.require_mechanics()
    w = 2 * np.pi * frequency
    response = 1.0 / (m.k - w * w * m.J + 1j * w * m.b)
    plan = Plan(
        {axis.name: Sine(frequency, amplitude / abs(response))}, duration, RATE, substeps=4, drift={axis.name: drift}
    )
    turn = np.angle(response)
    start = InitialState(amplitude * np.sin(turn), amplitude * w * np.cos(turn))
    return simulate_trajectory(axis, plan, start, 0.0, duration).angle[:-1:4], plan.drives[axis.name]  # type: ignore[return-value]


def delayed(values: Array, seconds: float) -> Array:
    """The signal delayed by ``seconds``, with cubic interpolation."""
    from scipy.interpolate import CubicSpline

    n = np.arange(values.size)
    return np.asarray(CubicSpline(n, values)(np.clip(n - seconds * RATE, 0, values.size - 1)))


def measure_by_ldv(angle: Array, noise: float, vibration: float, rng: np.random.Generator) -> Array:
    """The reference: noise [rad] and a building's vibration near 30 Hz [rad]."""
    time = np.arange(angle.size) / RATE
    shake = vibration * np.sin(2 * np.pi * 30.0 * time + rng.uniform(0, 2 * np.pi))
    return angle + shake + noise * rng.standard_normal(angle.size)


def cw1012(seed: int, duration: float = 0.05) -> Record:
    """14510 Hz at +-5 deg with a slow axis of 200 Hz in the same bridge, kept apart by a band-pass (eq 3, 6).

    Noise gives the printed variance after the band-pass. The resonance moves by 10 ppm.
    """
    from scipy.signal import butter, sosfiltfilt

    rng = np.random.default_rng(seed)
    fast, _ = driven(linear_axis(14510.0, 300.0), 14510.0, 5 * DEG, duration, Drift(stiffness=exponential(2e-5, 0.02)))
    slow, _ = driven(linear_axis(1000.0, 30.0, "y"), 200.0, 5 * DEG, duration, Drift())
    bridge = delayed(fast, 14.5e-9) + 0.7 * slow  # in units of the fast axis's angle; the slow axis has another gain
    band = 9e3, 23e3
    white = 0.0151 * DEG * np.sqrt(0.5 * RATE / (band[1] - band[0])) * rng.standard_normal(fast.size)
    sensor = sosfiltfilt(butter(2, band, "bandpass", fs=RATE, output="sos"), bridge + white)
    edge = round(2e-3 * RATE)
    reference = measure_by_ldv(fast, 1e-3 * DEG, 0.0, rng)
    return Record(*(v[edge:-edge] for v in (fast, sensor, reference)), 14510.0)  # type: ignore[arg-type]


def a7m20(seed: int, duration: float = 0.3) -> Record:
    """800 Hz at +-1.3 deg; no sensor: the recorded drive voltage goes through K w_n^2 / (s^2 + 2 zeta w_n s + w_n^2)
    (eq 10).

    The oscilloscope's noise, shaped by that very function, gives the printed variance; the model's resonance is 0.2 %
    off.
    """
    rng = np.random.default_rng(seed)
    axis = linear_axis(1300.0, 10.0)
    angle, drive = driven(axis, 800.0, 1.3 * DEG, duration, Drift(stiffness=exponential(1e-4, 0.1)))
    m = axis.require_mechanics()
    half_steps = np.arange(2 * angle.size + 1) / (2 * RATE)
    volt = drive(half_steps - 7.6e-6)
    volt[::2] += 0.48 * drive.amplitude * rng.standard_normal(angle.size + 1)
    volt[1::2] = 0.5 * (volt[:-1:2] + volt[2::2])
    nominal = replace(axis, mechanics=replace(m, k=1.004 * m.k))
    modelled, _ = integrate(nominal, (angle[0], 0.0), to_nodes(volt), 1 / RATE)
    edge = round(0.02 * RATE)
    reference = measure_by_ldv(angle, 2e-3 * DEG, 5e-3 * DEG, rng)
    return Record(*(v[edge:-1] if v is modelled else v[edge:] for v in (angle, modelled, reference)), 800.0)


@dataclass(frozen=True)
class Outcome:
    """Variances of the angle error against the truth [deg^2] and the delay found [s]."""

    sensor: float
    ukf: float
    corrected: float
    late: float


def outcome(record: Record) -> tuple[Outcome, Array, Array]:
    """Errors of the sensor, of the UKF, and of the UKF with delay and amplitude corrected by the first half.

    Returns:
        the outcome on the second half, and the errors there of the UKF and of the corrected one [rad].
    """
    n = record.angle.size
    turn = 2 * np.pi * record.frequency * np.arange(n) / RATE
    basis = np.stack([np.sin(turn), np.cos(turn)], axis=1)
    half, rest = slice(0, n // 2), slice(n // 2, None)
    sensor_fit, *_ = np.linalg.lstsq(basis[half], record.sensor[half], rcond=None)
    amplitude = float(np.hypot(*sensor_fit))
    noise, phase_walk = measure_noise_and_phase_walk(record.sensor, turn, amplitude, RATE / record.frequency)
    phase = track_sine_phase(record.sensor, turn, amplitude, noise, phase_walk)
    estimate = amplitude * np.sin(phase)
    late = estimate_delay(record.reference[half], estimate[half], RATE)
    reference_fit, *_ = np.linalg.lstsq(basis[half], record.reference[half], rcond=None)
    corrected = float(np.hypot(*reference_fit)) * np.sin(phase + 2 * np.pi * record.frequency * late)
    errors = [v[rest] - record.angle[rest] for v in (record.sensor, estimate, corrected)]
    variances = [float(np.var(e)) / DEG**2 for e in errors]
    return Outcome(*variances, late), errors[1], errors[2]


PAPER = {"cw1012": (2.17e-4, 2.17e-5), "a7m20": (0.0067, 0.0012)}
DEVICES = {"cw1012": cw1012, "a7m20": a7m20}


def results() -> Results:
    """Entries of ``results.json``; draws figs 7 to 10."""
    out: Results = {}
    for name, make in DEVICES.items():
        outcomes = [outcome(make(SEED + i))[0] for i in range(TRIALS)]
        before, after, corrected = (
            float(np.mean([getattr(o, k) for o in outcomes])) for k in ("sensor", "ukf", "corrected")
        )
        paper = PAPER[name]
        numbers = {
            "sensor_variance_deg2": (paper[0], before),
            "ukf_variance_deg2": (paper[1], after),
            "variance_ratio_as_printed": (paper[0] / paper[1], before / after),
            "corrected_variance_deg2": (paper[1], corrected),
            "variance_ratio": (paper[0] / paper[1], before / corrected),
            "delay_found_us": (None, 1e6 * float(np.mean([o.late for o in outcomes]))),
        }
        out |= {f"wang2019.{name}.{key}": entry(p, value, TRIALS, SEED) for key, (p, value) in numbers.items()}
        draw(name, make(SEED))
    return out


def draw(name: str, record: Record) -> None:
    _, plain, corrected = outcome(record)
    shown = round(6 * RATE / record.frequency)
    time = 1e3 * np.arange(shown) / RATE
    half = record.angle.size - plain.size
    with figure(f"wang2019_{name}", columns=2, size=(9.0, 3.2)) as axes:
        for values, label in (
            (record.sensor[half:], "sensor"),
            (record.reference[half:], "LDV"),
            (record.angle[half:] + plain, "UKF"),
        ):
            axes[0, 0].plot(time, values[:shown] / DEG, lw=0.8, label=label)
        for values, label in (
            (record.sensor[half:] - record.angle[half:], "sensor"),
            (plain, "UKF"),
            (corrected, "UKF, delay removed"),
        ):
            axes[0, 1].plot(time, values[:shown] / DEG, lw=0.8, label=label)
        for drawn, label in zip(axes[0], ("angle [deg]", "error [deg]"), strict=True):
            drawn.set(xlabel="time [ms]", ylabel=label)
            drawn.legend(fontsize=7)
