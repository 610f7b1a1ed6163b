"""Laws, integrator, parametric resonance and readout compared with analytic solutions."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.special import ive

from scanner import devices
from scanner.device import Axis
from scanner.drift import exponential
from scanner.harmonics import capacitance_harmonics, readout_response
from scanner.integrator.nodes import to_nodes
from scanner.integrator.trajectories import integrate
from scanner.laws import capacitance, capacitance_slope, electrostatic_torque
from scanner.lock_in import block_length, block_phasors, phasor_noise, unwrap_phase
from scanner.lowpass import apply_lowpass, lowpass_response, run_section, section_coefficients
from scanner.parametric import sine_drive, slow_flow, steady_state, stiffness_modulation, threshold, tongue_edges
from scanner.stages import Capacitance, Mechanics

COMB = Capacitance(C0=5.71e-12, Cb=9.79e-12, theta0=0.2, theta_th=0.01)
DRIVEN = devices.load("chen2020-driven").axis("x")
SWUNG = replace(DRIVEN, capacitance=Capacitance(C0=5.71e-12, Cb=0.0, theta0=0.2))


def run(theta, omega, step, steps, voltage=0.0, b=1e-40, stride=1, J=1e-15, k=9.6e-6, C0=0.0):
    axis = Axis(Mechanics(J, b, k), Capacitance(C0, 0.0, 0.2) if C0 else None)
    return tuple(v[::stride] for v in integrate(axis, (theta, omega), np.full((steps, 3), voltage), step))


@given(st.floats(-0.6, 0.6))
def test_slope_is_the_derivative_of_the_capacitance(theta: float) -> None:
    h = 1e-5
    args = (COMB.C0, COMB.theta0, COMB.theta_th)
    values = [capacitance(theta + d, COMB.C0, COMB.Cb, COMB.theta0, COMB.theta_th) for d in (-h, 0.0, h)]
    assert capacitance_slope(theta, *args) == pytest.approx(
        (values[2] - values[0]) / (2 * h), abs=1e-8 * COMB.C0 / 0.04
    )


def test_torque_acts_towards_the_largest_capacitance() -> None:
    for theta in (0.05, -0.05):
        slope = capacitance_slope(theta, COMB.C0, COMB.theta0, 0.0)
        assert np.sign(electrostatic_torque(slope, 60.0)) == -np.sign(theta)


def test_free_decay_equals_the_analytic_solution() -> None:
    J, k, b = 1e-15, 9.6e-6, 5.2e-13
    step, steps = 5e-8, 20_000
    angle, rate = run(0.1, 0.0, step, steps, b=b, J=J, k=k)
    t = step * np.arange(steps + 1)
    g, w = b / (2 * J), np.sqrt(k / J - (b / (2 * J)) ** 2)
    exact = 0.1 * np.exp(-g * t) * (np.cos(w * t) + g / w * np.sin(w * t))
    assert np.abs(angle - exact).max() < 1e-8
    assert np.abs(rate - np.gradient(exact, step))[1:-1].max() < 1e-3 * np.abs(rate).max()


def test_energy_error_is_of_fifth_order_in_the_step() -> None:
    """RK4 of a linear oscillator loses energy as (omega h)^6/72 a step, so (omega h)^5 over a fixed time."""
    J, k, span = 1e-15, 9.6e-6, 2e-3
    losses = []
    for step in (4e-7, 2e-7):
        angle, rate = run(0.1, 0.0, step, round(span / step), J=J, k=k)
        energy = 0.5 * J * rate**2 + 0.5 * k * angle**2
        losses.append(1 - energy[-1] / energy[0])
        assert losses[-1] == pytest.approx(span / step * (np.sqrt(k / J) * step) ** 6 / 72, rel=0.02)
    assert losses[0] / losses[1] == pytest.approx(32, rel=0.02)
    assert losses[1] < 1e-6  # at 5 MHz, ten thousand samples; the physical loss over the same time is 65 %


def test_integrator_is_of_fourth_order_on_the_driven_equation() -> None:
    def end(step: float) -> float:
        steps = round(1e-3 / step)
        t = 0.5 * step * np.arange(2 * steps + 1)
        v = 30 + 30 * np.sin(2 * np.pi * 31400 * t)
        angle, _ = integrate(SWUNG, (0.15, 0.0), to_nodes(v), step)
        return float(angle[-1])

    exact = end(2.5e-8)
    errors = [abs(end(step) - exact) for step in (8e-7, 4e-7, 2e-7)]
    assert errors[0] / errors[1] == pytest.approx(16, rel=0.15)
    assert errors[1] / errors[2] == pytest.approx(16, rel=0.15)


def test_bias_changes_the_stiffness_by_the_curvature_of_the_capacitance() -> None:
    m = DRIVEN.require_mechanics()
    step, steps = 5e-8, 40_000
    angle, _ = run(1e-3, 0.0, step, steps, voltage=40.0, J=m.J, k=m.k, C0=5.71e-12)
    _, z = block_phasors(angle, 1 / step, 0.0, m.resonance, 8000)
    f = m.resonance + np.diff(
        unwrap_phase(np.angle(z * np.exp(-2j * np.pi * m.resonance * 4e-4 * np.arange(z.size))))
    ).mean() / (2 * np.pi * 4e-4)
    stiff = m.k + 5.71e-12 / 0.2**2 * 40.0**2
    assert f == pytest.approx(np.sqrt(stiff / m.J) / (2 * np.pi), rel=2e-6)


@pytest.mark.parametrize("amplitude", [0.02, 0.1, 0.2, 0.4])
def test_harmonics_are_the_bessel_functions(amplitude: float) -> None:
    comb = Capacitance(C0=5.71e-12, Cb=9.79e-12, theta0=0.2)
    z = 0.5 * (amplitude / comb.theta0) ** 2
    got = capacitance_harmonics(amplitude, comb, 6)
    assert got[0] == pytest.approx(comb.C0 * ive(0, z) + comb.Cb, rel=1e-12)
    for n in (1, 2, 3):
        # C(A sin u): cos 2nu with sin^2 = (1 - cos 2u)/2
        assert got[2 * n] == pytest.approx(2 * comb.C0 * ive(n, z), rel=1e-9, abs=1e-25)
    assert np.abs(got[1::2]).max() < 1e-24


def test_threshold_and_tongue_agree_with_the_full_equation() -> None:
    """Rest is unstable inside the tongue's edges and stable outside, found by integrating from a tiny angle."""
    drive = lambda f: sine_drive(f, 30.0, 30.0)  # noqa: E731
    edges = tongue_edges(DRIVEN, drive(31400.0))
    assert edges is not None

    def growth(f: float) -> float:
        step, steps = 2e-7, 100_000
        t = 0.5 * step * np.arange(2 * steps + 1)
        v = 30 + 30 * np.sin(2 * np.pi * f * t)
        angle, _ = integrate(SWUNG, (1e-6, 0.0), to_nodes(v), step)
        return np.log(np.abs(angle[-5000:]).max() / np.abs(angle[45_000:50_000]).max())

    width = edges[1] - edges[0]
    for edge, inwards in zip(edges, (1, -1), strict=True):
        assert growth(edge + inwards * 0.08 * width) > 0
        assert growth(edge - inwards * 0.08 * width) < 0


def test_published_table_two_is_below_the_threshold() -> None:
    printed = devices.load("chen2020").axis("x")
    drive = sine_drive(31200.0, 30.0, 30.0)
    assert stiffness_modulation(printed, drive) == pytest.approx(0.0023, abs=1e-4)
    assert threshold(printed) == pytest.approx(0.0106, abs=1e-4)
    assert tongue_edges(printed, drive) is None
    assert stiffness_modulation(DRIVEN, drive) > threshold(DRIVEN)


def test_slow_flow_gives_the_steady_state_of_the_full_equation() -> None:
    drive = sine_drive(31400.0, 30.0, 30.0)
    state = steady_state(DRIVEN, drive)
    assert state is not None
    amplitude, phase = state
    assert np.abs(slow_flow(DRIVEN, drive, amplitude, phase)).max() < 1e-3
    step, steps = 1e-7, 250_000
    t = 0.5 * step * np.arange(2 * steps + 1)
    v = 30 + 30 * np.sin(2 * np.pi * 31400.0 * t)
    angle, _ = integrate(SWUNG, (amplitude, 0.0), to_nodes(v), step)
    tc, z = block_phasors(angle[-20_000:], 1 / step, (steps - 19_999) * step, 15700.0, 10_000)
    fitted = np.angle(z[-1] * np.exp(-2j * np.pi * 15700.0 * tc[-1]))
    assert np.abs(z[-1]) == pytest.approx(amplitude, rel=2e-3)
    assert abs((fitted - phase + np.pi / 2) % np.pi - np.pi / 2) < np.radians(0.3)


def test_step_of_a_section_agrees_with_its_response() -> None:
    rate, f = 5e6, 31_000.0
    t = np.arange(20_000) / rate
    signal = np.cos(2 * np.pi * f * t)
    for cutoff in (40_800.0, 41_100.0):
        run_section(signal, *section_coefficients(cutoff, 1 / rate), 0.0, 1.0)
    _, z = block_phasors(signal[-5000:], rate, t[-5000], f, 5000)
    tc = t[-5000] + 2499.5 / rate
    got = z[0] * np.exp(-2j * np.pi * f * tc) * -1j  # values = Im(Z e^..); Re form needs -i
    assert np.abs(got - lowpass_response(f, (40_800.0, 41_100.0))) < 2e-4  # linear between samples: (pi f/rate)^2 / 3
    slope = np.diff(np.angle(lowpass_response(np.array([31_000.0, 31_001.0]), (40_800.0, 41_100.0))))
    assert np.degrees(slope[0]) == pytest.approx(-0.0018, abs=1e-4)  # SEEDS.md section 3


def test_section_is_accurate_at_twenty_samples_a_cycle() -> None:
    rate, cutoff = 1.25e6, 40_800.0
    f = rate / 20
    t = np.arange(4000) / rate
    shown = apply_lowpass(np.sin(2 * np.pi * f * t), cutoff, 1 / rate)[2000:-1]
    exact = np.imag(lowpass_response(f, [cutoff]) * np.exp(2j * np.pi * f * t[2000:-1]))
    # A step that is exact for an input linear in between is off by (2 pi / 20)^2 / 12 = 8e-3 of it.
    assert np.abs(shown - exact).max() < 2e-4 * abs(lowpass_response(f, [cutoff]))


def test_transimpedance_response_is_a_derivative() -> None:
    readout = devices.load("chen2019").axis("x").require_readout()
    assert complex(readout_response(readout, 1000.0)) == pytest.approx(-1e7 * 10 * 2j * np.pi * 1000)


@given(st.floats(0.01, 10.0), st.floats(-np.pi, np.pi), st.floats(-1.0, 1.0), st.integers(40, 400))
def test_block_phasors_are_exact_for_a_sine(amplitude: float, phase: float, offset: float, block: int) -> None:
    rate, f = 1000.0, 37.3
    t = 2.0 + np.arange(3 * block) / rate
    tc, z = block_phasors(offset + amplitude * np.sin(2 * np.pi * f * t + phase), rate, 2.0, f, block)
    assert np.allclose(np.abs(z), amplitude, rtol=1e-6, atol=1e-7 * (1 + abs(offset)))
    turned = z * np.exp(-1j * (2 * np.pi * f * tc + phase))
    assert np.abs(np.angle(turned)).max() < 1e-5 * (1 + abs(offset) / amplitude)


@pytest.mark.parametrize("cycles", [0.75, 1.0, 4.0])
def test_the_noise_of_block_phasors_is_stated(cycles: float) -> None:
    block, blocks = 80, 4000
    noise = np.random.default_rng(3).normal(size=block * blocks)
    _, z = block_phasors(noise, 1000.0, 0.0, 1000.0 * cycles / block, block)
    assert phasor_noise(1000.0, 1000.0 * cycles / block, block) == pytest.approx(
        max(z.real.std(), z.imag.std()), rel=0.05
    )


def test_unwrapping_follows_a_changing_frequency() -> None:
    phase = 0.4 * np.arange(60.0) ** 2 / 10
    assert np.allclose(unwrap_phase(np.angle(np.exp(1j * phase))), phase)
    assert block_length(100.0, 1000.0, 4) == 40


def test_drift_starts_at_the_start_of_the_recording() -> None:
    factor = exponential(-0.002, 0.025)
    assert factor(np.array([-1.0, 0.0])).tolist() == [1.0, 1.0]
    assert factor(np.array([0.025]))[0] == pytest.approx(1 - 0.002 * (1 - np.exp(-1)))


@pytest.mark.parametrize("cutoff", [100.0, 3e3, 2e4, 1e5, 1e6, 1e8])
def test_a_section_answers_a_tone_exactly_whatever_its_cutoff(cutoff: float) -> None:
    rate, f = 1e5, 2000.0
    time = np.arange(4000) / rate
    tone = np.exp(2j * np.pi * f * time)
    shown = apply_lowpass(tone.real, cutoff, 1 / rate)[3000:-1]
    wanted = (lowpass_response(f, [cutoff]) * tone).real[3000:-1]
    transient = np.exp(-2 * np.pi * cutoff * 0.03)
    # relative to what the section changes, so that a corner far above the tone is tested too
    assert np.std(shown - wanted) < (5e-3 + transient) * np.std(tone.real[3000:-1] - wanted)
