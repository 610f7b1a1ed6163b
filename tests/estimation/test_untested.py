"""A diagnosis whose recordings do not serve for all of it."""

import pytest

from estimation import complete_diagnosis
from estimation.complete_diagnosis import diagnose_with_optics
from estimation.diagnosis.diagnose import Diagnosis
from scanner.device import Device
from scanner.errors import BadInput
from scanner.recording import Recording
from tests.support.two_axis_scan import FIELD, RATE_HZ, READOUTS, light, sensors


def scan() -> Recording:
    channels = {**sensors(772040), "intensity": (light(772040), "V", RATE_HZ)}
    return Recording.from_arrays(channels, Device.from_toml(READOUTS + FIELD))


def refuse(recording: Recording, device: Device) -> None:
    raise BadInput("shows no motion of axis y", channel="sense")


def test_a_picture_that_cannot_be_made_leaves_the_diagnosis_of_the_motion(monkeypatch: pytest.MonkeyPatch) -> None:
    recording = scan()
    motion = Diagnosis("consistent", (), None, recording.device, None)
    monkeypatch.setattr(complete_diagnosis, "_diagnose_motion", lambda *arguments: motion)
    diagnosis = diagnose_with_optics([recording], measure_reference=refuse)
    assert diagnosis.untested == "the picture, because it cannot be made (sense: shows no motion of axis y)"


def test_a_scan_that_tests_neither_motion_nor_picture_is_refused() -> None:
    with pytest.raises(BadInput, match="shows no motion of axis y"):
        diagnose_with_optics([scan()], measure_reference=refuse)
