"""Imaging scans of the blind generator: both axes are in the signal of a shared readout."""

from math import inf, pi

import numpy as np
import pytest

from benchmarks.blind.imaging import imaging, partner_output


def test_a_lag_of_a_shared_readout_keeps_the_other_axis() -> None:
    """A corner far above the signal delays it by its time constant, to second order of their ratio."""
    partner = imaging(np.random.default_rng(3)).partner
    assert partner is not None
    signal, corner = 2 * pi * 6.54e3, 2 * pi * 300e3
    clock = np.linspace(1e-3, 2e-3, 500)
    lagged = partner_output(partner, partner.truth._replace(readout_corner=corner), 3e-3, clock)
    delayed = partner_output(partner, partner.truth._replace(readout_corner=inf), 3e-3, clock - 1 / corner)
    assert np.ptp(lagged) > 0.1
    assert lagged == pytest.approx(delayed, abs=2.0 * (signal / corner) ** 2 * float(np.ptp(delayed)))
