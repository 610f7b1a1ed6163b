"""The capacitance over the angle, the readout's constants and the delay: no bias, and intervals with their coverage."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.papers.threshold import sensing_axis
from estimation.identification.capacitance_profile import fit_capacitance_profile
from scanner.devices import load
from scanner.laws import capacitance, capacitance_slope
from scanner.lowpass import apply_lowpass
from scanner.stages import Amdm, Transimpedance
from tests.support.identified import coverage, decay_under_bias

AXIS = load("chen2020-driven").axis("x")
ANGLE_NOISE_RAD = 2e-4


def test_the_capacitance_profile_and_the_channel_delay_are_fitted() -> None:
    decay = decay_under_bias()
    axis = sensing_axis()
    comb = axis.require_capacitance()
    off = replace(axis, capacitance=replace(comb, C0=1.1 * comb.C0, theta0=0.9 * comb.theta0, theta_th=0.0))
    draws = []
    for seed in range(16):
        rng = np.random.default_rng(seed)
        # the angle channel is 0.114 ms early
        angle = decay[0][57:] + ANGLE_NOISE_RAD * rng.standard_normal(decay[0].size - 57)
        sense = decay[1][:-57] + 0.0435 * rng.standard_normal(decay[1].size - 57)
        draws.append(fit_capacitance_profile(off, angle, sense, 500e3, axis.resonance).values)
    truth = {"theta0": comb.theta0, "theta_th": comb.theta_th, "C0": comb.C0, "delay": 57 / 500e3}
    for key, value in truth.items():
        assert np.mean([d[key].value for d in draws]) == pytest.approx(value, rel=0.01)
    assert min(coverage(draws, truth).values()) >= 0.8


@pytest.mark.parametrize("kind", ["amdm", "transimpedance"])
def test_the_profile_has_no_bias_at_few_samples_and_with_a_noisy_angle(kind: str) -> None:
    """40 samples a period; behind AMDM little noise, behind a transimpedance readout 1 % of the amplitude in the angle.

    Sections stepped at the samples made theta0 1.1 % too large (15 standard deviations). The noise of the angle moved
    the delay by 1.4e-3 of a period (15 standard deviations) and made C0 1.2 % too small.
    """
    axis = AXIS if kind == "amdm" else sensing_axis()
    comb, readout, angle_noise, sense_noise = axis.require_capacitance(), axis.require_readout(), 0.001, 0.001
    if kind == "transimpedance":
        angle_noise, sense_noise = 0.01, 0.01
    f, finer = axis.resonance, 40
    time = np.arange(300 * 40 * finer) / (f * 40 * finer)
    rate, phasor = np.pi * f * (2j - 1 / 300), -0.8j * comb.theta0 * np.exp(0.3j)
    angle, omega = (phasor * np.exp(rate * time)).real, (rate * phasor * np.exp(rate * time)).real
    if isinstance(readout, Amdm):
        sense = capacitance(angle, comb.C0, comb.Cb, comb.theta0, comb.theta_th)
        for cutoff in readout.lpf_hz:
            sense = apply_lowpass(sense, cutoff, time[1])
        sense = readout.a_cir * sense + readout.b_cir
        truth = {"a_cir": readout.a_cir, "b_cir": readout.b_cir}
    else:
        assert isinstance(readout, Transimpedance)
        sense = -readout.R_s * readout.V_bias * capacitance_slope(angle, comb.C0, comb.theta0, comb.theta_th) * omega
        truth = {"C0": comb.C0}
    truth |= {"theta0": comb.theta0, "theta_th": comb.theta_th, "delay": 0.0}
    angle, sense = angle[::finer], sense[::finer]
    draws = []
    for seed in range(24):
        rng = np.random.default_rng(71000 + seed)
        noisy = angle + angle_noise * 0.8 * comb.theta0 * rng.standard_normal(angle.size)
        signal = sense + sense_noise * np.ptp(sense) * rng.standard_normal(sense.size)
        draws.append(fit_capacitance_profile(axis, noisy, signal, f * 40, f).values)
    assert min(coverage(draws, truth).values()) >= 0.8
    for key, value in truth.items():
        assert abs(np.mean([d[key].value for d in draws]) - value) < np.mean([d[key].sd for d in draws])
