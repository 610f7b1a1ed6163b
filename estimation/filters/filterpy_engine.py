"""The same filters in filterpy: the readable engine, against which the compiled one is tested.

Both use ``axis_step`` and ``axis_capacitance``; the filter algebra here is filterpy's.
"""

from __future__ import annotations

import math

import numpy as np

from estimation.filters.inputs import FilterInput
from estimation.filters.model import MOTION_ORDER, FilterModel, axis_capacitance, axis_step
from estimation.filters.run import process_noise_covariances
from scanner.arrays import Array


def predict_state(model: FilterModel, x: Array, v0: Array, v1: Array) -> Array:
    """The state one sample later, under voltages ``v0`` and ``v1`` at the step's ends, shape (axes,)."""
    out = np.array(x)
    old = new = 0.0
    for a, parameters in enumerate(model.parameters):
        start = axis_capacitance(x[2 * a], *parameters)
        out[2 * a : 2 * a + 2], _, end = axis_step(x[2 * a], x[2 * a + 1], start, v0[a], v1[a], *parameters)
        old += start[0]
        new += end[0]
    for s, (e, p, q) in enumerate(model.sections):
        u = 2 * len(model.axes) + s
        out[u] = e * x[u] + p * old + q * new
        old, new = x[u], out[u]
    return out


def state_jacobian(model: FilterModel, x: Array, v0: Array, v1: Array) -> Array:
    """Derivative of ``predict_state`` on the state, shape (states, states)."""
    n = model.states
    F = np.zeros((n, n))
    old, new = np.zeros(n), np.zeros(n)  # gradients of the section's input at the step's ends
    for a, parameters in enumerate(model.parameters):
        at = slice(2 * a, 2 * a + 2)
        start = axis_capacitance(x[2 * a], *parameters)
        _, jacobian, end = axis_step(x[2 * a], x[2 * a + 1], start, v0[a], v1[a], *parameters)
        F[at, at] = np.reshape(jacobian, (2, 2))
        old[2 * a] = start[1]
        new[at] = end[1] * F[2 * a, at]
    for s, (e, p, q) in enumerate(model.sections):
        u = 2 * len(model.axes) + s
        before = np.eye(n)[u]
        F[u] = e * before + p * old + q * new
        old, new = before, F[u]
    return F


def predict_measurement(model: FilterModel, x: Array) -> Array:
    """Sense voltage at state ``x``, shape (1,)."""
    if len(model.sections):
        sensed = x[-1]
    elif model.kind == "amdm":
        sensed = sum(axis_capacitance(x[2 * a], *parameters)[0] for a, parameters in enumerate(model.parameters))
    elif model.kind == "transimpedance":
        sensed = axis_capacitance(x[0], *model.parameters[0])[1] * x[1]
    else:
        sensed = x[MOTION_ORDER[model.kind]]
    return np.array([model.gain * sensed + model.offset])


def measurement_jacobian(model: FilterModel, x: Array) -> Array:
    """Derivative of ``predict_measurement``, shape (1, states)."""
    H = np.zeros((1, model.states))
    if len(model.sections):
        H[0, -1] = model.gain
    elif model.kind == "amdm":
        for a, parameters in enumerate(model.parameters):
            H[0, 2 * a] = model.gain * axis_capacitance(x[2 * a], *parameters)[1]
    elif model.kind == "transimpedance":
        _, slope, curvature = axis_capacitance(x[0], *model.parameters[0])
        H[0, :2] = model.gain * curvature * x[1], model.gain * slope
    else:
        H[0, MOTION_ORDER[model.kind]] = model.gain
    return H


def run_filterpy(
    problem: FilterInput, name: str, acceleration_variances: Array, samples: int | None = None
) -> tuple[Array, Array]:
    """Run filterpy's ``"ekf"`` or ``"ukf"`` over the first ``samples``.

    Args:
        acceleration_variances: process noise Q_theta of each axis, shape (axes,) [(rad/s2)^2].

    Returns:
        states, shape (n, states), and covariances, shape (n, states, states), after every sample, the first included.
    """
    from filterpy.kalman import ExtendedKalmanFilter, JulierSigmaPoints, UnscentedKalmanFilter

    model, n = problem.model, problem.model.states
    Q = np.zeros((n, n))
    for a, (q11, q12, q22) in enumerate(process_noise_covariances(model, acceleration_variances)):
        Q[2 * a : 2 * a + 2, 2 * a : 2 * a + 2] = [[q11, q12], [q12, q22]]
    for u in range(2 * len(model.axes), n):
        Q[u, u] = model.section_noise
    if name == "ekf":
        engine = ExtendedKalmanFilter(dim_x=n, dim_z=1)
    else:
        points = JulierSigmaPoints(n, kappa=max(3 - n, 0))
        engine = UnscentedKalmanFilter(n, 1, model.step, lambda x: predict_measurement(model, x), None, points)
    engine.x, engine.P, engine.Q = problem.x.copy(), problem.P.copy(), Q
    engine.R = np.array([[model.noise_var]])
    states, covariances = [problem.x], [problem.P]
    signal = problem.signal[:samples]
    for i in range(1, signal.size):
        v0, v1 = problem.voltage[:, i - 1], problem.voltage[:, i]
        z = None if math.isnan(signal[i]) else np.array([signal[i]])
        if name == "ekf":
            F = state_jacobian(model, engine.x, v0, v1)
            engine.x = predict_state(model, engine.x, v0, v1)
            engine.P = F @ engine.P @ F.T + Q
            engine.update(z, lambda x: measurement_jacobian(model, x), lambda x: predict_measurement(model, x))
        else:
            engine.predict(fx=lambda x, dt, v0=v0, v1=v1: predict_state(model, x, v0, v1))
            engine.update(z)
        states.append(engine.x.copy())
        covariances.append(engine.P.copy())
    return np.array(states), np.array(covariances)
