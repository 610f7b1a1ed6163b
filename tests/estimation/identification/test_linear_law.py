"""Identification of a device whose law is not linear: intervals contain the constants of small motion, with a note."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from benchmarks.identify_references import lock_in
from benchmarks.measured import ROWS
from benchmarks.papers.sine import linear_axis
from estimation.identification.agreement import (
    Differences,
    Found,
    IdentifiedValue,
    combine_values,
    contradiction_notes,
    difference_by_extra_columns,
    widen,
)
from estimation.identification.calibrate import Identification, identify
from phantoms.forward import InitialState, Plan, settled_state, simulate
from phantoms.waveforms import Constant, Sine, Sweep
from recon.cli import main
from scanner.device import Axis, Device
from scanner.recording import Recording
from scanner.stages import Position

RATE, LARGEST = 1e5, 0.05
PULL = 0.005
"""Change of k by the spring at the largest amplitude: a fourth of the line width at Q 50."""


def resonator(quality: float, hardening: float) -> Axis:
    """A resonator at 1 kHz whose effective stiffness at the amplitude ``LARGEST`` is higher by ``hardening``."""
    axis = replace(linear_axis(1000.0, quality), readout=Position(10.0, 2e-3))
    k3 = hardening * axis.require_mechanics().k / (0.75 * LARGEST**2)
    return replace(axis, terms={"cubic-stiffness": {"k3": k3}}) if hardening else axis


def volts(axis: Axis) -> float:
    """Drive voltage that moves a linear resonator by ``LARGEST`` at its resonance."""
    m, drive = axis.require_mechanics(), axis.require_drive()
    return LARGEST * m.b * m.resonance * 2 * np.pi / float(drive.torque_per_volt or 0.0)


def recorded(kind: str, axis: Axis, seed: int) -> list[Recording]:
    """Recordings of one kind, from a sensor with a gain of 10 V/rad and noise of 2 mV."""
    device = Device("d", {"x": axis})
    if kind == "tones":
        found = []
        for f in (990.0, 995.0, 1002.0, 1010.0):
            plan = Plan({"x": Sine(f, volts(axis))}, 0.2, RATE, settle=0.2)
            start = {"x": settled_state(axis, plan)}
            full, _ = simulate(device, plan, start=start, seed=seed + int(f))
            found.append(_as_angle(full, driven=True))
        return found
    if kind == "sweep":
        plan = Plan({"x": Sweep(960.0, 1040.0, 0.4, volts(axis))}, 0.4, RATE)
        return [_as_angle(simulate(device, plan, seed=seed)[0], driven=True)]
    plan = Plan({"x": Constant(0.0)}, 0.05, RATE)
    full, _ = simulate(device, plan, start={"x": InitialState(LARGEST, 0.0)}, seed=seed)
    if kind == "decay with angle":
        return [_as_angle(full, driven=False)]
    if kind == "decay":
        return [Recording.from_arrays({"sense_x": (full["sense_x"].read(), "V", RATE)})]
    angle, time = full["sense_x"].read() / 10.0, np.arange(full["sense_x"].size) / RATE
    mixed = 2j * angle * np.exp(-2j * np.pi * 1000.0 * time)
    return [Recording.from_arrays(lock_in(mixed.reshape(-1, 2).mean(axis=1), None))]  # at its rate of 50 kS/s


def _as_angle(full: Recording, driven: bool) -> Recording:
    channels = {"angle_x": (full["sense_x"].read() / 10.0, "rad", RATE)}
    if driven:
        channels["drive_x"] = (full["drive_x"].read(), "V", RATE)
    return Recording.from_arrays(channels)


def identified(kind: str, hardening: float, seed: int = 1) -> Identification:
    nominal = Device("d", {"x": resonator(40.0, 0.0)})
    return identify(recorded(kind, resonator(50.0, hardening), seed), nominal)


def holds_the_truth(found: Identification) -> bool:
    m = resonator(50.0, 0.0).require_mechanics()
    truth = {"k_over_J": m.k / m.J, "b_over_J": m.b / m.J}
    values = found.values["x"]
    return all(values[key].ci95[0] < value < values[key].ci95[1] for key, value in truth.items())


def linear_law_notes(found: Identification) -> int:
    return sum("the law of the device is not linear" in note for note in found.notes)


KINDS = ["decay", "decay with angle", "decay of a lock-in amplifier", "sweep", "tones"]


@pytest.mark.parametrize("kind", KINDS)
def test_a_stiffening_spring_widens_the_intervals_with_one_note(kind: str) -> None:
    found = identified(kind, PULL)
    assert linear_law_notes(found) == 1
    assert found.nonlinear == ["x"]
    assert holds_the_truth(found)


@pytest.mark.parametrize("kind", KINDS)
def test_a_linear_resonator_has_narrow_intervals_and_no_note(kind: str) -> None:
    found = identified(kind, 0.0)
    assert linear_law_notes(found) == 0
    assert not found.nonlinear
    values = found.values["x"]
    m = resonator(50.0, 0.0).require_mechanics()
    assert values["k_over_J"].value == pytest.approx(m.k / m.J, abs=4.0 * values["k_over_J"].sd)
    assert values["k_over_J"].sd < 0.02 * PULL * values["k_over_J"].value


def test_a_spring_that_halves_the_fitted_inertia_leaves_it_in_its_interval() -> None:
    """The spring changes the stiffness by three line widths."""
    found, J = identified("sweep", 0.06), resonator(50.0, 0.0).require_mechanics().J
    assert linear_law_notes(found) == 1
    assert found.values["x"]["J"].ci95[0] < J < found.values["x"]["J"].ci95[1]
    assert holds_the_truth(found)


def test_a_wide_sweep_of_a_low_q_is_exact() -> None:
    """The drive's frequency falls by a factor of four. Before, k/J was 13 % off with an interval of 2 %."""
    axis = resonator(5.0, 0.0)
    plan = Plan({"x": Sweep(1600.0, 400.0, 0.2, volts(axis))}, 0.2, RATE)
    full, _ = simulate(Device("d", {"x": axis}), plan, seed=3)
    found, m = identify([_as_angle(full, driven=True)], Device("d", {"x": axis})), axis.require_mechanics()
    for key, value in (("k_over_J", m.k / m.J), ("b_over_J", m.b / m.J)):
        assert found.values["x"][key].value == pytest.approx(value, rel=5e-3)
    assert not found.nonlinear


def test_the_conclusion_names_the_axis_whose_law_is_not_linear(tmp_path: Path) -> None:
    for hardening in (0.0, PULL):
        channels = recorded("decay", resonator(50.0, hardening), 1)[0]
        path, out = tmp_path / f"{hardening}.h5", tmp_path / f"out{hardening}"
        device = Device("d", {"x": resonator(40.0, 0.0)})
        Recording.from_arrays({"sense_x": (channels["sense_x"].read(), "V", RATE)}, device).write(path)
        assert main(["identify", str(path), "-o", str(out)]) == 0
        summary = json.loads((out / "summary.json").read_text(encoding="utf-8"))
        assert summary["nonlinear"] == (["x"] if hardening else [])
        assert ("law of x is not linear" in summary["conclusion"]) == bool(hardening)
        assert ("Use device.toml" in summary["conclusion"]) != bool(hardening)


def test_an_interval_is_widened_by_what_noise_does_not_explain() -> None:
    value = IdentifiedValue(10.0, 0.1)

    def widened(difference: float, sd: float) -> IdentifiedValue:
        return widen([value], Differences(np.array([difference]), np.array([sd])))[0]

    assert widened(0.3, 0.2) == replace(value, conflict=pytest.approx(1.5))
    assert widened(0.0, 0.0) == value
    wide = widened(-4.0, 0.2)
    assert wide.conflict == pytest.approx(20.0)
    assert wide.ci95[0] < 6.0
    assert combine_values([{"k": wide}, {"k": value}])["k"].conflict == wide.conflict


def test_values_of_recordings_that_contradict_each_other_have_an_interval_that_contains_them() -> None:
    first, second = IdentifiedValue(1.0, 1e-6), IdentifiedValue(1.002, 1e-8)
    mean = combine_values([{"k": first}, {"k": second}])["k"]
    assert mean.ci95[0] < first.value < second.value < mean.ci95[1]
    assert mean.sd == pytest.approx(0.001, rel=1e-3)
    found = [Found("a", {"k_over_J": first}), Found("b", {"k_over_J": first}), Found("c", {"k_over_J": second})]
    (note,) = contradiction_notes(found)
    assert "k/J by 2e+03 standard deviations (+0.20%) between a and c" in note
    assert not contradiction_notes(found[:2])
    agreeing = combine_values([{"k": first}, {"k": replace(first, value=1.0 + 1e-6)}])["k"]
    assert agreeing.sd == pytest.approx(first.sd / np.sqrt(2.0))


@pytest.mark.parametrize("kinds", [("angle", "angle"), ("sense", "sense"), ("angle", "sense")])
@pytest.mark.parametrize("detuning", [0.0, 1e-3])
def test_free_decays_that_contradict_each_other_are_named(kinds: tuple[str, str], detuning: float) -> None:
    """They were averaged to an interval that contains neither of them, without a note."""
    rng, time, axis = np.random.default_rng(0), np.arange(8000) / RATE, resonator(40.0, 0.0)
    w, recordings = axis.resonance * 2 * np.pi, []
    for kind, name, factor in zip(kinds, ("cold", "warm"), (1.0, 1.0 + detuning), strict=True):
        values = np.exp(-0.5 * w / 40.0 * time) * np.sin(w * factor * time) + 1e-4 * rng.standard_normal(time.size)
        scale, unit = (0.1, "rad") if kind == "angle" else (1.0, "V")
        recordings.append(Recording.from_arrays({f"{kind}_x": (scale * values, unit, RATE)}, name=name))
    device = Device("d", {"x": axis})
    found = identify(recordings, device)
    notes = [note for note in found.notes if "contradict each other" in note]
    alone = [identify([each], device).values["x"]["k_over_J"] for each in recordings]
    value = found.values["x"]["k_over_J"]
    if not detuning:
        assert not notes
        assert 0.65 < value.sd / alone[0].sd < 1.5
        return
    (note,) = notes
    assert note.startswith("x: recordings contradict each other in k/J by ")
    assert {"cold", "warm"} <= set(re.findall(r"\w+", note))
    assert value.sd == pytest.approx(0.5 * abs(alone[0].value - alone[1].value), rel=0.05)
    assert found.device.axis("x").tolerance["k"] == pytest.approx(1e-3, rel=0.1)


def test_the_change_by_further_columns_has_its_stated_deviation() -> None:
    """Of white noise: unit variance of difference over standard deviation. Dependent columns determine nothing."""
    rng = np.random.default_rng(0)
    columns, extra = rng.standard_normal((200, 3)), rng.standard_normal((200, 2))
    extra += columns[:, :2]
    ratios = []
    for _ in range(400):
        noise = rng.standard_normal(200)
        residual = noise - columns @ np.linalg.lstsq(columns, noise, rcond=None)[0]
        found = difference_by_extra_columns(columns, extra, residual)
        ratios.append(found.difference / found.sd)
    assert np.std(ratios) == pytest.approx(1.0, abs=0.08)
    undetermined = difference_by_extra_columns(columns, columns[:, :1], residual)
    assert isinstance(undetermined, Differences)
    assert not undetermined.conflict.any()
    assert not undetermined.excess.any()


@pytest.mark.parametrize("row", ["silverbox", "pendulum-45", "membrane-3716", "membrane-505"])
def test_measured_devices_contradict_the_linear_law(row: str, measured_data: Path) -> None:
    """A circuit with a cubic spring, a pendulum, and membranes with a damping that depends on the amplitude."""
    recordings, _, device = ROWS[row](measured_data)
    found = identify(recordings, device)
    assert found.nonlinear == ["x"]
    assert any("is not linear" in note for note in found.notes)
