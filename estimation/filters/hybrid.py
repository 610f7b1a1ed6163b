"""HYB: an extended Kalman filter that also measures the angle at each threshold crossing (chen2019 table I).

A transimpedance readout measures the rate of the angle continuously and the angle itself poorly; a crossing measures
the angle rarely and precisely. Its variance follows from Canny's formula at the filter's rate there. A crossing is
known ``CrossingDetector.latency`` samples late, so the filter runs that far behind the signal, or over a whole
recording at once.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from estimation.filters.inputs import FilterInput, prepare_filter_inputs
from estimation.filters.model import axis_capacitance, axis_step
from estimation.filters.run import process_noise_covariances, track_stride, tune_torque_noise
from estimation.filters.threshold import CrossingDetector, calibrate_crossings, find_crossings
from estimation.filters.to_motion import FilterOutput, axis_motion_from_filter
from estimation.signals import intensity_clock
from scanner.device import Axis, Device
from scanner.errors import DeviceInvalid
from scanner.motion import Motion
from scanner.recording import Recording

SIGMA_CYCLES = 0.12
"""Width sigma_DOG of the crossing detector [cycles of the motion]: the one that places crossings best at low
signal-to-noise ratio."""

SUPPRESS_CYCLES = 0.2
"""Distance within which only the largest response counts [cycles]: crossings are half a cycle apart."""


# fmt: off
@njit(cache=True)
def _filter(y, voltage, parameters, measure, q, x, P, full, event, ahead, rates, angles, variances, theta, track, stride):  # type: ignore[no-untyped-def]  # noqa: E501
    # fmt: on
    th, om = x
    p00, p01, p11 = P[0, 0], P[0, 1], P[1, 1]
    gain, offset, R = measure
    chi2, logdet, k = 0.0, 0.0, 0
    for i in range(y.size):
        old = axis_capacitance(th, *parameters)
        (th, om), (f00, f01, f10, f11), _ = axis_step(th, om, old, voltage[i], voltage[i + 1], *parameters)
        g00, g01 = f00 * p00 + f01 * p01, f00 * p01 + f01 * p11
        g10, g11 = f10 * p00 + f11 * p01, f10 * p01 + f11 * p11
        p00, p01, p11 = g00 * f00 + g01 * f01 + q[0], g00 * f10 + g01 * f11 + q[1], g10 * f10 + g11 * f11 + q[2]
        if k < event.size and event[k] == i:  # the angle, H = [1, 0]
            S = p00 + np.interp(abs(om), rates, variances)
            r = np.interp(abs(om), rates, angles) + om * ahead[k] - th
            th, om = th + p00 * r / S, om + p01 * r / S
            p00, p01, p11 = p00 - p00 * p00 / S, p01 - p00 * p01 / S, p11 - p01 * p01 / S
            k += 1
        _, slope, bend = axis_capacitance(th, *parameters)
        h0, h1 = full * gain * bend * om, gain * slope
        r = y[i] - gain * slope * om - offset
        a, b = p00 * h0 + p01 * h1, p01 * h0 + p11 * h1
        S = h0 * a + h1 * b + R
        th, om = th + a * r / S, om + b * r / S
        p00, p01, p11 = p00 - a * a / S, p01 - a * b / S, p11 - b * b / S
        chi2 += r * r / S
        logdet += np.log(S)
        theta[i] = th
        if (i + 1) % stride == 0:
            track[i // stride, 0], track[i // stride, 1] = om, p00
            track[i // stride, 2], track[i // stride, 3] = p01, p11
    return chi2, logdet


def make_detector(problem: FilterInput, sigma: float | None = None) -> CrossingDetector:
    """The crossing detector that suits a signal.

    Args:
        sigma: sigma_DOG [samples]; ``SIGMA_CYCLES`` of the motion by default.
    """
    cycle = 1.0 / (problem.references[problem.model.axes[0]].frequency * problem.model.step)
    sigma = SIGMA_CYCLES * cycle if sigma is None else sigma
    noise_sd = float(np.sqrt(problem.model.noise_var))
    return CrossingDetector(sigma, int(8 * sigma) + 2, round(SUPPRESS_CYCLES * cycle), noise_sd)


def run_hybrid(
    problem: FilterInput,
    axis: Axis,
    acceleration_variance: float,
    detector: CrossingDetector | None = None,
    *,
    full_jacobian: bool = True,
    events: bool = True,
    floor: float = 0.0,
) -> FilterOutput:
    """Run HYB over a sense signal, or its EKF alone.

    Args:
        axis: of the device. acceleration_variance: process noise Q_theta [(rad/s2)^2].
        detector: ``make_detector(problem)`` by default.
        full_jacobian: False drops h'(theta) theta' from the measurement's Jacobian, as the paper does.
        events: False leaves the crossings out, which is the paper's EKF.
        floor: standard deviation of the threshold angle itself [rad].
    """
    model = problem.model
    detector = detector or make_detector(problem)
    positions = find_crossings(problem.signal, detector) if events else np.empty(0)
    sample = np.round(positions).astype(np.int64)
    frequency = problem.references[model.axes[0]].frequency
    law = calibrate_crossings(axis, detector, frequency, model.step, floor)
    n, stride = problem.signal.size - 1, track_stride(problem)
    theta, track = np.empty(n), np.empty((n // stride, 4))
    chi2, logdet = _filter(
        problem.signal[1:],
        problem.voltage[0],
        tuple(model.parameters[0]),
        (model.gain, model.offset, model.noise_var),
        process_noise_covariances(model, np.array([acceleration_variance]))[0],
        problem.x,
        problem.P,
        float(full_jacobian),
        sample - 1,
        (sample - positions) * model.step,
        law.rates,
        law.angles,
        law.variances,
        theta,
        track,
        stride,
    )
    all_theta = np.concatenate([problem.x[:1], theta])[None, :]
    return FilterOutput(all_theta, track[None], stride, n, chi2, logdet)


def estimate_hybrid(recording: Recording, device: Device) -> Motion:
    """Motion by HYB. The crossings determine the sign only where theta_th is not zero.

    Raises:
        DeviceInvalid: a readout that is no transimpedance amplifier: its signal does not rise at a crossing.
    """
    axes, info = {}, {}
    for problem in prepare_filter_inputs(recording, device):
        (name,) = problem.model.axes if len(problem.model.axes) == 1 else ("",)
        if problem.model.kind != "transimpedance":
            raise DeviceInvalid(
                f"is {problem.model.kind}; hyb detects crossings only with a transimpedance readout",
                file=device.source,
                channel=f"{name}.readout.kind".lstrip("."),
                hint="choose ekf or ukf",
            )
        (tuned,) = tune_torque_noise(problem)
        filtered = run_hybrid(problem, device.axis(name), float(tuned))
        detector = make_detector(problem)
        clock = intensity_clock(recording, problem.sense.channel)
        axes[name] = axis_motion_from_filter(problem, filtered, 0, name, clock)
        info[problem.sense.channel.name] = {
            "torque_noise": float(tuned),
            "crossings": int(find_crossings(problem.signal, detector).size),
            "latency_s": detector.latency * problem.model.step,
            "log_likelihood": filtered.log_likelihood,
        }
    return Motion(axes, "hyb", info)
