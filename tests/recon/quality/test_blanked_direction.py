"""A light or a detector that is off in one direction of an axis, as in scans that record one direction only."""

from __future__ import annotations

import numpy as np
import pytest

from tests.support.two_axis_scan import FIELD, RATE_HZ, READOUTS, angles, light, reconstruct, sensors

LINE = "do not show the scene that the others show"


@pytest.mark.parametrize(("axis", "sign", "direction"), [("x", 1, "falls"), ("x", -1, "rises"), ("y", 1, "falls")])
def test_a_blanked_direction_is_named(axis: str, sign: int, direction: str) -> None:
    on = sign * np.gradient(angles()[axis]) > 0.0
    values = np.where(on, light(1), 0.0)
    result = reconstruct({**sensors(1), "intensity": (values, "V", RATE_HZ)}, READOUTS + FIELD)
    (line,) = (limit for limit in result.limits if LINE in limit)
    assert f"while {axis} {direction} " in line
    assert "half-periods disagree" not in " ".join(result.limits)


@pytest.mark.parametrize("off", [None, np.nan])
def test_both_directions_or_left_out_samples_are_no_error(off: float | None) -> None:
    values = light(1)
    if off is not None:
        values = np.where(np.gradient(angles()["x"]) > 0.0, values, off)
    result = reconstruct({**sensors(1), "intensity": (values, "V", RATE_HZ)}, READOUTS + FIELD)
    assert not any(LINE in limit for limit in result.limits)
