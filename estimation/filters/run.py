"""The papers' filters over a recording: ACM, EKF and UKF (chen2020 algorithms 1 and 2, with their errors corrected).

The state is [theta, theta'] of each axis and the readout's low-pass sections; both axes are in one filter where they
share an electrode. The process noise is a white torque (chen2020 eq 12). Its variance is tuned by maximum likelihood:
with the published one, 1e11 (rad/s2)^2, the filter lags a drifting resonance by degrees.
"""

from __future__ import annotations

import numpy as np

from estimation.filters.inputs import FilterInput, prepare_filter_inputs
from estimation.filters.kernels import filter_kernel
from estimation.filters.model import FilterModel
from estimation.filters.to_motion import FilterOutput, axis_motion_from_filter
from estimation.signals import intensity_clock
from scanner.arrays import Array
from scanner.device import Device
from scanner.errors import BadInput
from scanner.motion import AxisMotion, Motion
from scanner.recording import Recording

PUBLISHED_ACCELERATION_VARIANCE = 1e11
"""Process noise Q_theta of chen2020, table II [(rad/s2)^2]."""

TUNING_SAMPLES = 300_000
"""Samples by which the process noise is tuned: more do not change it by the half decade to which it is searched."""

TUNING_START_RATIO = 0.03
"""Standard deviation of the torque noise at the start of the tuning, relative to the inertial torque."""

TUNING_FACTORS = (10.0, 10.0**0.5)
"""Factors by which the process noise is varied, the coarse one first: the phase error depends on it only weakly."""

MIN_LOG_LIKELIHOOD_GAIN = 0.5
"""Gain in log likelihood by which another process noise is chosen: that of one standard deviation. Where a lower noise
is no more likely, as beside a model that errs by less than the noise shows, the search keeps the higher one."""

TRACK_POINTS_PER_CYCLE = 16
"""Points per cycle of the fastest axis at which rate and covariance are kept: enough for a mean over a cycle."""


def process_noise_covariances(model: FilterModel, acceleration_variances: Array) -> Array:
    """Covariance that white torque noise adds in a step (chen2020 eq 12).

    Args:
        acceleration_variances: Q_theta of each axis, shape (axes,) [(rad/s2)^2].

    Returns:
        var(theta), cov(theta, omega), var(omega) of each axis, shape (axes, 3).
    """
    h = model.step
    return np.array([[q * h**4 / 4, q * h**3 / 2, q * h**2] for q in acceleration_variances])


def run_compiled(
    problem: FilterInput, name: str, acceleration_variances: Array, samples: int | None = None, measured: bool = True
) -> FilterOutput:
    """Run the compiled filter.

    Args:
        name: ``"ekf"`` or ``"ukf"``.
        acceleration_variances: process noise Q_theta of each axis, shape (axes,) [(rad/s2)^2].
        samples: number of samples from the start; all by default.
        measured: False leaves every measurement out: the process model alone.

    Raises:
        BadInput: the filter diverges, so that its state or its covariance is not finite.
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
    noise = process_noise_covariances(model, acceleration_variances)
    kernel = filter_kernel(name, model)
    kernel(signal, voltage, model.parameters, model.sections, measure, noise, x, P, theta, track, stats, stride)
    if not (np.isfinite(x).all() and np.isfinite(P).all()):
        raise BadInput(
            f"the {name.upper()} loses its track",
            file=problem.sense.channel.file,
            channel=problem.sense.channel.name,
            hint="check the device against the recording",
        )
    theta = np.concatenate([problem.x[0 : 2 * len(model.axes) : 2, None], theta], axis=1)
    return FilterOutput(theta, track, stride, int(stats[0]), float(stats[1]), float(stats[2]))


def track_stride(problem: FilterInput) -> int:
    """Samples between two points of the track."""
    fastest = max(problem.references[name].frequency for name in problem.model.axes)
    return max(1, int(1.0 / (fastest * problem.model.step * TRACK_POINTS_PER_CYCLE)))


def tune_torque_noise(problem: FilterInput) -> Array:
    """Process noise of each axis by maximum likelihood of the sense signal, to half a decade.

    Axes are searched in turn, upwards and downwards, until no factor raises the log likelihood by
    ``MIN_LOG_LIKELIHOOD_GAIN``.

    Returns:
        Q_theta, shape (axes,) [(rad/s2)^2].
    """
    best = np.array(
        [
            (TUNING_START_RATIO * motion.amplitude * (2 * np.pi * problem.references[name].frequency) ** 2) ** 2
            for name, motion in problem.start.axes.items()
        ]
    )

    def log_likelihood(acceleration_variances: Array) -> float:
        try:
            return run_compiled(problem, "ekf", acceleration_variances, TUNING_SAMPLES).log_likelihood
        except BadInput:
            return -np.inf

    highest = log_likelihood(best)
    for factor in TUNING_FACTORS:
        improved = True
        while improved:
            improved = False
            for i in range(best.size):
                for step in (factor, 1.0 / factor):
                    trial = best.copy()
                    trial[i] *= step
                    while (value := log_likelihood(trial)) > highest + MIN_LOG_LIKELIHOOD_GAIN:
                        best, highest, improved = trial.copy(), value, True
                        trial[i] *= step
    return best


def estimate_with_filter(recording: Recording, device: Device, method: str) -> Motion:
    """Motion by ``"acm"``, ``"ekf"`` or ``"ukf"``.

    Raises:
        BadInput: as ``prepare_filter_inputs`` and ``run_compiled``.
    """
    axes: dict[str, AxisMotion] = {}
    info: dict[str, object] = {}
    for problem in prepare_filter_inputs(recording, device):
        if method == "acm":
            published = np.full(len(problem.model.axes), PUBLISHED_ACCELERATION_VARIANCE)
            filtered = run_compiled(problem, "ekf", published, measured=False)
        else:
            tuned = tune_torque_noise(problem)
            filtered = run_compiled(problem, method, tuned)
            info[problem.sense.channel.name] = {
                "torque_noise": dict(zip(problem.model.axes, tuned.tolist(), strict=True)),
                "mean_squared_innovation": filtered.chi2 / max(filtered.updates, 1),
                "log_likelihood": filtered.log_likelihood,
                "offset": problem.start.offset,
            }
        clock = intensity_clock(recording, problem.sense.channel)
        for i, name in enumerate(problem.model.axes):
            axes[name] = axis_motion_from_filter(problem, filtered, i, name, clock)
    return Motion(axes, method, info)
