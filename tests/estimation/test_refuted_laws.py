"""Laws of the readout that the picture refutes."""

from collections.abc import Collection, Sequence
from types import SimpleNamespace

import numpy as np
import pytest

from estimation import complete_diagnosis
from estimation.complete_diagnosis import diagnose_with_optics
from estimation.diagnosis.diagnose import Diagnosis
from estimation.diagnosis.finding import Finding
from estimation.optics import readout_selection
from scanner.device import Device
from scanner.recording import Recording
from tests.support.two_axis_scan import FIELD, RATE_HZ, READOUTS, light, sensors

GAIN_DRIFT = {"y": {"gain-drift": {"g": 0.1}}}
DELAY = {"x": {"channel-delay": {"delay": 1e-6}}}
LAG = {"x": {"drive-lag": {"f_c": 2e5}}}


def finding_of(axis: str) -> Finding:
    return Finding(axis, "drive", "drive-lag", "", (), f"drive of {axis}", 0.9, (), {}, "sense", "")


FOUND = finding_of("y")


def diagnosed(
    monkeypatch: pytest.MonkeyPatch, contradicted: Sequence[bool], nominal_sd: float = 1e-4, heeded: bool = True
) -> tuple[Diagnosis, list[set[str]]]:
    """The diagnosis of a scan whose sense signal suggests a delay, or else a lag of the drive; and what was excluded.

    Args:
        contradicted: whether the picture shows phase errors without the delay, and with it.
        nominal_sd: of the phase error without the delay [rad].
        heeded: whether the diagnosis of the motion leaves out what is excluded.
    """
    channels = {**sensors(772041), "intensity": (light(772041), "V", RATE_HZ)}
    recording = Recording.from_arrays(channels, Device.from_toml(READOUTS + FIELD))
    device, excluded = recording.device, list[set[str]]()
    assert device is not None

    def motion(recordings: object, nominal: Device, progress: object, refuted: Collection[str] = ()) -> Diagnosis:
        excluded.append(set(refuted))
        findings = tuple(map(finding_of, "xy")) if refuted else ()
        laws = LAG if refuted and heeded else DELAY
        return Diagnosis("mismatch", findings, None, nominal.with_terms({**laws, **GAIN_DRIFT}), None)

    def reference(recording: Recording, device: Device) -> SimpleNamespace:
        return SimpleNamespace(device=device, sd=np.full(2, 1e-4 if has_delay(device) else nominal_sd))

    def readout(reference: SimpleNamespace, evidence: object = None) -> tuple[tuple[Finding, ...], Device]:
        return (FOUND,) if demands(reference) else (), reference.device

    def demands(reference: SimpleNamespace) -> bool:
        return contradicted[has_delay(reference.device)]

    def has_delay(device: Device) -> bool:
        return "channel-delay" in device.axes["x"].terms

    monkeypatch.setattr(complete_diagnosis, "_diagnose_motion", motion)
    monkeypatch.setattr(complete_diagnosis, "add_optics", lambda diagnosis, recording, follow_signs: diagnosis)
    monkeypatch.setattr(readout_selection, "diagnose_readout", readout)
    monkeypatch.setattr(readout_selection, "demands_an_effect", demands)
    return diagnose_with_optics([recording], measure_reference=reference), excluded  # type: ignore[arg-type]


def test_a_delay_with_which_the_picture_shows_phase_errors_and_without_none_is_replaced(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    diagnosis, excluded = diagnosed(monkeypatch, contradicted=(False, True))
    assert set(diagnosis.device.axes["x"].terms) == {"drive-lag"}
    assert excluded == [set(), {"channel-delay"}]
    assert [each.where for each in diagnosis.findings] == [
        "drive of x; the picture refutes channel-delay",
        "drive of y",
    ]


def test_a_delay_that_the_picture_confirms_stays(monkeypatch: pytest.MonkeyPatch) -> None:
    diagnosis, excluded = diagnosed(monkeypatch, contradicted=(True, False))
    assert set(diagnosis.device.axes["x"].terms) == {"channel-delay"}
    assert excluded == [set()]


def test_a_diagnosis_that_keeps_a_refuted_law_ends(monkeypatch: pytest.MonkeyPatch) -> None:
    _, excluded = diagnosed(monkeypatch, contradicted=(False, True), heeded=False)
    assert excluded == [set(), {"channel-delay"}, {"channel-delay"}]  # and once more, with what the picture shows


@pytest.mark.parametrize(("contradicted", "nominal_sd"), [((True, True), 1e-4), ((False, True), np.inf)])
def test_a_delay_is_not_replaced_where_the_picture_does_not_fit_without_it(
    contradicted: Sequence[bool], nominal_sd: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What the picture shows in addition is then a finding of its own."""
    diagnosis, excluded = diagnosed(monkeypatch, contradicted, nominal_sd)
    assert excluded == [set(), set()]  # once more, with what the picture shows stated
    assert diagnosis.findings == (FOUND,)
