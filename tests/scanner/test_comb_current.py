"""The current of a comb: -C'(θ) θ' times the bias, whatever drives the comb."""

import numpy as np
import pytest

from scanner.active_terms import ActiveTerm
from scanner.device import Axis
from scanner.forward_model import DriveInput, sense_signal, simulate_axis
from scanner.laws import capacitance
from scanner.stages import Capacitance, Drive, Mechanics, Transimpedance
from scanner.terms import SignalContext, catalogue

BIAS_V = 5.0
RATE = 2 * np.pi * 3000.0
AXIS = Axis(
    Mechanics(1e-14, 1e-14 * RATE / 300.0, 1e-14 * RATE**2),
    Capacitance(2e-12, 1e-11, 0.2, 0.0),
    Drive("electrostatic"),
    Transimpedance(2e7, BIAS_V, noise_sd=1e-3),
    name="x",
)


@pytest.mark.parametrize(("is_bias", "ratio"), [(False, 1.0), (True, 2.0)])
def test_the_bias_of_the_current_is_the_stated_one_unless_it_was_recorded(is_bias: bool, ratio: float) -> None:
    recorded = DriveInput(np.full((400, 3), 2.0 * BIAS_V), 5e-6, is_bias=is_bias)
    motion = simulate_axis(AXIS, (), recorded, (3e-3, 0.0))
    found = sense_signal(AXIS.require_readout(), [motion])
    expected = -2e7 * BIAS_V * np.gradient(capacitance(motion.angle, 2e-12, 1e-11, 0.2, 0.0), 5e-6, edge_order=2)
    assert np.std(found - ratio * expected) < 0.01 * np.std(found)


def test_a_carrier_changes_the_torque_and_not_the_current_under_a_bias() -> None:
    """The current had the root of the mean square of bias and carrier as its bias: it was 31 % too large here."""
    terms = [ActiveTerm(catalogue()["carrier-torque"], (18.0,))]
    bias = DriveInput(np.full((400, 3), BIAS_V), 5e-6, is_bias=True)
    motion, without = (simulate_axis(AXIS, each, bias, (0.1, 0.0)) for each in (terms, ()))
    found = sense_signal(AXIS.require_readout(), [motion])
    expected = -2e7 * BIAS_V * np.gradient(capacitance(motion.angle, 2e-12, 1e-11, 0.2, 0.0), 5e-6, edge_order=2)
    assert np.std(found - expected) < 0.01 * np.std(found)
    assert np.std(motion.angle - without.angle) > 1e-4 * np.std(motion.angle)


def test_a_carrier_adds_to_the_mean_square_of_a_bias_of_either_sign() -> None:
    carrier = catalogue()["carrier-torque"].voltage
    assert carrier is not None
    context = SignalContext(np.zeros(3), 1.0, None, *(np.zeros(3) for _ in range(4)))
    np.testing.assert_allclose(carrier(np.array([-20.0, 20.0]), (18.0,), context), [-np.sqrt(418.0), np.sqrt(418.0)])
