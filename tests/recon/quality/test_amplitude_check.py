"""A device file of another mirror: the picture's scale is stated as uncertain, not by the tolerances alone."""

from dataclasses import replace

import pytest

import lissajous
from scanner import devices
from scanner.device import Device

OWN = devices.load("imaging")


def other_mirror() -> Device:
    """The same mirror with combs of another make."""
    axes = {
        name: replace(axis, capacitance=replace(axis.capacitance, C0=3.2e-12, theta0=0.14))  # type: ignore[type-var]
        for name, axis in OWN.axes.items()
    }
    return replace(OWN, axes=axes)


@pytest.mark.parametrize("stated", [OWN, other_mirror()], ids=["own", "other"])
def test_scale_of_the_picture(stated: Device) -> None:
    recording, truth = lissajous.simulate(OWN, duration=0.08, nominal=stated, seed=3, angles=True)
    result = lissajous.reconstruct(recording)
    notes = [each for each in result.notes if "contradicts the device" in each]
    assert len(notes) == (0 if stated is OWN else 2)
    for name, axis in result.motion.axes.items():
        sd = result.amplitude_calibration[name]
        assert sd is not None
        error = float(axis.amplitude.mean()) / (float(truth[f"angle_{name}"][0].std()) * 2**0.5) - 1.0
        assert abs(error) < 2.0 * sd
        assert (sd < 0.05) == (stated is OWN)
