"""The integrator compared with a plain Runge-Kutta method, and the private name of numba that it uses."""

from __future__ import annotations

import ctypes
from collections.abc import Callable

import numba
import numpy as np
import pytest

from scanner.device import Axis
from scanner.integrator.nodes import from_nodes, nodes_to_samples, to_nodes
from scanner.stages import Capacitance, Drive, Mechanics
from scanner.terms import catalogue

AXIS = Axis(Mechanics(1e-15, 5.2e-13, 9.6e-6), Capacitance(5.71e-12, 9.79e-12, 0.2, 0.01), Drive("electrostatic"))


def runge_kutta(
    derivative: Callable[[float, float, np.ndarray], np.ndarray], start: np.ndarray, voltage: np.ndarray, step: float
) -> np.ndarray:
    """Reference integration: states at all samples, (n + 1, states); ``voltage`` at the nodes, (n, 3)."""
    states = [start]
    for i, (v0, v1, v2) in enumerate(voltage):
        t, y = i * step, states[-1]
        k1 = derivative(t, v0, y)
        k2 = derivative(t + step / 2, v1, y + step / 2 * k1)
        k3 = derivative(t + step / 2, v1, y + step / 2 * k2)
        k4 = derivative(t + step, v2, y + step * k3)
        states.append(y + step / 6 * (k1 + 2 * k2 + 2 * k3 + k4))
    return np.array(states)


def test_integrator_equals_a_plain_runge_kutta_method() -> None:
    from scanner.integrator.abi import nominal_values
    from scanner.integrator.trajectories import CapacitanceTerm, TorqueTerm, integrate
    from scanner.laws import capacitance_slope

    second_mode, drift = catalogue()["second-mode"].torque, catalogue()["resonance-drift"].torque
    profile = catalogue()["profile-shape"].capacitance
    assert second_mode is not None
    assert drift is not None
    assert profile is not None
    mode_values, drift_values, shape = np.array([0.02, 16e3, 40.0]), np.array([0.005, 1e-4]), np.array([0.2])
    nominal = nominal_values(AXIS)

    def derivative(t: float, volt: float, y: np.ndarray) -> np.ndarray:
        theta, omega, z0, z1 = y
        slope = capacitance_slope(theta, nominal.C0, nominal.theta0, nominal.theta_th)
        slope += profile(theta, shape, nominal)[1]
        coupling, dz0, dz1 = second_mode(t, theta, omega, 0.0, volt, z0, z1, mode_values, nominal)
        softening, _, _ = drift(t, theta, omega, 0.0, volt, 0.0, 0.0, drift_values, nominal)
        torque = 0.5 * slope * volt**2 + coupling + softening
        return np.array([omega, (torque - nominal.b * omega - nominal.k * theta) / nominal.J, dz0, dz1])

    step = 2e-7
    voltage = to_nodes(30 + 30 * np.sin(2 * np.pi * 31e3 * np.arange(2 * 1000 + 1) * step / 2))
    expected = runge_kutta(derivative, np.array([0.1, 0.0, 0.01, 20.0]), voltage, step)
    torques = [TorqueTerm(second_mode, mode_values.tolist(), (0.01, 20.0)), TorqueTerm(drift, drift_values.tolist())]
    angle, rate = integrate(AXIS, (0.1, 0.0), voltage, step, 0.0, torques, [CapacitanceTerm(profile, shape.tolist())])
    np.testing.assert_allclose(angle, expected[:, 0], atol=1e-12)
    np.testing.assert_allclose(rate, expected[:, 1], atol=1e-12 * np.abs(expected[:, 1]).max())


def test_too_many_motions_or_terms_are_refused() -> None:
    from scanner.integrator.abi import LANES
    from scanner.integrator.trajectories import TorqueTerm, TrajectorySpec, integrate, integrate_batch

    voltage = np.zeros((10, 3))
    with pytest.raises(ValueError, match="at most 8"):
        integrate_batch([TrajectorySpec(AXIS, (0.1, 0.0))] * (LANES + 1), [voltage] * (LANES + 1), 1e-6)
    cubic = catalogue()["cubic-stiffness"].torque
    assert cubic
    with pytest.raises(ValueError, match="5 effects act on the torque"):
        integrate(AXIS, (0.1, 0.0), voltage, 1e-6, 0.0, [TorqueTerm(cubic, (0.0,))] * 5)


def test_drives_of_other_lengths_are_refused() -> None:
    from scanner.integrator.trajectories import TrajectorySpec, integrate_batch

    motions = [TrajectorySpec(AXIS, (0.1, 0.0))] * 2
    with pytest.raises(ValueError, match="for 2 motions of 10 steps"):
        integrate_batch(motions, [np.zeros((10, 3)), np.zeros((9, 3))], 1e-6)
    with pytest.raises(ValueError, match="for 2 motions of 10 steps"):
        integrate_batch(motions, [np.zeros((10, 3))], 1e-6)


def test_values_at_nodes_preserve_a_jump_between_two_steps() -> None:
    half_steps = np.arange(7.0)
    np.testing.assert_array_equal(to_nodes(half_steps), [[0, 1, 2], [2, 3, 4], [4, 5, 6]])
    np.testing.assert_array_equal(from_nodes(to_nodes(half_steps)), half_steps)
    jump = np.array([[0.0, 0.0, 0.0], [1.0, 1.0, 1.0]])
    np.testing.assert_array_equal(from_nodes(jump), [0, 0, 1, 1, 1])
    np.testing.assert_array_equal(nodes_to_samples(jump), [0, 1, 1])


def test_numba_gives_the_address_of_a_compiled_function() -> None:
    @numba.njit("float64(float64)")
    def square(x: float) -> float:
        return x * x

    try:
        from scanner.integrator.function_addresses import FunctionAddress

        address = FunctionAddress(square).__wrapper_address__()
        result = ctypes.CFUNCTYPE(ctypes.c_double, ctypes.c_double)(address)(3.0)
    except Exception as error:
        pytest.fail(
            f"numba {numba.__version__} does not give the address of a compiled function as "
            f"scanner/integrator/function_addresses.py asks for it ({type(error).__name__}: {error}). Search numba's "
            "sources for `__wrapper_address__`: the code for first-class functions calls what replaces "
            "`_get_wrapper_address(function, signature)`. Import that in function_addresses.py, or use "
            "numba.cfunc(signature)(function.py_func).address there. Until then, limit numba's version in pyproject."
        )
    assert result == 9.0
