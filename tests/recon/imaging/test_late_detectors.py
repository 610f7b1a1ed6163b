"""A late position detector, late sync edges and a late intensity: what the picture shows of each."""

from __future__ import annotations

import re

import numpy as np
import pytest

from estimation.complete_diagnosis import diagnose_with_optics
from phantoms.sync import SyncDetector, sync_edges
from recon.evaluation import Truth, truth_from_simulation
from recon.pipeline import reconstruct
from recon.report.picture_conclusion import conclude_reconstruction
from recon.report.summary import summarise
from recon.steps.reconstruction import Options, Reconstruction
from scanner.recording import Recording
from tests.support.simulated import imaging

DELAY_S = 1e-6
EXPECTED_DEG = {"x": 360.0 * 13840.0 * DELAY_S, "y": 360.0 * 3270.0 * DELAY_S}
TOLERANCE_DEG = {"x": 0.05, "y": 0.03}
"""The drifts change the frequencies by 0.1 %, and the registration measures to 0.02°."""

UNTESTED = {
    "angle": "drive and mechanics, because angle_x moves steadily without drive_x",
    "sync": "drive and mechanics, because only sync edges show the motion",
}


def known() -> Truth:
    truth = truth_from_simulation(imaging()[1])
    assert truth is not None
    return truth


def recorded(signal: str, late: dict[str, float]) -> Recording:
    """The intensity of the scan, and another signal of the motion than its sense signal.

    Args:
        signal: "angle" or "sync".
        late: delay of the signal by axis [s].
    """
    recording, rng = imaging()[0], np.random.default_rng(6)
    names = ["intensity"] if signal == "angle" else ["intensity", "drive_x", "drive_y"]
    channels = {name: recording[name] for name in names}
    arrays = {k: (c.read(), c.unit, c.sample_rate, c.start) for k, c in channels.items()}
    for axis, (angle, rate, start) in known().angles.items():
        if signal == "angle":
            arrays[f"angle_{axis}"] = (angle + rng.normal(0.0, 1e-4, angle.size), "rad", rate, start + late[axis])
        else:
            edges = sync_edges(angle, rate, SyncDetector(0.02, jitter=5e-8), rng, start) + late[axis]
            arrays[f"sync_{axis}"] = (edges, "s", {"event": "both-edges", "angle": 0.02})
    return Recording.from_arrays(arrays, recording.device)


def reconstructed(recording: Recording) -> Reconstruction:
    return reconstruct(recording, Options(), known(), quiet=True)


def expect_found(result: Reconstruction, expected: dict[str, float]) -> None:
    for axis, degrees in expected.items():
        error = result.readout_phase[axis]
        assert np.degrees(error.value) == pytest.approx(degrees, abs=TOLERANCE_DEG[axis])


@pytest.mark.parametrize("signal", ["angle", "sync"])
def test_a_late_detector_of_the_motion_is_corrected_and_named(signal: str) -> None:
    result = reconstructed(recorded(signal, {"x": DELAY_S, "y": DELAY_S}))
    expect_found(result, EXPECTED_DEG)
    for axis in "xy":
        assert np.degrees(result.evaluation[axis].phase_rmse) < 0.05
    assert any("a delay of 1 µs" in note and "position detectors" in note for note in result.notes)
    named = {"angle": "The position signal is 4.9", "sync": "The list of sync edges is 4.9"}[signal]
    assert conclude_reconstruction(summarise(result)).startswith(named)


def test_a_detector_that_is_late_in_one_axis_does_not_shift_the_other() -> None:
    result = reconstructed(recorded("sync", {"x": 0.0, "y": DELAY_S}))
    expect_found(result, {"x": 0.0, "y": EXPECTED_DEG["y"]})
    assert not any("would explain the error of both axes" in note for note in result.notes)


def test_edges_as_stated_are_not_called_late() -> None:
    result = reconstructed(recorded("sync", {"x": 0.0, "y": 0.0}))
    assert not any("late" in note or "early" in note for note in result.notes)


def test_a_late_intensity_is_not_called_a_delay_of_the_readout() -> None:
    recording = imaging()[0]
    channels = {k: (c.read(), c.unit, c.sample_rate, c.start) for k, c in recording.channels.items()}
    values, unit, rate, start = channels["intensity"]
    channels["intensity"] = (values, unit, rate, start + DELAY_S)
    result = reconstructed(Recording.from_arrays(channels, recording.device))
    expect_found(result, {axis: -degrees for axis, degrees in EXPECTED_DEG.items()})
    assert any("an intensity that is 1 µs late" in note for note in result.notes)
    assert not any("in the readout would explain" in note for note in result.notes)
    conclusion = conclude_reconstruction(summarise(result))
    assert re.match(r"The intensity is \((0\.99|1\.00)\d+ ± 0\.00\d+\) µs late against the signals", conclusion)
    assert "Run lissajous diagnose" in conclusion


@pytest.mark.parametrize("signal", ["angle", "sync"])
@pytest.mark.parametrize("late", [("y",), ("x", "y")])
def test_the_diagnosis_names_a_late_detector_and_states_it_in_the_device(signal: str, late: tuple[str, ...]) -> None:
    """The angle begins with the delay, so that the first samples of the intensity have none."""
    recording = recorded(signal, {axis: DELAY_S * (axis in late) for axis in "xy"})
    found = diagnose_with_optics([recording])
    assert found.untested == UNTESTED[signal]
    assert [(finding.effect, finding.axis) for finding in found.findings] == [("channel-delay", late[0])]
    (delay,) = found.findings[0].parameters
    assert delay.ci95[0] < DELAY_S < delay.ci95[1]
    assert [axis for axis in "xy" if "channel-delay" in found.device.axes[axis].terms] == list(late)
    result = reconstruct(recording, Options(device=found.device, sense_only=True), known(), quiet=True)
    for axis in late:
        assert np.degrees(result.evaluation[axis].phase_rmse) < 0.2 * EXPECTED_DEG[axis]


def test_edges_as_stated_have_no_finding() -> None:
    found = diagnose_with_optics([recorded("sync", {"x": 0.0, "y": 0.0})])
    assert (found.verdict, found.findings, found.untested) == ("consistent", (), UNTESTED["sync"])
