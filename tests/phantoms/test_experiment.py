"""Arguments of a simulated scan."""

from __future__ import annotations

import pytest

import lissajous
from scanner.errors import BadInput


def test_a_drift_of_an_axis_that_does_not_exist_is_refused() -> None:
    with pytest.raises(BadInput, match="drift: names 'z'; name the axes x and y"):
        lissajous.simulate(duration=1e-3, drift={"x": 0.0, "z": -0.002})
