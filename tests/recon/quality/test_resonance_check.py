"""A stated resonance that the measured motion does not have is named; a slow or a resonant motion is not."""

from __future__ import annotations

from math import pi

import pytest

from tests.support.two_axis_scan import FIELD, FREQUENCIES_HZ, READOUTS, light, reconstruct, sensors

RATE_HZ = 1e6


def notes_on_x(resonance_over_motion: float) -> list[str]:
    """Notes on the resonance of x, of a device that states it at a multiple of the frequency of the motion."""
    k = 1e-15 * (2 * pi * FREQUENCIES_HZ["x"] * resonance_over_motion) ** 2
    mechanics = f"[x.mechanics]\nJ = 1e-15\nb = 1e-13\nk = {k}\n"
    channels = {**sensors(774101), "intensity": (light(774102), "V", RATE_HZ)}
    result = reconstruct(channels, READOUTS + mechanics + FIELD)
    assert result.motion.estimator == "sensor"
    return [note for note in result.notes if "the resonance of" in note]


@pytest.mark.parametrize(("multiple", "cause"), [(2.0, "sample_rate is stated halved"), (0.5, "half the drive's")])
def test_a_resonance_at_twice_or_half_the_measured_frequency_is_named(multiple: float, cause: str) -> None:
    [note] = notes_on_x(multiple)
    assert note.startswith("x: moves at 18")
    assert f"{1.0 / multiple:.3g} times the resonance" in note
    assert cause in note


@pytest.mark.parametrize("multiple", [1.0, 1.2, 10.0])
def test_a_motion_near_or_far_below_its_resonance_is_not_named(multiple: float) -> None:
    assert not notes_on_x(multiple)
