"""Drive voltages: formulas, continuity of the phase, switching times."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from phantoms.waveforms import Constant, Multisine, Sequence, Sine, Square, Sweep
from scanner.errors import BadInput

T = np.linspace(-0.01, 0.05, 4001)
EVERY = [
    Constant(3.0),
    Sine(700.0, 2.0, 1.0, 0.4),
    Sweep(900.0, 600.0, 0.02, 2.0, 1.0),
    Square(300.0, 60.0, 5.0, 0.3, 0.2),
    Multisine((100.0, 230.0), (1.0, 0.5), (0.0, 1.0), 0.1),
    Sequence([(Square(300.0, 60.0), 0.01), (Constant(10.0), 0.02)]),
]


@pytest.mark.parametrize("waveform", EVERY, ids=lambda waveform: type(waveform).__name__)
def test_voltage_does_not_depend_on_the_shape_of_the_times(waveform):
    together = waveform(T)
    assert together.dtype == np.float64
    np.testing.assert_array_equal(waveform(T[:4000].reshape(40, 100)), together[:4000].reshape(40, 100))
    assert waveform(T[1234]).shape == ()
    assert waveform(T[1234]) == together[1234]


def test_sine_agrees_with_its_formula():
    drive = Sine(31.11e3, 30.0, 30.0, 0.3)
    np.testing.assert_allclose(drive(T), 30 + 30 * np.sin(2 * np.pi * 31.11e3 * T + 0.3), atol=1e-9)
    assert drive(T).min() >= 0
    assert drive(T).max() <= 60


@given(f0=st.floats(100, 5000), f1=st.floats(100, 5000), duration=st.floats(1e-3, 1.0))
def test_frequency_of_a_sweep_is_linear_in_time(f0, f1, duration):
    sweep = Sweep(f0, f1, duration, 1.0)
    t, dt = np.linspace(-0.5, 1.5, 41) * duration, 1e-4 * duration
    t = t[(np.abs(t) > dt) & (np.abs(t - duration) > dt)]  # the chirp rate jumps there
    frequency = (sweep.angle(t + dt) - sweep.angle(t - dt)) / (4 * np.pi * dt)
    np.testing.assert_allclose(frequency, np.interp(t, [0, duration], [f0, f1]), rtol=1e-6)
    for joint in (0.0, duration):
        assert sweep.angle(joint + 1e-12) == pytest.approx(sweep.angle(joint - 1e-12), abs=1e-6)


@given(
    frequency=st.floats(1.0, 1e5),
    duty=st.floats(0.05, 0.95),
    phase=st.floats(-10, 10),
    t0=st.floats(-1, 1),
    turns=st.floats(0.3, 20),
)
def test_square_wave_switches_at_its_switching_times_only(frequency, duty, phase, t0, turns):
    square = Square(frequency, 60.0, -1.0, duty, phase)
    t1 = t0 + turns / frequency
    edges = square.switching_times(t0, t1)
    assert np.all((edges > t0) & (edges < t1))
    assert np.all(np.diff(edges) > 0)
    assert abs(len(edges) - 2 * turns) <= 2
    near = 1e-6 / frequency
    inner = edges[(edges > t0 + 3 * near) & (edges < t1 - 3 * near)]
    jump = square(inner + near) - square(inner - near)
    np.testing.assert_array_equal(np.abs(jump), 61.0)
    bounds = np.concatenate([[t0], edges, [t1]])
    gaps = np.flatnonzero(np.diff(bounds) > 4 * near)
    for a, b in zip(bounds[gaps], bounds[gaps + 1], strict=True):
        assert np.ptp(square(np.linspace(a + near, b - near, 50))) == 0


def test_square_wave_starts_high_and_has_its_duty_cycle():
    square = Square(100.0, 60.0, 0.0, 0.3)
    assert square(np.arange(10_000) * 1e-6 + 0.5e-6).mean() == pytest.approx(18.0, abs=1e-9)
    assert square(0.0) == 60.0
    np.testing.assert_allclose(square.switching_times(0.0, 0.02), [0.003, 0.01, 0.013], rtol=1e-12)


def test_spectrum_of_a_multisine_has_its_lines_only():
    frequencies, amplitudes, phases = (40.0, 100.0, 370.0), (1.0, 2.0, 0.5), (0.0, 1.0, -2.0)
    t = np.arange(1000) / 1000
    spectrum = np.fft.rfft(Multisine(frequencies, amplitudes, phases, 0.25)(t)) / 500
    assert spectrum[0].real / 2 == pytest.approx(0.25)
    for frequency, amplitude, phase in zip(frequencies, amplitudes, phases, strict=True):
        assert spectrum[int(frequency)] == pytest.approx(amplitude * np.exp(1j * (phase - np.pi / 2)))
    spectrum[[0, 40, 100, 370]] = 0
    assert np.abs(spectrum).max() < 1e-12


def test_phase_is_continuous_at_steps_in_frequency():
    sweep = Sweep(1300.0, 900.0, 0.01, 1.0)
    steps = Sequence([(Sine(1000.0, 1.0), 0.01037), (Sine(1300.0, 1.0), 0.005), (sweep, 0.02)])
    for joint in (0.01037, 0.01537):
        before, after = steps(joint + np.array([-1e-9, 1e-9]))
        assert after == pytest.approx(before, abs=2e-5)  # a jump would be of order 1; the slope gives 2e-5
    lone = Sine(1300.0, 1.0, phase=2 * np.pi * 1000.0 * 0.01037)
    t = np.linspace(0.0104, 0.0153, 50)
    np.testing.assert_allclose(steps(t), lone(t - 0.01037), atol=1e-9)


def test_parts_of_equal_frequency_join_without_a_step_and_a_phase_is_a_step():
    joined = Sequence([(Sine(1000.0, 1.0, 0.2), 0.0123), (Sine(1000.0, 1.0, 0.2), 0.01)])
    np.testing.assert_allclose(joined(T), Sine(1000.0, 1.0, 0.2)(T), atol=1e-9)
    stepped = Sequence([(Sine(1000.0, 1.0), 0.0123), (Sine(1000.0, 1.0, phase=0.5), 0.01)])
    late = T[T > 0.0123]
    np.testing.assert_allclose(stepped(late), Sine(1000.0, 1.0, phase=0.5)(late), atol=1e-9)


def test_bias_starts_at_the_sample_at_which_the_drive_is_switched_off():
    ringdown = Sequence([(Sine(31.1e3, 30.0, 30.0), 0.02), (Constant(23.76), 0.08)])
    assert ringdown(0.02) == 23.76
    np.testing.assert_array_equal(ringdown(np.array([0.03, 0.5])), 23.76)
    np.testing.assert_array_equal(ringdown([-1e-3, 0.0199]), Sine(31.1e3, 30.0, 30.0)([-1e-3, 0.0199]))
    np.testing.assert_array_equal(ringdown.switching_times(-1.0, 1.0), [0.02])


def test_phase_starts_anew_after_a_pause():
    resumed = Sequence([(Sine(1000.0, 1.0), 0.0123), (Constant(), 0.01), (Sine(1000.0, 1.0), 0.01)])
    assert resumed(0.0223) == pytest.approx(0.0, abs=1e-9)


def test_switching_times_of_a_sequence_include_those_of_its_parts():
    square = Square(100.0, 1.0)
    sequence = Sequence([(square, 0.012), (Constant(0.5), 0.01), (square, 0.012)])
    expected = [0.005, 0.01, 0.012, 0.022, 0.027, 0.032, 0.037]
    np.testing.assert_allclose(sequence.switching_times(0.0, 0.04), expected, atol=1e-12)
    np.testing.assert_allclose(sequence.switching_times(0.006, 0.023), [0.01, 0.012, 0.022], atol=1e-12)
    np.testing.assert_allclose(sequence.switching_times(-0.008, 0.001), [-0.005, 0.0], atol=1e-12)


def test_sequences_can_be_nested():
    inner = Sequence([(Constant(1.0), 0.01), (Constant(2.0), 0.01)])
    outer = Sequence([(inner, 0.02), (Constant(3.0), 0.01)])
    np.testing.assert_array_equal(outer([0.005, 0.015, 0.025]), [1, 2, 3])
    np.testing.assert_allclose(outer.switching_times(0, 1), [0.01, 0.02])


@pytest.mark.parametrize(
    "make",
    [
        lambda: Sweep(1.0, 2.0, 0.0, 1.0),
        lambda: Square(0.0, 1.0),
        lambda: Square(10.0, 1.0, duty=1.0),
        lambda: Multisine((1.0, 2.0), (1.0,), (0.0, 0.0)),
        lambda: Sequence([]),
        lambda: Sequence([(Constant(1.0), -0.1)]),
    ],
)
def test_invalid_waveform_is_refused_with_a_hint(make):
    with pytest.raises(BadInput) as caught:
        make()
    assert "; give" in str(caught.value)
