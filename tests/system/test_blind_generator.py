"""The generator of blind recordings: equations equal closed forms, the integrator converges, files are valid."""

from __future__ import annotations

import json
import subprocess
import sys
from math import pi

import h5py
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.signal import welch

from benchmarks.blind import generate as maker
from benchmarks.blind import scenarios
from benchmarks.blind.distance import distances
from benchmarks.blind.effects import CATALOGUE
from benchmarks.blind.generator import EFFECTS, Case, generate_recording, write
from benchmarks.blind.motion import (
    NODES,
    RATE,
    SECTION_1,
    SECTION_2,
    STATES,
    THETA,
    Trajectory,
    capacitance,
    capacitance_slope,
    integrate,
)
from benchmarks.blind.noise import KINDS
from benchmarks.blind.out_of_catalogue import OUT_OF_CATALOGUE
from benchmarks.blind.readout import AFTER_MOTION, noiseless_channels, settle_start, simulate_motion
from benchmarks.blind.scanner_truth import Truth
from benchmarks.blind.sensitivity import unprojected_norm
from scanner.device import Device
from scanner.recording import Recording
from scanner.terms import catalogue
from tests.support.blind_motion import LINEAR, OMEGA, STEP, SWING, UNDAMPED, run


def peaks(trajectory: Trajectory) -> tuple[np.ndarray, np.ndarray]:
    """Times and heights of the positive peaks, between the samples: where the rate passes zero downward."""
    theta, rate = trajectory.states[:, THETA], trajectory.states[:, RATE]
    i = np.flatnonzero((rate[:-1] > 0) & (rate[1:] <= 0))
    x = rate[i] / (rate[i] - rate[i + 1])
    return (i + x) * STEP, theta[i] + x * STEP * rate[i] / 2


def case(family: str, *effects: str, seed: int = 3, noise: str = "white") -> Case:
    kind = "none" if not effects else "one"
    return Case("blind-001", kind, family, effects, noise, seed)


# --- Equations and integrator against closed forms.


def test_free_decay_is_the_damped_cosine():
    trajectory = run(LINEAR)
    t = STEP * np.arange(len(trajectory.states))
    decay = LINEAR.b / (2 * LINEAR.J)
    damped = np.sqrt(OMEGA**2 - decay**2)
    exact = SWING * np.exp(-decay * t) * (np.cos(damped * t) + decay / damped * np.sin(damped * t))
    np.testing.assert_allclose(trajectory.states[:, THETA], exact, atol=1e-10 * SWING)


@pytest.mark.parametrize("term", [{}, {"k3": 0.3 * UNDAMPED.k / SWING**2}, {"k2": 0.2 * UNDAMPED.k / SWING}])
def test_energy_is_conserved_without_losses(term):
    p = UNDAMPED._replace(**term)
    theta, rate = run(p, steps=100_000).states[:, [THETA, RATE]].T
    energy = p.J * rate**2 / 2 + p.k * theta**2 / 2 + p.k2 * theta**3 / 3 + p.k3 * theta**4 / 4
    np.testing.assert_allclose(energy, energy[0], rtol=1e-7)


def test_a_driven_linear_axis_has_its_transfer_function():
    drive = 0.97 * OMEGA
    t = STEP * (np.arange(60_000)[:, None] + NODES)
    trajectory = run(LINEAR, 2.0 * np.sin(drive * t), theta=0.0, steps=60_000)
    transfer = LINEAR.torque_per_volt / (LINEAR.k - LINEAR.J * drive**2 + 1j * drive * LINEAR.b)
    late = STEP * np.arange(55_000, 60_000)
    exact = 2.0 * np.imag(transfer * np.exp(1j * drive * late))
    np.testing.assert_allclose(trajectory.states[55_000:-1, THETA], exact, atol=2e-6 * abs(2 * transfer))


def test_cubic_stiffness_raises_the_frequency_by_three_eighths():
    share = 0.02
    times, _ = peaks(run(UNDAMPED._replace(k3=share * UNDAMPED.k / SWING**2)))
    shift = 2 * pi / np.diff(times).mean() / OMEGA - 1
    assert shift == pytest.approx(3 / 8 * share, rel=0.02)


def test_dry_friction_decays_linearly_and_then_sticks():
    tau = 0.02 * UNDAMPED.k * SWING
    trajectory = run(UNDAMPED._replace(tau_c=tau), steps=8_000)
    _, heights = peaks(trajectory)
    # There are two half-periods between positive peaks, and each reduces the amplitude by 2 tau / k.
    np.testing.assert_allclose(np.diff(heights[:10]), -4 * tau / UNDAMPED.k, rtol=3e-4)
    assert np.ptp(trajectory.states[-500:, THETA]) == 0.0
    assert abs(trajectory.states[-1, THETA]) * UNDAMPED.k <= tau


def test_quadratic_drag_decays_as_one_over_time():
    b2 = 0.01 * UNDAMPED.J / SWING
    times, heights = peaks(run(UNDAMPED._replace(b2=b2)))
    growth = np.polyfit(times, 1 / heights, 1)[0]  # dA/dt = -(4 / 3 pi) (b2 / J) omega A^2
    assert growth == pytest.approx(4 / (3 * pi) * b2 / UNDAMPED.J * OMEGA, rel=0.01)


def test_cubic_damping_decays_as_one_over_the_root_of_time():
    b3 = 0.02 * UNDAMPED.J * OMEGA / SWING**2
    times, heights = peaks(run(UNDAMPED._replace(b3=b3)))
    growth = np.polyfit(times, heights**-2, 1)[0]  # dA/dt = -(b3 / 8 J) A^3
    assert growth == pytest.approx(b3 / (4 * UNDAMPED.J), rel=0.01)


def test_viscoelastic_stiffness_and_loss_follow_frequency():
    tau, drive = 1.0 / OMEGA, 0.9 * OMEGA
    p = LINEAR._replace(k_v=0.1 * LINEAR.k, tau_v=tau)
    t = STEP * (np.arange(60_000)[:, None] + NODES)
    trajectory = run(p, np.sin(drive * t), theta=0.0, steps=60_000)
    creep = p.k_v * 1j * drive * tau / (1 + 1j * drive * tau)
    transfer = p.torque_per_volt / (p.k + creep - p.J * drive**2 + 1j * drive * p.b)
    late = STEP * np.arange(55_000, 60_000)
    exact = np.imag(transfer * np.exp(1j * drive * late))
    np.testing.assert_allclose(trajectory.states[55_000:-1, THETA], exact, atol=1e-6 * abs(transfer))


@given(theta=st.floats(-0.3, 0.3), shape=st.floats(-0.1, 0.1), theta_c=st.floats(-0.02, 0.02))
@settings(max_examples=50, deadline=None)
def test_the_slope_of_the_capacitance_is_its_derivative(theta, shape, theta_c):
    p = Truth(C0=5e-12, Cb=9e-12, theta0=0.2, shape=shape, theta_c=theta_c, parasitic=1e-12, parasitic_angle=0.05)
    h = 1e-6
    derived = (capacitance(theta + h, p) - capacitance(theta - h, p)) / (2 * h)
    assert capacitance_slope(theta, p) == pytest.approx(derived, abs=1e-6 * p.C0 / p.theta0)


def test_the_demodulators_sections_filter_the_capacitance():
    """For a small sine the filtered capacitance has the gain and phase of two first-order sections."""
    omega = 2 * pi * 15_500.0
    p = Truth(J=1e-15, k=1e-15 * omega**2, C0=5e-12, Cb=9e-12, theta0=0.2, theta_c=0.1, a_cir=-3e11,
              section_1=2 * pi * 40_800, section_2=2 * pi * 41_100)  # fmt: skip
    initial = np.zeros(STATES)
    initial[[THETA, SECTION_1, SECTION_2]] = 1e-4, capacitance(0.0, p), capacitance(0.0, p)
    step = 1 / 6e6
    trajectory = integrate(p, np.zeros((30_000, len(NODES))), 0.0, step, initial)
    turn = np.exp(-1j * omega * step * np.arange(29_999 - 387 * 50, 29_999))  # 387 steps are one period, nearly
    theta, section = trajectory.states[-len(turn) :, [THETA, SECTION_2]].T
    response = (turn @ (section - section.mean())) / (turn @ theta) / capacitance_slope(0.0, p)
    exact = 1 / ((1 + 1j * omega / p.section_1) * (1 + 1j * omega / p.section_2))
    assert response == pytest.approx(exact, abs=2e-3)


# --- Families, effects and readouts.


@pytest.mark.slow
@pytest.mark.parametrize(
    ("family", "effect"),
    [("ring", None), ("ring", "coulomb-friction"), ("ring", "one-sided-stop"), ("drive", "quadratic-drag"),
     ("tf", "slew-limit")],
)  # fmt: skip
def test_halving_the_step_changes_less_than_the_noise(family, effect):
    blind = generate_recording(case(family, *([effect] if effect else [])))
    fine = noiseless_channels(blind.scenario, blind.truth, refine=2)
    coarse = noiseless_channels(blind.scenario, blind.truth)
    assert np.abs(fine["sense_x"] - coarse["sense_x"]).max() < 0.02 * blind.noise.sd
    if "angle_x" in fine:
        assert np.abs(fine["angle_x"] - coarse["angle_x"]).max() < 0.02 * blind.scenario.angle_sd


@pytest.mark.slow
def test_a_clean_tf_recording_is_the_linear_response_and_white_noise():
    blind = generate_recording(case("tf"))
    p, scenario = blind.truth, blind.scenario
    assert blind.injected == ()
    assert p._replace(J=1, b=0, k=1, torque_per_volt=0, gain=0) == Truth()
    late = scenario.times > 1.1
    tone = 2 * pi * scenario.drive[-1].frequencies[0]
    transfer = p.gain * p.torque_per_volt / (p.k - p.J * tone**2 + 1j * tone * p.b)
    residual = blind.channels["sense_x"][late] - 2.0 * np.imag(transfer * np.exp(1j * tone * scenario.times[late]))
    assert np.sqrt(np.mean(residual**2)) == pytest.approx(blind.noise.sd, rel=0.03)


@pytest.mark.slow
@pytest.mark.parametrize("effect", [e.name for e in EFFECTS.values() if "ring" in e.sizes])
def test_every_effect_changes_the_measured_signals(effect):
    blind = generate_recording(case("ring", effect))
    clean = noiseless_channels(blind.reference.scenario, blind.reference.scenario.truth)
    injected = noiseless_channels(blind.scenario, blind.truth)
    injected["sense_x"] = np.clip(injected["sense_x"], -blind.truth.limit, blind.truth.limit)
    sd = {"sense_x": blind.noise.sd, "angle_x": blind.scenario.angle_sd}
    size = max(np.linalg.norm(injected[name] - clean[name]) / sd[name] for name in clean)
    assert size > 3.0


def test_a_delayed_channel_is_the_undelayed_one_shifted():
    scenario = scenarios.ring(np.random.default_rng(1))
    prompt = noiseless_channels(scenario, scenario.truth)["sense_x"]
    late = noiseless_channels(scenario, scenario.truth._replace(delay=10 / scenario.sample_rate))["sense_x"]
    np.testing.assert_allclose(late[10:], prompt[:-10], atol=1e-9 * np.abs(prompt).max())


def test_a_driven_mirror_oscillates_at_half_the_drive_frequency():
    scenario = scenarios.drive(np.random.default_rng(1))
    scenario = settle_start(scenario, scenario.truth)
    theta = simulate_motion(scenario, scenario.truth).at(scenario.times, THETA)
    third = theta[:40_000]
    spectrum = np.abs(np.fft.rfft(third * np.hanning(len(third)), 2**19))
    frequency = np.argmax(spectrum) * scenario.sample_rate / 2**19
    assert frequency == pytest.approx(scenario.drive[0].frequencies[0] / 2, abs=10.0)
    assert 0.1 < np.abs(theta[-10_000:]).max() < 0.3


@given(family=st.sampled_from(sorted(scenarios.FAMILIES)), seed=st.integers(0, 2**31))
@settings(max_examples=60, deadline=None)
def test_the_nominal_device_differs_from_the_truth_within_its_tolerance(family, seed):
    scenario = scenarios.FAMILIES[family](np.random.default_rng(seed))
    axis = scenario.device["x"]
    stated = {name: value for stage in ("mechanics", "capacitance", "drive", "readout") if stage in axis
              for name, value in axis[stage].items() if isinstance(value, float)}  # fmt: skip
    true = scenario.truth._asdict() | {"b_cir": scenario.truth.offset}
    for name, tolerance in axis["tolerance"].items():
        assert 0 < abs(stated[name] / true[name] - 1) <= 1.1 * tolerance
    assert stated["J"] == scenario.truth.J


def test_coloured_noise_is_as_stated_at_high_frequencies_only():
    rng = np.random.default_rng(4)
    noise = KINDS["coloured"](0.05, 500e3, 0.8, 1.0, rng)
    drawn = noise.draw(np.arange(400_000) / 500e3, rng)
    frequency, density = welch(drawn, 500e3, nperseg=8192)
    white = 2 * noise.sd**2 / 500e3
    assert np.median(density[frequency > 150e3]) == pytest.approx(white, rel=0.1)
    assert np.median(density[(frequency > 200) & (frequency < 500)]) > 4 * white


# --- Files, keys and seeds.


def test_the_same_case_gives_the_same_recording():
    one, two = (generate_recording(case("ring", "cubic-stiffness", noise="coloured")) for _ in range(2))
    other = generate_recording(case("ring", "cubic-stiffness", noise="coloured", seed=4))
    assert one.key() == two.key()
    for name, values in one.channels.items():
        np.testing.assert_array_equal(values, two.channels[name])
    assert not np.array_equal(one.channels["sense_x"], other.channels["sense_x"])


def test_a_written_recording_opens_and_does_not_contain_the_truth(tmp_path):
    blind = generate_recording(case("ring", "channel-delay"))
    write(blind, tmp_path / "blind-001.h5")
    with h5py.File(tmp_path / "blind-001.h5") as file:
        assert sorted(file) == ["channels", "device"]
        assert sorted(file.attrs) == ["format", "name", "version"]
        assert sorted(file["channels"]) == ["angle_x", "bias_x", "sense_x"]
        for data in file["channels"].values():
            assert sorted(data.attrs) == ["sample_rate", "start", "unit"]
            assert data.dtype == np.float32
        device = Device.from_toml(file["device"].attrs["toml"])
    assert device.name == "blind"
    assert device.axes["x"].terms == {}
    assert blind.key()["effects"][0]["effect"] == "channel-delay"
    recording = Recording.open(tmp_path / "blind-001.h5")
    assert recording.device == device
    assert list(tmp_path.iterdir()) == [tmp_path / "blind-001.h5"]


def test_the_plan_contains_every_effect_and_a_third_of_coloured_noise():
    plan = maker.plan(maker.COUNTS, seed=1)
    assert plan == maker.plan(maker.COUNTS, seed=1)
    assert plan != maker.plan(maker.COUNTS, seed=2)
    assert {kind: sum(o.kind == kind for o in plan) for kind in maker.COUNTS} == maker.COUNTS
    assert {name for o in plan for name in o.effects} == {effect.name for effect in (*CATALOGUE, *OUT_OF_CATALOGUE)}
    assert len({o.name for o in plan}) == len({o.seed for o in plan}) == len(plan) >= 300
    for kind in maker.COUNTS:
        of_kind = [o for o in plan if o.kind == kind]
        assert sum(o.noise == "coloured" for o in of_kind) == len(of_kind) // 3
    stages = {EFFECTS[name].stage for o in plan if o.kind == "unlisted" for name in o.effects}
    assert stages == {"drive", "mechanics", "capacitance", "readout", "timing", "optics"}


@pytest.mark.slow
def test_an_interrupted_generation_is_continued(tmp_path, monkeypatch):
    monkeypatch.setattr(maker, "FAMILIES", {"ring": scenarios.ring})
    arguments = [str(tmp_path / "files"), str(tmp_path / "keys"), "--none", "2", "--one", "0", "--two", "0",
                 "--unlisted", "0"]  # fmt: skip
    assert maker.main(arguments) == 0
    first, second = sorted((tmp_path / "files").glob("*.h5"))
    untouched = first.stat().st_mtime_ns
    (tmp_path / "keys" / f"{second.stem}.json").unlink()
    second.unlink()
    assert maker.main(arguments) == 0
    assert second.exists()
    assert first.stat().st_mtime_ns == untouched
    assert set(json.loads((tmp_path / "keys" / "keys.json").read_text())) == {first.stem, second.stem}
    with pytest.raises(SystemExit):
        maker.main([str(tmp_path), str(tmp_path)])


@pytest.mark.slow
def test_the_generator_imports_no_package_of_the_project():
    names = "scanner", "phantoms", "estimation", "recon"
    code = (
        "import sys, benchmarks.blind.generate, benchmarks.blind.score\n"
        f"print([m for m in sys.modules if m.split('.')[0] in {names}])"
    )
    root = str(maker.Path(__file__).parents[2])
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=root)
    assert done.stdout.strip() == "[]"


# --- Detectability of effects.


@pytest.mark.slow
def test_the_detectability_of_a_tone_follows_from_its_energy():
    blind = generate_recording(case("ring", "interference", seed=8))
    (detectability,) = distances(blind)
    tone = blind.truth.tone
    assert detectability["sigma"] == pytest.approx(tone * np.sqrt(blind.scenario.samples / 2) / blind.noise.sd, rel=0.1)
    assert detectability["distance"] <= detectability["sigma"]


@pytest.mark.slow
def test_values_without_a_stated_tolerance_have_two_percent():
    """The detectability of a filter without a stated tolerance is its deviation in units of the default tolerance."""
    blind = generate_recording(case("drive", "filter-lag"))
    (detectability,) = distances(blind)
    assert detectability["sigma"] == pytest.approx(abs(blind.injected[0].size) / 0.02, rel=0.1)


@pytest.mark.slow
def test_the_nearest_confounder_of_drag_is_another_damping():
    (detectability,) = distances(generate_recording(case("ring", "quadratic-drag")))
    assert detectability["nearest"] in {"cubic-damping", "coulomb-friction", "viscoelastic", "damping-drift"}
    assert 0.1 * detectability["sigma"] < detectability["distance"] < detectability["sigma"]


@given(size=st.floats(0.1, 100.0), alike=st.floats(-0.99, 0.99), strength=st.floats(0.1, 1000.0))
def test_a_confounder_reduces_the_detectability_by_its_projection(size, alike, strength):
    """A free confounder removes the whole projection; one with a prior removes less."""
    effect = size * np.array([1.0, 0.0])
    rival = strength * np.array([alike, np.sqrt(1 - alike**2)])
    gram = np.array([effect, rival]) @ np.array([effect, rival]).T
    assert unprojected_norm(gram, 0, [1]) == pytest.approx(size * np.sqrt(1 - alike**2), rel=1e-6)
    gram[1, 1] += 1.0
    exact = size * np.sqrt(1 - alike**2 * strength**2 / (strength**2 + 1))
    assert unprojected_norm(gram, 0, [1]) == pytest.approx(exact, rel=1e-6)


@pytest.mark.slow
def test_parameters_of_the_readout_do_not_change_the_motion():
    for family in ("tf", "ring"):
        scenario = generate_recording(case(family)).reference.scenario
        truth = scenario.truth
        other = truth._replace(**{name: 0.5 if np.isinf(v) else v + 0.5 for name, v in after(truth).items()})
        np.testing.assert_array_equal(simulate_motion(scenario, truth).states, simulate_motion(scenario, other).states)
        assert (
            simulate_motion(scenario, truth._replace(b=1.1 * truth.b)).states[-1, THETA]
            != simulate_motion(scenario, truth).states[-1, THETA]
        )


def after(truth):
    return {name: getattr(truth, name) for name in AFTER_MOTION}


def test_names_that_describe_an_effect_as_well_are_in_the_catalogue() -> None:
    assert {name for effect in EFFECTS.values() for name in effect.also_right} <= set(catalogue())
