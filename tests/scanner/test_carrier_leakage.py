"""A carrier that reaches the detector without passing the comb."""

import numpy as np
import pytest

from scanner.active_terms import ActiveTerm
from scanner.device import Axis
from scanner.forward_model import DriveInput, sense_signal, simulate_axis
from scanner.laws import capacitance
from scanner.stages import Amdm, Capacitance, Mechanics
from scanner.terms import catalogue

RATE = 2 * np.pi * 600.0


@pytest.mark.parametrize("offset", [6.0, 3.0])
def test_a_leaking_carrier_adds_to_that_through_the_comb(offset: float) -> None:
    """It added to the output with its offset, of which a negative one became its magnitude, even without leakage."""
    comb, gain = Capacitance(5e-12, 1e-11, 0.2), -4e11
    axis = Axis(
        Mechanics(1e-12, 1e-12 * RATE / 1e3, 1e-12 * RATE**2), comb, readout=Amdm(gain, offset, (), 0.0), name="x"
    )
    inputs = DriveInput(np.zeros((200, 3)), 1 / 60e3)
    for leak in (0.0, 1.0):
        terms = [ActiveTerm(catalogue()["carrier-leakage"], (0.3 * leak, 0.4 * leak))]
        motion = simulate_axis(axis, terms, inputs, (0.2, 0.0))
        carrier = capacitance(motion.angle, comb.C0, comb.Cb, comb.theta0, comb.theta_th) + leak * (0.3 + 0.4j) / gain
        expected = gain * np.abs(carrier) + offset
        np.testing.assert_allclose(sense_signal(axis.require_readout(), [motion]), expected, rtol=1e-9)
