"""A diagnosis whose recordings do not serve for all of it."""

from estimation.complete_diagnosis import UNTESTED_MOTION, diagnose_with_optics
from scanner.device import Device
from scanner.errors import BadInput
from scanner.recording import Recording
from tests.support.two_axis_scan import FIELD, RATE_HZ, READOUTS, light, sensors


def test_a_picture_that_cannot_be_made_leaves_the_diagnosis_of_the_motion() -> None:
    def refuse(recording: Recording, device: Device) -> None:
        raise BadInput("shows no motion of axis y", channel="sense")

    channels = {**sensors(772040), "intensity": (light(772040), "V", RATE_HZ)}
    recording = Recording.from_arrays(channels, Device.from_toml(READOUTS + FIELD))
    diagnosis = diagnose_with_optics([recording], measure_reference=refuse)
    assert diagnosis.untested is not None
    assert diagnosis.untested.startswith(UNTESTED_MOTION)
    assert "the picture, because it cannot be made (sense: shows no motion of axis y" in diagnosis.untested
