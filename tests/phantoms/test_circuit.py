"""The AMDM circuit: its spectrum compared with chen2020, and its reduction to a linear readout."""

from __future__ import annotations

import ast
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from benchmarks.papers.circuit import CLOCK, F_DR, bench, lines, phase_between
from phantoms.amdm import record_through_circuit
from phantoms.circuit import AmdmCircuit, envelope_section, linear_gain, match_gain, reduce_to_readout, run_circuit
from phantoms.waveforms import Sine
from scanner.devices import load
from scanner.errors import BadInput
from scanner.lowpass import lowpass_response

AXIS = load("chen2020-driven").axis("x")
COMB = AXIS.require_capacitance()
ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def moving():
    return bench()


@pytest.fixture(scope="module")
def still():
    return bench(moving=False)


def test_each_component_is_in_its_band_of_the_paper(moving):
    strong = [set(lines(part, 0.1)) for part in moving.parts]
    low, side = {(0, 0), (0, 1), (0, 2)}, {(1, -1), (1, 1)}
    assert strong[0] <= low | {(0, 3)}  # a Gaussian's fourth harmonic, which the paper's parabola has not
    assert {(0, 1), (0, 2)} <= strong[0]
    assert side <= strong[1] <= side | {(1, -2), (1, 2)}
    assert strong[2] == {(0, 1)}
    assert set(lines(moving.parts[3], 0.02)) == side | {(1, 0)}
    assert strong[4] == {(0, 1)}
    assert strong[5] == {(1, 0)}


def test_no_line_is_outside_the_bands(moving):
    for voltage in (*moving.parts, moving.stages.v_o1, moving.stages.v_o2, moving.stages.v_o3, moving.stages.y):
        assert all(m >= 0 for m, _ in lines(voltage, 1e-6))


def test_sidebands_need_motion(still, moving):
    at_rest, in_motion = lines(still.stages.v_o1, 1e-6), lines(moving.stages.v_o1, 1e-6)
    assert in_motion[1, 1] > 0.05 * in_motion[1, 0]
    assert at_rest.get((1, 1), 0.0) < 1e-5 * at_rest[1, 0]


def test_lowpass_behind_the_detector_passes_the_drive_frequency_only(moving):
    detector = set(lines(moving.stages.v_o3, 0.01))
    assert {(0, 0), (0, 1), (0, 2), (1, 0), (2, 0), (2, 1), (2, -1)} <= detector
    output = lines(moving.stages.y, 1e-5)
    low = max(v for (m, _), v in output.items() if m > 0)
    assert output[0, 1] > 50 * low


def test_output_is_proportional_to_the_squared_capacitance(moving):
    """The lines of y are those of K (C + C_p)^2 behind the sections. Lines of the drive that leak are excluded."""
    circuit = moving.circuit
    square = circuit.gain * circuit.square_gain * (moving.capacitance + circuit.C_p) ** 2
    expected, measured = lines(square, 1e-9), lines(moving.stages.y, 1e-9)
    for k in (1, 2):
        gain = abs(lowpass_response(k * F_DR, (*circuit.lpf_hz, envelope_section(circuit))))
        assert measured[0, k] == pytest.approx(expected[0, k] * gain, rel=0.01)
    assert moving.stages.y.mean() == pytest.approx(square.mean() + circuit.offset, abs=0.01)


def test_high_pass_delays_the_envelope_like_one_more_section(moving):
    quiet = bench(circuit=replace(moving.circuit, a_d=0.0))
    phase = phase_between(quiet.stages.y, quiet.capacitance, F_DR)
    sections = quiet.circuit.lpf_hz
    without, with_it = (
        np.angle(lowpass_response(F_DR, s)) for s in (sections, (*sections, envelope_section(quiet.circuit)))
    )
    assert abs(np.rad2deg(phase - with_it)) < 0.3
    assert abs(np.rad2deg(phase - without)) > 1.5


def test_matched_circuit_has_the_requested_gain_and_offset():
    circuit = match_gain(AmdmCircuit(), COMB, 0.15, -3.574e11, 6.3945)
    readout = reduce_to_readout(circuit, COMB, 0.15, 1.92e-4, 12)
    assert readout.a_cir == pytest.approx(-3.574e11)
    assert readout.b_cir == pytest.approx(6.3945)
    assert abs(linear_gain(circuit, COMB, 0.09)[0]) > abs(readout.a_cir) > abs(linear_gain(circuit, COMB, 0.21)[0])


def test_output_does_not_depend_on_the_clock():
    outputs = []
    for clock in (CLOCK, 4 * CLOCK):
        time = np.arange(round(1e-3 * clock)) / clock
        turn = np.pi * F_DR * time
        angle, rate = 0.2 * np.sin(turn), 0.2 * np.pi * F_DR * np.cos(turn)
        stages = run_circuit(AmdmCircuit(), COMB, angle, rate, Sine(F_DR, 30.0, 30.0)(time), clock)
        outputs.append(stages.y[:: round(clock / 5e6)][2000:])
    coarse, fine = outputs
    assert np.abs(coarse - fine).max() < 2e-3 * np.ptp(fine)


def test_clock_below_the_carrier_is_refused():
    with pytest.raises(BadInput, match="5e\\+06 Hz"):
        run_circuit(AmdmCircuit(), COMB, np.zeros(9), np.zeros(9), np.zeros(9), 5e6)


def test_recording_through_the_circuit_has_the_true_trajectory():
    circuit = match_gain(AmdmCircuit(), COMB, 0.15, -3.574e11, 6.3945)
    sense, angle, drive = record_through_circuit(AXIS, circuit, Sine(31500.0, 30.0, 30.0), 0.002, settle=0.03)
    assert sense.shape == angle.shape == drive.shape == (10000,)
    assert drive[0] == pytest.approx(30.0, abs=1e-9)
    assert 0.13 < np.abs(angle).max() < 0.16
    assert 0.5 < np.ptp(sense) < 2.0


def test_simulator_imports_no_estimator():
    """Estimators that share code with the simulator would fit its errors too (inverse crime)."""
    for path in (ROOT / "phantoms").glob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            names = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
            names += [node.module or ""] if isinstance(node, ast.ImportFrom) else []
            assert not any(name.split(".")[0] in ("estimation", "recon") for name in names), path
