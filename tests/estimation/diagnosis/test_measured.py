"""Short segments of measured recordings whose nominal device omits effects; the examples use whole recordings."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

from benchmarks.measured import ROWS
from estimation.device_fit.data import prepare_run
from estimation.device_fit.predict import predict
from estimation.diagnosis import selection as searching
from estimation.diagnosis.diagnose import Diagnosis, build_diagnosis, diagnose
from recon.io.convert import convert
from scanner.device import Axis, Device
from scanner.recording import Recording
from scanner.stages import Mechanics, Position
from scanner.terms import catalogue

sys.path.insert(0, str(Path(__file__).parents[3] / "examples"))


@pytest.fixture
def diagnose_among(monkeypatch: pytest.MonkeyPatch):  # type: ignore[no-untyped-def]
    """A diagnosis restricted to the given effects; the whole catalogue takes minutes."""
    monkeypatch.setattr(searching, "DISCREPANCY_TERMS", {})

    def diagnosed(recording: Recording, *effects: str) -> Diagnosis:
        device = recording.device
        assert device is not None
        terms = {effect: catalogue()[effect] for effect in effects}
        return build_diagnosis(searching.select_terms([prepare_run(recording, device)], device, terms))

    return diagnosed


@pytest.mark.slow
def test_the_silverbox_has_a_cubic_spring(measured_data: Path, diagnose_among) -> None:  # type: ignore[no-untyped-def]
    from silverbox import MAPPING, multisines, simulation_error

    with convert(measured_data / "silverbox/multisine.npz", MAPPING) as whole:
        parts = multisines(whole)
        assert len(parts) == 10
        short = [part.slice(part.start, part.start + 2.5) for part in parts[2:4]]
        diagnosis = diagnose_among(short[0], "cubic-stiffness", "quintic-stiffness", "cubic-damping", "sensor-cubic")
        assert diagnosis.findings[0].effect == "cubic-stiffness"
        linear, cubic = (
            np.nanstd(simulation_error(predict(short[1], d)["sense_x"])) for d in (whole.device, diagnosis.device)
        )
        assert cubic < 0.4e-3 < 10e-3 < linear


@pytest.mark.slow
def test_the_beam_has_a_cubic_spring_and_quadratic_drag(measured_data: Path, diagnose_among) -> None:  # type: ignore[no-untyped-def]
    from beam_decay import MAPPING, START_S, held_out_samples, simulated, slow_motion

    with convert(next((measured_data / "beam_decay").glob("*.lvm")), MAPPING) as whole:
        diagnosis = diagnose_among(
            whole.slice(START_S, START_S + 3.0), "cubic-stiffness", "quadratic-drag", "coulomb-friction"
        )
    assert {finding.effect for finding in diagnosis.findings} == {"cubic-stiffness", "quadratic-drag"}
    weights = [finding.heldout["before"] for finding in diagnosis.findings]  # misfit without the effect
    assert weights == sorted(weights, reverse=True)
    assert weights[-1] > 10.0 * diagnosis.findings[0].heldout["after"]
    data = diagnosis.search.likelihood.runs[0].outputs[0].data
    frequency, modelled = (slow_motion(s - s.mean(), 1000.0)[1] for s in (data, simulated(diagnosis.search.final)))
    held_out = held_out_samples(data.size, 1000.0)
    assert np.sqrt(np.mean((frequency - modelled)[held_out] ** 2)) < 0.07 < 0.3 < frequency[held_out].std()


def test_hysteresis_and_drift_terms_explain_the_piezo_stage(measured_data: Path) -> None:
    from afm_model import LAWS, fit_laws, held_out_rms_mv, recordings

    recording = recordings(measured_data / "afm_spiral/spiral_20hz.mat")["x"]
    assert (
        held_out_rms_mv(fit_laws(recording, LAWS)) < 0.3 < 0.8 < held_out_rms_mv(fit_laws(recording, ("offset-drift",)))
    )


@pytest.mark.slow
def test_no_law_is_named_where_a_drive_was_not_recorded(measured_data: Path) -> None:
    """A membrane is driven for the first 1.4 s: another mode that has decayed by then fits most of that."""
    (recording,), _, device = ROWS["membrane-505"](measured_data)
    diagnosis = diagnose([recording], device)
    assert [(finding.effect, finding.stage) for finding in diagnosis.findings] == [("unknown", "mechanics")]


@pytest.mark.slow
def test_weak_laws_beside_a_strong_one_stay_where_little_is_left(measured_data: Path) -> None:
    """Two polynomial springs count as a series, but leave 0.04 % to a free correction of the beam's decay."""
    (recording,), _, device = ROWS["beam"](measured_data)
    diagnosis = diagnose([recording], device)
    assert diagnosis.findings[0].effect == "cubic-stiffness"
    loop = diagnosis.open_loop["sense_x"]
    assert loop["improved"]["rmse"] < 0.04 * loop["nominal"]["rmse"]


def test_a_device_without_a_drive_is_predicted_as_a_free_decay() -> None:
    rate, turn, fall = 5e3, 2 * np.pi * 40.0, 2.0
    time = np.arange(5000) / rate
    axis = Axis(Mechanics(1.0, 2 * fall, turn**2 + fall**2), readout=Position(1.0, 1e-3), name="x")
    decay = 0.3 * np.exp(-fall * time) * np.cos(turn * time + 0.4)
    recording = Recording.from_arrays({"sense_x": (decay, "V", rate, 0.0)}, Device("beam", {"x": axis}))
    assert predict(recording, Device("beam", {"x": axis}))["sense_x"].rmse < 1e-3


@pytest.mark.slow
def test_the_device_improved_by_half_a_scan_of_the_piezo_stage_has_its_offset(measured_data: Path) -> None:
    ((whole,), _, device) = ROWS["stage"](measured_data)
    diagnosis = diagnose([whole.slice(0.0, 0.5 * whole.duration)], device)
    assert diagnosis.findings[0].effect == "offset-drift"
    loop = diagnosis.open_loop["sense_x"]
    assert loop["improved"]["rmse"] < 0.1e-3 < 1e-3 < loop["nominal"]["rmse"]  # [V]


@pytest.mark.slow
def test_gravity_is_named_wherever_the_recording_of_the_pendulum_begins(measured_data: Path) -> None:
    ((whole,), _, device) = ROWS["pendulum-45"](measured_data)
    diagnosis = diagnose([whole.slice(0.25, whole.duration)], device)
    assert diagnosis.findings[0].effect == "gravity-stiffness"
    loop = diagnosis.open_loop["sense_x"]
    assert loop["improved"]["rmse"] < 0.25 * loop["nominal"]["rmse"]
