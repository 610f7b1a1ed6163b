"""The blind generator's unlisted imperfections, kinds of noise and families, against closed forms."""

from __future__ import annotations

import json
from dataclasses import replace
from math import pi

import h5py
import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.signal import welch
from scipy.special import ellipk

from benchmarks.blind import generate as maker
from benchmarks.blind.generator import Case, generate_recording, write
from benchmarks.blind.imperfections import IMPERFECTIONS
from benchmarks.blind.motion import FOREIGN, NODES, RATE, SLIP, THETA, Trajectory
from benchmarks.blind.noise import KINDS, Noise, telegraph
from benchmarks.blind.readout import (
    apply_limit,
    imperfect_gain,
    interleaving,
    is_missing,
    settle_start,
    simulate_motion,
)
from benchmarks.blind.scanner_truth import Truth
from benchmarks.blind.sensitivity import channels_in_sigma
from benchmarks.blind.share import SHARES, nominal_misfit
from scanner.recording import Recording
from tests.support.blind_motion import LINEAR, OMEGA, STEP, SWING, UNDAMPED, run


def mean_frequency(trajectory: Trajectory, first: int = 0) -> float:
    """From the first to the last downward zero crossing of the rate [rad/s]."""
    rate = trajectory.states[first:, RATE]
    i = np.flatnonzero((rate[:-1] > 0) & (rate[1:] <= 0))
    times = (i + rate[i] / (rate[i] - rate[i + 1])) * STEP
    return 2 * pi * (len(times) - 1) / (times[-1] - times[0])


# --- Laws of the imperfections.


def test_a_readout_curve_of_fifth_order_makes_its_harmonics() -> None:
    time = np.arange(10_000) / 10_000
    sine = 2.0 * np.sin(2 * pi * 50 * time)
    bent = imperfect_gain(sine, time, Truth(curve_5=0.08, curve_height=2.0))
    spectrum = 2 * np.abs(np.fft.rfft(bent)) / time.size
    # sin^5 = (10 sin - 5 sin 3 + sin 5) / 16
    np.testing.assert_allclose(spectrum[[50, 150, 250]], [2 + 0.1, 0.05, 0.01], rtol=1e-9)


def test_a_gain_flutters_with_its_stated_size() -> None:
    time = np.arange(100_000) * 1e-3
    gain = imperfect_gain(np.ones_like(time), time, Truth(flutter=0.01, flutter_frequency=5.0))
    assert gain.mean() == pytest.approx(1.0, abs=1e-4)
    assert gain.std() == pytest.approx(0.01 * np.sqrt((1 + 0.36 + 0.16) / 2), rel=0.02)


def test_a_gain_follows_the_recent_level() -> None:
    time = np.arange(20_000) * 1e-4
    level = np.where(time < 1.0, 1.0, 2.0)
    p = Truth(level_gain=0.02, level_tau=0.1, level_square=1.0)
    gain = imperfect_gain(level, time, p) / level
    np.testing.assert_allclose(gain[:9_000], 1.0, atol=1e-9)
    exact = 1 - 0.02 * 3.0 * -np.expm1(-(time[10_000:] - 1.0) / 0.1)
    np.testing.assert_allclose(gain[10_000:], exact, atol=1e-4)


def test_a_foreign_mode_couples_as_two_oscillators_do() -> None:
    drive, coupling = 0.97 * OMEGA, 0.2 * OMEGA**2
    p = LINEAR._replace(foreign_frequency=2.3 * OMEGA, foreign_damping=0.1 * OMEGA, foreign_coupling=coupling)
    t = STEP * (np.arange(60_000)[:, None] + NODES)
    trajectory = run(p, np.sin(drive * t), theta=0.0, steps=60_000)
    follow = coupling / (p.foreign_frequency**2 - drive**2 + 1j * drive * p.foreign_damping)
    transfer = p.torque_per_volt / (p.k - p.J * drive**2 + 1j * drive * p.b - p.J * coupling * follow)
    late = STEP * np.arange(55_000, 60_000)
    for state, response in ((THETA, transfer), (FOREIGN, transfer * follow)):
        exact = np.imag(response * np.exp(1j * drive * late))
        np.testing.assert_allclose(trajectory.states[55_000:-1, state], exact, atol=1e-5 * abs(response))


def test_a_spring_remembers_the_mean_square_of_the_angle() -> None:
    share = 0.01
    p = UNDAMPED._replace(spring_memory=share / (0.5 * SWING**2), spring_tau=0.01)
    trajectory = run(p, steps=60_000)
    shift = mean_frequency(trajectory, first=20_000) / OMEGA - 1
    square = np.mean(trajectory.states[20_000:, THETA] ** 2)
    assert shift == pytest.approx(p.spring_memory * square / 2, rel=0.01)
    assert square == pytest.approx(SWING**2 / 2, rel=0.1)


def test_a_drive_that_remembers_its_level_weakens() -> None:
    drive = 0.9 * OMEGA
    t = STEP * (np.arange(60_000)[:, None] + NODES)
    volts = 2.0 * np.sin(drive * t)
    plain, tired = (
        run(LINEAR._replace(drive_memory=m, drive_tau=0.05), volts, 0.0, 60_000).states[-2000:, THETA]
        for m in (0.0, 0.02 / 2.0)
    )
    ratio = np.abs(tired).max() / np.abs(plain).max()
    assert ratio == pytest.approx(1 - 0.02 * -np.expm1(-0.3 / 0.05), abs=5e-4)


def test_a_pivot_sticks_at_small_angles_and_slips_at_large_ones() -> None:
    p = UNDAMPED._replace(slip_stiffness=0.02 * UNDAMPED.k, slip_angle=0.2 * SWING)
    small = run(p, theta=1e-3 * SWING)
    assert mean_frequency(small) / OMEGA - 1 == pytest.approx(0.01, rel=0.02)
    np.testing.assert_allclose(small.states[1:, SLIP], small.states[1:, THETA] - 1e-3 * SWING, atol=2e-5 * SWING)
    large = run(p)
    assert np.abs(large.states[:, SLIP]).max() == pytest.approx(p.slip_angle, rel=0.02)
    energy = p.J * large.states[:, RATE] ** 2 / 2 + p.k * large.states[:, THETA] ** 2 / 2
    assert energy[-1] < 0.98 * energy[1000]  # the slip dissipates, though the axis has no damping


def test_interleaved_samples_have_the_stated_rms_and_no_mean() -> None:
    for size in range(2, 9):
        offsets = interleaving(size * 100, Truth(uneven=1.0, uneven_pattern=float(size), uneven_phase=0.37))
        assert offsets.mean() == pytest.approx(0.0, abs=1e-12)
        assert np.sqrt(np.mean(offsets**2)) == pytest.approx(1.0)
        np.testing.assert_array_equal(offsets[:size], offsets[size : 2 * size])


def test_missing_codes_return_the_code_below_and_others_themselves() -> None:
    p = Truth(code_step=0.01, code_missing=0.2, code_seed=123.0)
    codes = np.arange(-5000, 5000)
    missing = is_missing(codes.astype(float), p)
    assert missing.mean() == pytest.approx(0.2, abs=0.02)
    np.testing.assert_allclose(apply_limit(0.01 * codes, p), 0.01 * (codes - missing), atol=1e-12)


def test_a_rail_cuts_one_side_only() -> None:
    np.testing.assert_array_equal(apply_limit(np.array([-3.0, 0.0, 3.0]), Truth(rail=1.0)), [-3.0, 0.0, 1.0])


@pytest.mark.slow
def test_every_imperfection_is_off_by_default_and_grows_with_its_strength() -> None:
    blind = generate_recording(Case("a", "none", "tf", (), "white", 5))
    rng = np.random.default_rng(1)
    for imperfection in IMPERFECTIONS.values():
        fields = [imperfection.law(blind.reference, blind.truth, r, rng.random(3)) for r in (0.01, 0.02)]
        changed = {name for name in fields[0] if fields[0][name] != getattr(Truth(), name)}
        assert changed, imperfection.name
        assert fields[0] != fields[1]


# --- Shares.


def fitted_sum_of_squares(blind, channels: np.ndarray, with_law: bool) -> float:  # type: ignore[no-untyped-def]
    """Least sum of squares of the nominal device, with the true law or without, by scipy's own solver."""
    scenario, truth = blind.scenario, blind.truth if with_law else blind.reference.scenario.truth
    names = ["b", "k", "C0", "Cb", "theta0", "R_s"]
    start = blind.scenario.initial
    (injected,) = blind.injected
    off = {} if blind.imperfection is None else {name: getattr(Truth(), name) for name in blind.imperfection.fields}

    def residual(x: np.ndarray) -> np.ndarray:
        to = truth._replace(
            **off, **{name: getattr(truth, name) * (1 + 0.01 * z) for name, z in zip(names, x, strict=False)}
        )
        if with_law:
            to = to._replace(**{name: value * (1 + 0.1 * x[9]) for name, value in injected.fields.items()})
        to = to._replace(offset=0.1 * x[8])
        initial = start.copy()
        initial[[THETA, RATE]] += 0.01 * scenario.swing * x[6:8] * [1.0, scenario.omega]
        motion = simulate_motion(replace(scenario, initial=initial), to)
        return channels_in_sigma(blind.noise, scenario, to, motion, whiten=False) - channels

    return 2 * least_squares(residual, np.zeros(10 if with_law else 9), method="lm", diff_step=1e-3).cost


@pytest.mark.slow
def test_the_share_is_as_stated() -> None:
    blind = generate_recording(Case("a", "one", "ring", ("quadratic-drag",), "white", 3, "gain-flutter"))
    placed = blind.imperfection
    assert placed is not None
    assert SHARES[0] / 1.3 < placed.share < SHARES[1] * 1.3
    motion = simulate_motion(blind.scenario, blind.truth)
    channels = channels_in_sigma(blind.noise, blind.scenario, blind.truth, motion, whiten=False)
    nominal, law = (fitted_sum_of_squares(blind, channels, with_law) for with_law in (False, True))
    assert law / nominal == pytest.approx(placed.share, rel=0.25)
    assert nominal == pytest.approx(placed.misfit, rel=0.25)


@pytest.mark.slow
def test_a_scanner_without_effects_has_no_misfit() -> None:
    blind = generate_recording(Case("a", "none", "ring", (), "white", 4))
    scenario = settle_start(blind.reference.scenario, blind.truth)
    channels = channels_in_sigma(
        blind.noise, scenario, blind.truth, simulate_motion(scenario, blind.truth), whiten=False
    )
    assert nominal_misfit(blind.reference, blind.noise, scenario, channels) < 1e-6


# --- Noise.


def test_flicker_noise_has_its_knee() -> None:
    noise = Noise(0.1, knee=1000.0)
    drawn = noise.draw(np.arange(400_000) / 100e3, np.random.default_rng(1))
    frequency, density = welch(drawn, 100e3, nperseg=16384)
    band = (frequency > 50) & (frequency < 40e3)
    ratio = density[band] / (2 * 0.1**2 / 100e3 * (1 + 1000.0 / frequency[band]))
    assert np.median(ratio) == pytest.approx(1.0, abs=0.05)
    slope = np.polyfit(np.log(frequency[band][:20]), np.log(density[band][:20]), 1)[0]
    assert slope < -0.6


def test_resonances_are_broad_lines_of_the_drawn_height() -> None:
    rng = np.random.default_rng(2)
    noise = KINDS["resonances"](0.1, 100e3, 4.0, 1.0, rng)
    frequency, density = welch(noise.draw(np.arange(800_000) / 100e3, rng), 100e3, nperseg=16384)
    white = 2 * 0.1**2 / 100e3
    for line in noise.resonances:
        peak = density[np.abs(frequency - line.frequency) < 0.3 * line.width].mean() / white
        expected = noise.density(np.array([line.frequency]), 1.0)[0]
        assert peak == pytest.approx(expected, rel=0.25)


def test_hum_has_its_harmonics() -> None:
    rng = np.random.default_rng(3)
    noise = KINDS["hum"](0.1, 10e3, 20.0, 1.0, rng)
    times = np.arange(200_000) / 10e3
    drawn = noise.draw(times, rng)
    for harmonic, amplitude in enumerate(noise.hum, start=1):
        turn = 2 * pi * noise.mains * harmonic * times
        measured = 2 * abs(np.mean(drawn * np.exp(-1j * turn)))
        assert measured == pytest.approx(amplitude, abs=4 * 0.1 * np.sqrt(2 / times.size))
    assert len(noise.hum) == 7


def test_gain_noise_is_proportional_to_the_signal() -> None:
    rng = np.random.default_rng(4)
    noise = KINDS["proportional"](0.1, 10e3, 20.0, 2.0, rng)
    signal = np.repeat([0.0, 2.0], 100_000)
    drawn = noise.draw(np.arange(200_000) / 10e3, rng, signal)
    quiet, loud = drawn[:100_000].std(), drawn[100_000:].std()
    assert quiet == pytest.approx(0.1, rel=0.02)
    assert loud == pytest.approx(np.hypot(0.1, 2.0 * noise.gain_sd), rel=0.02)
    assert 0.3 * 0.1 < 2.0 * noise.gain_sd < 1.0 * 0.1


def test_popcorn_noise_is_a_telegraph_signal() -> None:
    times = np.arange(100_000) / 1e3
    steps = [np.count_nonzero(np.diff(telegraph(times, 2.0, np.random.default_rng(i)))) for i in range(20)]
    assert np.mean(steps) == pytest.approx(200.0, rel=0.05)
    noise = KINDS["popcorn"](0.1, 1e3, 100.0, 1.0, np.random.default_rng(5))
    assert 0.02 <= noise.popcorn <= 0.1
    assert 5 <= noise.popcorn_rate * 100.0 <= 40


@pytest.mark.parametrize("kind", sorted(KINDS))
def test_every_kind_of_noise_has_the_stated_white_part(kind: str) -> None:
    rng = np.random.default_rng(6)
    noise = KINDS[kind](0.1, 100e3, 1.0, 1.0, rng)
    assert noise.sd == 0.1
    drawn = noise.draw(np.arange(100_000) / 100e3, rng, np.zeros(100_000))
    frequency, density = welch(drawn, 100e3, nperseg=8192)
    assert np.median(density[frequency > 45e3]) == pytest.approx(2 * 0.1**2 / 100e3, rel=0.3)


# --- Families.


def test_a_pendulum_at_135_degrees_has_its_period() -> None:
    swing = np.deg2rad(135.0)
    frequency = mean_frequency(run(UNDAMPED._replace(pendulum=1.0), theta=swing, steps=40_000))
    assert OMEGA / frequency == pytest.approx(2 / pi * ellipk(np.sin(swing / 2) ** 2), rel=1e-4)


@pytest.mark.slow
def test_large_misfits_are_as_large_as_stated() -> None:
    spring = generate_recording(Case("a", "one", "strong-spring", ("cubic-stiffness",), "white", 2))
    k3, k = spring.truth.k3, spring.truth.k
    assert abs(k3) * spring.scenario.swing**2 / k == pytest.approx(0.3)
    sharp = generate_recording(Case("a", "none", "sharp-resonance", (), "white", 2))
    stated, p = sharp.scenario.device["x"]["mechanics"]["k"], sharp.truth
    assert abs(np.sqrt(stated / p.k) - 1) == pytest.approx(0.03, rel=1e-6)
    assert 290 <= np.sqrt(p.k * p.J) / p.b <= 310


@pytest.mark.slow
def test_an_imaging_scan_is_a_recording_of_two_axes_and_their_light(tmp_path) -> None:  # type: ignore[no-untyped-def]
    arguments = [str(tmp_path / "files"), str(tmp_path / "keys"), "--families", "imaging", "--count", "2",
                 "--conceal", "none", "--no-distances", "--seed", "2"]  # fmt: skip
    assert maker.main(arguments) == 0
    keys = json.loads((tmp_path / "keys" / "keys.json").read_text())
    assert [key["kind"] for key in keys.values()] == ["none", "none"]
    for name in keys:
        for folder in (tmp_path / "files", tmp_path / "keys" / "unused"):
            with Recording.open(folder / f"{name}.h5") as recording:
                shared = "sense" in recording.channels
                senses = {"sense"} if shared else {"sense_x", "sense_y"}
                assert set(recording.channels) == senses | {"drive_x", "drive_y", "intensity"}
                assert recording.device is not None
                assert (recording.device.readout is not None) == shared
        angles = np.load(tmp_path / "keys" / "angles" / f"{name}.npz")
        with h5py.File(tmp_path / "files" / f"{name}.h5") as file:
            assert file["channels/intensity"].size == angles["x"].size == angles["y"].size
            frequency = file["channels/drive_x"][:1000]
        assert 0.1 < np.abs(angles["x"]).max() < 0.3
        assert np.isfinite(frequency).all()
    drifting = [key for key in keys.values() if key["effects"]]
    assert all({e["axis"] for e in key["effects"]} == {"x", "y"} for key in drifting)


@pytest.mark.slow
def test_the_same_case_gives_the_same_scanner_with_and_without_imperfection(tmp_path) -> None:  # type: ignore[no-untyped-def]
    plain, imperfect = (
        generate_recording(Case("a", "one", "ring", ("quadratic-drag",), "white", 3, name))
        for name in ("", "readout-curve")
    )
    assert plain.truth == imperfect.truth._replace(**{n: getattr(Truth(), n) for n in imperfect.imperfection.fields})
    unused = plain.unused_channels()
    write(plain, tmp_path / "unused.h5", unused)
    assert not np.array_equal(unused["sense_x"], plain.channels["sense_x"])
    with Recording.open(tmp_path / "unused.h5") as recording:
        assert recording["sense_x"].size == plain.scenario.samples
