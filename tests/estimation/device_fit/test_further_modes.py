"""Further modes in the signal of a sensor of motion: stated where no effect of one mode explains them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from estimation.device_fit.data import Run, prepare_run
from estimation.device_fit.further_modes import _band, _Columns, _fit, _heights, find_modes, with_driven_modes
from estimation.diagnosis import diagnose as diagnosing
from recon.report.diagnosis_conclusion import conclude_diagnosis
from scanner.active_terms import stated_terms
from scanner.arrays import Array
from scanner.device import Axis, Device
from scanner.forward_model import DriveInput, sense_signal, simulate_axis
from scanner.integrator.nodes import to_nodes
from scanner.recording import Recording
from scanner.stages import Acceleration, Drive, Mechanics, MotionSensor, Position, Velocity
from scanner.terms import catalogue

RATE, DURATION, RESONANCE = 400.0, 60.0, 2 * np.pi * 7.3
MODES: dict[str, Any] = {
    "frequency": [3.4, 5.1, 9.0], "quality": [25.0, 40.0, 45.0], "gain": [0.006, 0.004, 0.003],
    "gain_rate": [0.0, 0.0, 0.001], "direct": 0.1,
}  # fmt: skip


def axis(readout: MotionSensor, quality: float = 60.0) -> Axis:
    mechanics = Mechanics(1.0, RESONANCE / quality, RESONANCE**2)
    tolerance = {"J": 1e-9, "gain": 1e-9, "k": 0.05, "b": 0.5, "torque_per_volt": 0.5}
    return Axis(mechanics, drive=Drive("linear", 0.015), readout=readout, tolerance=tolerance, name="x")


def multisine(rng: np.random.Generator) -> Array:
    """Tones of 2 to 15 Hz with random phases, of 1 V rms, at the samples and between them."""
    time = np.arange(2 * int(DURATION * RATE) + 1) / (2 * RATE)
    tones = np.arange(2.0, 15.0, 1 / DURATION)
    waves = sum(
        np.cos(2 * np.pi * f * time + phase) for f, phase in zip(tones, rng.uniform(0, 7, tones.size), strict=True)
    )
    return np.asarray(waves / np.std(waves))


def prepared(
    terms: dict[str, dict[str, Any]], readout: MotionSensor, seed: int = 5
) -> tuple[list[Run], Axis, Recording]:
    """A simulated recording of a device with ``terms`` that the nominal axis omits."""
    rng = np.random.default_rng(seed)
    halves, nominal = multisine(rng), axis(readout)
    true = Device("wing", {"x": nominal}).with_terms({"x": terms}).axes["x"]
    motion = simulate_axis(true, stated_terms(true), DriveInput(to_nodes(halves), 1 / RATE), (0.0, 0.0))
    sensed = sense_signal(readout, [motion]) + readout.noise_sd * rng.standard_normal(motion.angle.size)
    channels = {"drive_x": (halves[::2], "V", RATE, 0.0), "sense_x": (sensed, "V", RATE, 0.0)}
    recording = Recording.from_arrays(channels, Device("wing", {"x": nominal}))
    return [prepare_run(recording, recording.device)], nominal, recording  # type: ignore[arg-type]


def test_the_further_modes_of_a_structure_are_found_beside_a_softening_one() -> None:
    softening = {"k3": -0.15 * RESONANCE**2 / 1.2e-3**2}
    runs, nominal, _ = prepared({"driven-modes": MODES, "cubic-stiffness": softening}, Acceleration(1.0, 0.02))
    found = find_modes(runs, nominal)
    assert found is not None
    for frequency, gain in zip(MODES["frequency"], MODES["gain"], strict=True):
        nearest = int(np.argmin(np.abs(np.array(found["frequency"]) - frequency)))
        assert found["frequency"][nearest] == pytest.approx(frequency, rel=0.01)  # type: ignore[index]
        assert found["gain"][nearest] == pytest.approx(gain, rel=0.25)  # type: ignore[index]


@pytest.mark.parametrize(
    "terms",
    [
        {},
        {"cubic-stiffness": {"k3": -0.15 * RESONANCE**2 / 1.2e-3**2}},
        {"coulomb-friction": {"tau_c": 4e-3, "omega_s": 1e-4}},
        {"feedthrough": {"g": 0.05, "h": 0.0, "omega_d": RESONANCE}},
        {"second-mode": {"c": 0.02, "f2": 9.0, "Q2": 40.0}},
    ],
)
@pytest.mark.parametrize("readout", [Acceleration(1.0, 0.02), Position(1000.0, 0.01)])
def test_one_mode_and_effects_of_the_catalogue_are_no_further_modes(
    terms: dict[str, dict[str, float]], readout: MotionSensor
) -> None:
    runs, nominal, _ = prepared(terms, readout)
    assert find_modes(runs, nominal) is None


@pytest.mark.parametrize("readout", [Velocity(30.0, 1e-3), Position(1000.0, 1e-3)])
def test_every_sensor_of_motion_shows_further_modes(readout: MotionSensor) -> None:
    runs, nominal, _ = prepared({"driven-modes": {**MODES, "direct": 0.0}}, readout)
    found = find_modes(runs, nominal)
    assert found is not None
    assert found["frequency"] == pytest.approx(MODES["frequency"], rel=0.01)
    assert found["gain"] == pytest.approx(MODES["gain"], rel=0.05)


def test_only_acceleration_signals_are_searched_before_laws_are_selected() -> None:
    runs, _, recording = prepared({"driven-modes": MODES}, Position(1000.0, 1e-3))
    device = recording.device
    assert device is not None
    assert with_driven_modes(runs, device) is device
    assert with_driven_modes(runs, device, unexplained=True) is not device


def test_a_single_mode_that_no_law_explains_is_stated(monkeypatch: pytest.MonkeyPatch) -> None:
    """In opposite phase to the mirror's own: ``second-mode`` is driven by the mirror and in phase below both."""
    known = {effect: catalogue()[effect] for effect in ("cubic-stiffness", "second-mode", "feedthrough")}
    monkeypatch.setattr(diagnosing, "catalogue", lambda: known)
    mode = {"frequency": [11.0], "quality": [40.0], "gain": [-0.012], "gain_rate": [0.0], "direct": 0.0}
    *_, recording = prepared({"driven-modes": mode}, Position(1000.0, 1e-3))
    diagnosis = diagnosing.diagnose([recording])
    assert diagnosis.further_modes["x"]["frequency"] == pytest.approx([11.0], rel=1e-3)
    assert diagnosis.device.axes["x"].terms["driven-modes"]["gain"] == pytest.approx([-0.012], rel=0.01)
    errors = diagnosis.open_loop["sense_x"]
    assert errors["improved"]["rmse"] < 0.1 * errors["nominal"]["rmse"]


def test_a_diagnosis_states_further_modes_and_the_law_beside_them(monkeypatch: pytest.MonkeyPatch) -> None:
    known = {effect: catalogue()[effect] for effect in ("cubic-stiffness", "cubic-damping", "feedthrough")}
    monkeypatch.setattr(diagnosing, "catalogue", lambda: known)
    softening = {"k3": -0.15 * RESONANCE**2 / 1.2e-3**2}
    *_, recording = prepared({"driven-modes": MODES, "cubic-stiffness": softening}, Acceleration(1.0, 0.02), seed=6)
    diagnosis = diagnosing.diagnose([recording])
    assert [finding.effect for finding in diagnosis.findings][:1] == ["cubic-stiffness"]
    assert diagnosis.findings[0].parameters[0].value == pytest.approx(softening["k3"], rel=0.1)
    modes = diagnosis.further_modes["x"]
    assert modes["share"] > 0.5
    left = (diagnosis.remainder or {}).get("share", 0.0)
    assert modes["share"] + sum(finding.share or 0.0 for finding in diagnosis.findings) + left < 1.02
    assert {round(f, 1) for f in modes["frequency"]} >= {3.4, 5.1, 9.0}
    errors = diagnosis.open_loop["sense_x"]
    assert errors["improved"]["rmse"] < 0.2 * errors["nominal"]["rmse"]
    assert "further modes of x at 3.4" in conclude_diagnosis(diagnosis.to_json())


def test_the_aircraft_has_six_further_modes(measured_data: Path) -> None:
    from benchmarks.measured import ROWS

    diagnosed, _, device = ROWS["f16"](measured_data)
    found = find_modes([prepare_run(part.slice(20.0, 60.0), device) for part in diagnosed], device.axes["x"])
    assert found is not None
    assert {3.4, 5.1, 6.4, 9.0} <= {round(f, 1) for f in found["frequency"]}  # type: ignore[union-attr]
    assert found["direct"] == pytest.approx(0.011, abs=0.003)


def test_a_mode_stays_an_oscillation_and_a_critically_damped_one_has_finite_heights() -> None:
    runs, nominal, _ = prepared({}, Acceleration(1.0, 1e-3))
    columns = _Columns([band for run in runs if (band := _band(run, nominal)) is not None])
    own = [nominal.resonance, nominal.quality]
    assert np.all(np.isfinite(_heights(columns, np.array([own, [12.0, 0.5]]))[0]))
    modes, residual = _fit(columns, np.array([own, [12.0, 0.6]]))
    assert np.all(modes[:, 1] >= 0.5)
    assert np.all(np.isfinite(residual))
