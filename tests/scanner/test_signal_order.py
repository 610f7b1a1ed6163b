"""The order in which a signal passes the laws of a device."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import permutations

import numpy as np
import pytest

from scanner.active_terms import ActiveTerm, in_signal_order
from scanner.device import Axis
from scanner.forward_model import DriveInput, sense_signal, simulate_axis
from scanner.lowpass import apply_lowpass
from scanner.stages import Drive, Mechanics, Position
from scanner.terms import catalogue

RATE = 2 * np.pi * 600.0
STEP = 1e-5
CUBIC, CORNER_HZ, DELAY_S = -0.2, 2e3, 5 * STEP
TERMS = {"sensor-cubic": CUBIC, "readout-lag": CORNER_HZ, "channel-delay": DELAY_S}


@pytest.mark.parametrize("order", list(permutations(TERMS)))
def test_a_signal_passes_the_lag_then_the_sensor_law_then_the_delay(order: Sequence[str]) -> None:
    axis = Axis(Mechanics(1e-12, 1e-10, 1e-12 * RATE**2), drive=Drive("linear", 1e-9), readout=Position(10.0, 0.0))
    terms = [ActiveTerm(catalogue()[effect], (TERMS[effect],)) for effect in order]
    motion = simulate_axis(axis, terms, DriveInput(np.zeros((2000, 3)), STEP), (0.1, 0.0))
    lagging = apply_lowpass(10.0 * motion.angle, CORNER_HZ, STEP)
    late = lagging * (1.0 + CUBIC * lagging**2)
    np.testing.assert_allclose(sense_signal(axis.require_readout(), [motion])[10:], late[5:-5], atol=1e-12)
    assert [active.term.effect for active in in_signal_order(terms)] == ["readout-lag", "sensor-cubic", "channel-delay"]
