"""Pixels that the beam would have crossed during a jump of the clock."""

from __future__ import annotations

import numpy as np
import pytest

from recon.imaging.picture import Grid
from recon.quality.clock_jumps import mark_path_during_jumps
from recon.quality.defects import PHASE_JUMP, Defect
from scanner.angle_tracks import SampledAngle
from scanner.motion import AxisMotion, Motion

RATE_HZ, HALF_RAD, JUMP_S = 1e6, 0.1, 2e-3
FREQUENCIES_HZ = {"x": 2510.0, "y": 1130.0}
TIME = np.arange(40_000) / RATE_HZ


def marked(missing: slice, start: float) -> np.ndarray:
    """Pixels beside a jump that begins at a time [s], with missing angles of both axes."""
    axes = {}
    for name, frequency in FREQUENCIES_HZ.items():
        angle = 0.98 * HALF_RAD * np.sin(2 * np.pi * frequency * TIME)
        angle[missing] = np.nan
        still = np.zeros(2)
        axes[name] = AxisMotion(still, still, still, still + frequency, still, SampledAngle(angle, RATE_HZ))
    jump = Defect("sense_x", PHASE_JUMP, start, start + JUMP_S)
    return mark_path_during_jumps(Motion(axes, "sensor"), [jump], Grid(60, 60, HALF_RAD, HALF_RAD))


@pytest.mark.parametrize(("missing", "start"), [(slice(-600, -400), TIME[-1]), (slice(500, 600), -JUMP_S)])
def test_missing_angles_beside_a_jump_change_no_mark(missing: slice, start: float) -> None:
    whole = marked(slice(0), start)
    assert whole.mean() > 0.1
    np.testing.assert_array_equal(marked(missing, start), whole)


def test_nothing_is_marked_where_no_angle_is_known() -> None:
    assert not marked(slice(None), TIME[-1]).any()
