"""The papers' filters over a recording: ACM, EKF and UKF (chen2020 algorithms 1 and 2, errors put right).

State [theta, theta'] of each axis, the readout's low-pass sections beside it; both axes in one filter where they share
an electrode. The process noise is a white torque (chen2020 eq 12); its height is tuned by likelihood, because the one
printed (1e11 (rad/s2)^2) lets a drifting resonance leave the filter behind by degrees.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from estimation.initial import Start, section_states, start_from_signal
from estimation.kernels import kernel
from estimation.model import FilterModel, filter_model
from estimation.reference import Reference
from estimation.signals import Sense, drive_voltage, intensity_clock, is_capacitive, reference_of, senses
from scanner.channel import Channel
from scanner.demodulate import block_length, block_phasors, unwrapped
from scanner.device import Device
from scanner.errors import BadInput
from scanner.motion import AngleTrack, AxisMotion, Motion
from scanner.recording import Recording

Array = NDArray[np.float64]

PRINTED_TORQUE_NOISE = 1e11  # chen2020 Table II, Q_theta [(rad/s2)^2]
TUNING_SAMPLES = 300_000
BLOCK_CYCLES = 4.0  # of the motion, a point of the Motion
TRACKS_A_CYCLE = 16


@dataclass(frozen=True)
class Problem:
    """One sense channel made ready for a filter, whichever engine runs it.

    Attributes:
        sense, start, references: where it comes from.
        model: in numbers.
        signal: sense samples, shape (n,) [V].
        voltage: on each axis's combs at the samples, shape (axes, n) [V].
        x, P: state and covariance at the first sample.
    """

    sense: Sense
    start: Start
    references: Mapping[str, Reference]
    model: FilterModel
    signal: Array
    voltage: Array
    x: Array
    P: Array


@dataclass(frozen=True)
class Filtered:
    """What a filter gives.

    Attributes:
        theta: filtered angle, shape (axes, n) [rad].
        track: omega, var(theta), cov(theta, omega), var(omega) after every ``stride``-th step, shape (axes, m, 4).
        stride: of the track.
        updates, chi2, logdet: measurements used, sum of squared normalised innovations, sum of log innovation variance.
    """

    theta: Array
    track: Array
    stride: int
    updates: int
    chi2: float
    logdet: float

    @property
    def log_likelihood(self) -> float:
        """Of the sense signal, up to a constant."""
        return -0.5 * (self.chi2 + self.logdet)


def prepare(recording: Recording, device: Device) -> list[Problem]:
    """A ``Problem`` for every sense channel; raises what ``signals.senses`` and ``start_from_signal`` raise."""
    problems = []
    for sense in senses(recording, device):
        even = is_capacitive(sense.readout)
        references = {name: reference_of(recording, device, name, sense.channel, even) for name in sense.axes}
        start = start_from_signal(sense, device, references)
        step = 1.0 / sense.channel.sample_rate
        model = filter_model(device, sense.axes, sense.readout, step, start.offset)
        t0 = np.array([sense.channel.start])
        x, variances = [], []
        for name in sense.axes:
            motion, w = start.axes[name], 2 * np.pi * float(references[name].frequency_at(t0)[0])
            turn = float(references[name].phase(t0)[0]) + motion.phase
            x += [motion.amplitude * np.sin(turn), motion.amplitude * w * np.cos(turn)]
            sd = np.hypot(
                0.02 * motion.amplitude, motion.amplitude * motion.phase_sd
            )  # calibration's part, noise's part
            variances += [sd**2, (w * sd) ** 2]
        sections = section_states(sense, device, start, references)
        swing = sum(device.axis(name).require_capacitance().C0 for name in sense.axes) if sections.size else 0.0
        problems.append(
            Problem(
                sense,
                start,
                references,
                model,
                sense.channel.read(),
                np.array([_on_samples(drive_voltage(recording, name), sense.channel) for name in sense.axes]),
                np.array([*x, *sections]),
                np.diag([*variances, *[(0.02 * swing) ** 2] * sections.size]),
            )
        )
    return problems


def _on_samples(voltage: Channel | None, sense: Channel) -> Array:
    """The voltage at the samples of ``sense``; 0 V where nothing was recorded."""
    if voltage is None:
        return np.zeros(sense.size)
    if (voltage.sample_rate, voltage.start, voltage.size) == (sense.sample_rate, sense.start, sense.size):
        return voltage.read()
    if voltage.start > sense.start + 1.0 / voltage.sample_rate or voltage.end < sense.end - 1.0 / voltage.sample_rate:
        raise BadInput(
            f"covers {voltage.start:.6g} to {voltage.end:.6g} s, {sense.name} {sense.start:.6g} to {sense.end:.6g} s",
            file=voltage.file,
            channel=voltage.name,
            hint="record both over the same time",
        )
    return np.interp(sense.time(), voltage.time(), voltage.read())


def torque_noise(model: FilterModel, heights: Array) -> Array:
    """var(theta), cov, var(omega) a step from each axis's height Q_theta (chen2020 eq 12), shape (axes, 3)."""
    h = model.step
    return np.array([[q * h**4 / 4, q * h**3 / 2, q * h**2] for q in heights])


def run_compiled(
    problem: Problem, name: str, heights: Array, samples: int | None = None, measured: bool = True
) -> Filtered:
    """Run the compiled ``"ekf"`` or ``"ukf"``.

    Args:
        heights: process noise Q_theta of each axis [(rad/s2)^2].
        samples: the first so many only.
        measured: False leaves every measurement out: the process model alone.

    Raises:
        BadInput: the filter lost its track (its covariance is no covariance any more).
    """
    model = problem.model
    signal, voltage = problem.signal[1:samples], problem.voltage[:, :samples]
    if not measured:
        signal = np.full(signal.size, np.nan)
    stride = track_stride(problem)
    theta = np.empty((len(model.axes), signal.size))
    track = np.empty((len(model.axes), signal.size // stride, 4))
    stats, x, P = np.zeros(3), problem.x.copy(), problem.P.copy()
    measure = np.array([model.gain, model.offset, model.noise_var, model.section_noise])
    kernel(name, model)(
        signal,
        voltage,
        model.parameters,
        model.sections,
        measure,
        torque_noise(model, heights),
        x,
        P,
        theta,
        track,
        stats,
        stride,
    )
    if not (np.isfinite(x).all() and np.isfinite(P).all()):
        raise BadInput(
            f"the {name.upper()} loses its track",
            file=problem.sense.channel.file,
            channel=problem.sense.channel.name,
            hint="check the device against the recording",
        )
    theta = np.concatenate([problem.x[0 : 2 * len(model.axes) : 2, None], theta], axis=1)
    return Filtered(theta, track, stride, int(stats[0]), float(stats[1]), float(stats[2]))


def track_stride(problem: Problem) -> int:
    """Samples between two points of the track: a fixed number a cycle of the fastest axis."""
    fastest = max(problem.references[name].frequency for name in problem.model.axes)
    return max(1, int(1.0 / (fastest * problem.model.step * TRACKS_A_CYCLE)))


def tuned_heights(problem: Problem) -> Array:
    """Process noise of each axis by maximum likelihood of the sense signal, to half a decade, shape (axes,).

    The start is a torque noise of 3 % of the inertial torque a sample; coordinates are searched in turn.
    """
    best = np.array(
        [
            (0.03 * motion.amplitude * (2 * np.pi * problem.references[name].frequency) ** 2) ** 2
            for name, motion in problem.start.axes.items()
        ]
    )

    def likelihood(heights: Array) -> float:
        try:
            return run_compiled(problem, "ekf", heights, TUNING_SAMPLES).log_likelihood
        except BadInput:
            return -np.inf

    top = likelihood(best)
    for factor in (10.0, 10.0**0.5):
        improved = True
        while improved:
            improved = False
            for i in range(best.size):
                for step in (factor, 1.0 / factor):
                    trial = best.copy()
                    trial[i] *= step
                    while (value := likelihood(trial)) > top:
                        best, top, improved = trial.copy(), value, True
                        trial[i] *= step
    return best


def follow(recording: Recording, device: Device, method: str) -> Motion:
    """Motion by ``"acm"``, ``"ekf"`` or ``"ukf"``; raises as ``prepare`` and ``run_compiled``."""
    axes: dict[str, AxisMotion] = {}
    info: dict[str, object] = {}
    for problem in prepare(recording, device):
        if method == "acm":
            heights = np.full(len(problem.model.axes), PRINTED_TORQUE_NOISE)
            filtered = run_compiled(problem, "ekf", heights, measured=False)
        else:
            heights = tuned_heights(problem)
            filtered = run_compiled(problem, method, heights)
            info[problem.sense.channel.name] = {
                "torque_noise": dict(zip(problem.model.axes, heights.tolist(), strict=True)),
                "mean_squared_innovation": filtered.chi2 / max(filtered.updates, 1),
                "log_likelihood": filtered.log_likelihood,
                "offset": problem.start.offset,
            }
        for i, name in enumerate(problem.model.axes):
            clock = intensity_clock(recording, problem.sense.channel)
            axes[name] = axis_motion(problem, filtered, i, name, clock)
    return Motion(axes, method, info)


def axis_motion(
    problem: Problem, filtered: Filtered, i: int, name: str, clock: tuple[float, float, int]
) -> AxisMotion:
    """The motion of axis ``i`` of a problem, its angle brought to ``clock`` (rate [Hz], start [s], samples)."""
    channel, reference = problem.sense.channel, problem.references[name]
    f = reference.frequency
    block = block_length(f, channel.sample_rate, BLOCK_CYCLES)
    time, phasors = block_phasors(filtered.theta[i], channel.sample_rate, channel.start, f, block)
    if time.size < 2:
        raise BadInput(
            f"is too short to tell the phase of axis {name}: {2 * block} samples are needed",
            file=channel.file,
            channel=channel.name,
            hint="record for longer",
        )
    phase = unwrapped(np.angle(phasors) - reference.phase(time))
    phase += 2 * np.pi * np.round((problem.start.axes[name].phase - phase[0]) / (2 * np.pi))
    at = np.arange(filtered.track.shape[1]) * filtered.stride + filtered.stride  # sample after which the track stands
    sd = np.sqrt(_phase_variance(filtered.theta[i, at], filtered.track[i], 2 * np.pi * f))
    block_of = np.minimum(at // block, time.size - 1)
    mean_sd = np.sqrt(
        np.bincount(block_of, sd**2, time.size) / np.maximum(np.bincount(block_of, minlength=time.size), 1)
    )
    return AxisMotion(
        time=time,
        phase=phase,
        amplitude=np.abs(phasors),
        frequency=reference.frequency_at(time) + np.gradient(phase, time) / (2 * np.pi),
        phase_sd=mean_sd,
        angle=slow_angle(filtered.theta[i], channel, reference, time, phase, np.abs(phasors), clock),
        reference=reference.kind,
        sign=problem.start.axes[name].sign,
    )


def slow_angle(
    theta: Array,
    channel: Channel,
    reference: Reference,
    knots: Array,
    phase: Array,
    amplitude: Array,
    clock: tuple[float, float, int],
) -> AngleTrack:
    """The angle that slow phase and amplitude make, A sin(psi + phi), with the third harmonic that the torque adds.

    A filter's angle holds the sense signal's noise from sample to sample; the motion has no such frequencies. The third
    harmonic, a part in a thousand of A in a fixed relation to the fundamental, is averaged over the whole of ``theta``.

    Args:
        theta: filtered angle at the samples of ``channel``, shape (n,) [rad].
        knots, phase, amplitude: slow clock [s], phase [rad] and amplitude [rad] on it.
        clock: (rate [Hz], start [s], samples) of the result; NaN where ``channel`` does not reach.
    """

    def fundamental(time: Array) -> tuple[Array, Array]:
        return reference.phase(time) + _extended(time, knots, phase), _extended(time, knots, amplitude)

    turn, size = fundamental(channel.time())
    third = 2.0 * np.mean((theta - size * np.sin(turn)) / size * np.exp(-3j * turn))
    rate, start, n = clock
    time = start + np.arange(n) / rate
    if (rate, start, n) != (channel.sample_rate, channel.start, channel.size):
        turn, size = fundamental(time)
    angle = size * (np.sin(turn) + np.abs(third) * np.cos(3.0 * turn + np.angle(third)))
    angle[(time < channel.start - 0.5 / rate) | (time > channel.end)] = np.nan
    return AngleTrack(angle, rate, start)


def _extended(time: Array, knots: Array, values: Array) -> Array:
    """Linear interpolation that goes on with the end's slope beyond the knots."""
    first, last = ((values[i + 1] - values[i]) / (knots[i + 1] - knots[i]) for i in (0, -2))
    inside = np.interp(time, knots, values)
    return inside + np.minimum(time - knots[0], 0.0) * first + np.maximum(time - knots[-1], 0.0) * last


def _phase_variance(theta: Array, track: Array, w: float) -> Array:
    """Variance of atan2(w theta, omega) from the state's covariance: the instantaneous phase, [rad2]."""
    rate = track[:, 0] / w
    square = theta**2 + rate**2
    along = rate**2 * track[:, 1] - 2 * theta * rate * track[:, 2] / w + theta**2 * track[:, 3] / w**2
    return along / square**2


def on_clock_of(values: Array, channel: Channel, clock: tuple[float, float, int]) -> Array:
    """Values at the samples of ``channel``, brought to a clock (rate, start, samples); NaN outside the channel."""
    rate, start, n = clock
    first = (start - channel.start) * channel.sample_rate
    if rate == channel.sample_rate and abs(first - round(first)) < 1e-6 and 0 <= round(first) <= values.size - n:
        return values[round(first) : round(first) + n]
    from scipy.interpolate import CubicSpline

    time = start + np.arange(n) / rate
    out = CubicSpline(channel.time(), values)(time)
    out[(time < channel.start) | (time > channel.end)] = np.nan
    return out
