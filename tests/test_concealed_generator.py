"""The sealed recordings' truth: its equations against closed forms, its integrator against itself, its files' form."""

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

from benchmarks.concealed import make as maker
from benchmarks.concealed import worlds
from benchmarks.concealed.distance import distances, left_over
from benchmarks.concealed.generator import EFFECTS, Order, seal, write
from benchmarks.concealed.motion import (
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
from benchmarks.concealed.readout import AFTER_MOTION, Noise, move, observe, settle
from benchmarks.concealed.scanner_truth import Truth
from scanner.device import Device
from scanner.recording import Recording

OMEGA = 2 * pi * 700.0
LINEAR = Truth(J=1e-12, b=1e-12 * OMEGA / 40, k=1e-12 * OMEGA**2, torque_per_volt=1e-8, gain=40.0)
UNDAMPED = LINEAR._replace(b=0.0)
STEP = 5e-6
SWING = 0.02


def run(truth: Truth, volts: np.ndarray | float = 0.0, theta: float = SWING, steps: int = 20_000) -> Trajectory:
    initial = np.zeros(STATES)
    initial[THETA] = theta
    return integrate(truth, np.broadcast_to(np.asarray(volts), (steps, len(NODES))).copy(), 0.0, STEP, initial)


def peaks(trajectory: Trajectory) -> tuple[np.ndarray, np.ndarray]:
    """Times and heights of the positive peaks, between the samples: where the rate passes zero downward."""
    theta, rate = trajectory.states[:, THETA], trajectory.states[:, RATE]
    i = np.flatnonzero((rate[:-1] > 0) & (rate[1:] <= 0))
    x = rate[i] / (rate[i] - rate[i + 1])
    return (i + x) * STEP, theta[i] + x * STEP * rate[i] / 2


def order(family: str, *effects: str, seed: int = 3, coloured: bool = False) -> Order:
    kind = "none" if not effects else "one"
    return Order("sealed-001", kind, family, effects, coloured, seed)


# --- Equations and integrator against closed forms.


def test_free_decay_is_the_damped_cosine():
    trajectory = run(LINEAR)
    t = STEP * np.arange(len(trajectory.states))
    decay = LINEAR.b / (2 * LINEAR.J)
    damped = np.sqrt(OMEGA**2 - decay**2)
    exact = SWING * np.exp(-decay * t) * (np.cos(damped * t) + decay / damped * np.sin(damped * t))
    np.testing.assert_allclose(trajectory.states[:, THETA], exact, atol=1e-10 * SWING)


@pytest.mark.parametrize("term", [{}, {"k3": 0.3 * UNDAMPED.k / SWING**2}, {"k2": 0.2 * UNDAMPED.k / SWING}])
def test_energy_stays_where_nothing_takes_it(term):
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


def test_dry_friction_decays_linearly_and_then_holds():
    tau = 0.02 * UNDAMPED.k * SWING
    trajectory = run(UNDAMPED._replace(tau_c=tau), steps=8_000)
    _, heights = peaks(trajectory)
    # Between positive peaks the mirror turns twice, and each half loses 2 tau / k.
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
def test_the_combs_slope_is_their_capacitance_derived(theta, shape, theta_c):
    p = Truth(C0=5e-12, Cb=9e-12, theta0=0.2, shape=shape, theta_c=theta_c, parasitic=1e-12, parasitic_angle=0.05)
    h = 1e-6
    derived = (capacitance(theta + h, p) - capacitance(theta - h, p)) / (2 * h)
    assert capacitance_slope(theta, p) == pytest.approx(derived, abs=1e-6 * p.C0 / p.theta0)


def test_the_demodulators_sections_filter_the_capacitance():
    """The capacitance of a small sine comes out with the gain and the phase of two first-order sections."""
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


@pytest.mark.parametrize(
    ("family", "effect"),
    [("ring", None), ("ring", "coulomb-friction"), ("ring", "one-sided-stop"), ("drive", "quadratic-drag"),
     ("tf", "slew-limit")],
)  # fmt: skip
def test_half_the_step_changes_nothing_that_the_noise_would_show(family, effect):
    sealed = seal(order(family, *([effect] if effect else [])))
    fine = observe(sealed.world, sealed.truth, refine=2)
    coarse = observe(sealed.world, sealed.truth)
    assert np.abs(fine["sense_x"] - coarse["sense_x"]).max() < 0.02 * sealed.noise.sd
    if "angle_x" in fine:
        assert np.abs(fine["angle_x"] - coarse["angle_x"]).max() < 0.02 * sealed.world.angle_sd


def test_a_clean_tf_recording_is_the_linear_response_and_white_noise():
    sealed = seal(order("tf"))
    p, world = sealed.truth, sealed.world
    assert sealed.hidden == ()
    assert p._replace(J=1, b=0, k=1, torque_per_volt=0, gain=0) == Truth()
    late = world.times > 1.1
    tone = 2 * pi * world.drive[-1].frequencies[0]
    transfer = p.gain * p.torque_per_volt / (p.k - p.J * tone**2 + 1j * tone * p.b)
    residual = sealed.channels["sense_x"][late] - 2.0 * np.imag(transfer * np.exp(1j * tone * world.times[late]))
    assert np.sqrt(np.mean(residual**2)) == pytest.approx(sealed.noise.sd, rel=0.03)


@pytest.mark.parametrize("effect", [e.name for e in EFFECTS.values() if "ring" in e.sizes])
def test_every_effect_changes_what_is_measured(effect):
    sealed = seal(order("ring", effect))
    clean = observe(sealed.scene.world, sealed.scene.world.truth)
    hidden = observe(sealed.world, sealed.truth)
    hidden["sense_x"] = np.clip(hidden["sense_x"], -sealed.truth.limit, sealed.truth.limit)
    sd = {"sense_x": sealed.noise.sd, "angle_x": sealed.world.angle_sd}
    size = max(np.linalg.norm(hidden[name] - clean[name]) / sd[name] for name in clean)
    assert size > 3.0


def test_a_late_channel_is_the_prompt_one_moved():
    world = worlds.ring(np.random.default_rng(1))
    prompt = observe(world, world.truth)["sense_x"]
    late = observe(world, world.truth._replace(delay=10 / world.sample_rate))["sense_x"]
    np.testing.assert_allclose(late[10:], prompt[:-10], atol=1e-9 * np.abs(prompt).max())


def test_a_driven_mirror_swings_on_its_branch_at_half_the_drives_frequency():
    world = worlds.drive(np.random.default_rng(1))
    world = settle(world, world.truth)
    theta = move(world, world.truth).at(world.times, THETA)
    third = theta[:40_000]
    spectrum = np.abs(np.fft.rfft(third * np.hanning(len(third)), 2**19))
    frequency = np.argmax(spectrum) * world.sample_rate / 2**19
    assert frequency == pytest.approx(world.drive[0].frequencies[0] / 2, abs=10.0)
    assert 0.1 < np.abs(theta[-10_000:]).max() < 0.3


@given(family=st.sampled_from(sorted(worlds.FAMILIES)), seed=st.integers(0, 2**31))
@settings(max_examples=60, deadline=None)
def test_the_nominal_device_is_off_but_within_its_tolerance(family, seed):
    world = worlds.FAMILIES[family](np.random.default_rng(seed))
    axis = world.device["x"]
    stated = {name: value for stage in ("mechanics", "capacitance", "drive", "readout") if stage in axis
              for name, value in axis[stage].items() if isinstance(value, float)}  # fmt: skip
    true = world.truth._asdict() | {"b_cir": world.truth.offset}
    for name, tolerance in axis["tolerance"].items():
        assert 0 < abs(stated[name] / true[name] - 1) <= 1.1 * tolerance
    assert stated["J"] == world.truth.J


def test_coloured_noise_is_as_stated_at_high_frequencies_only():
    rng = np.random.default_rng(4)
    noise = Noise.coloured(0.05, 500e3, rng)
    drawn = noise.draw(np.arange(400_000) / 500e3, rng)
    frequency, density = welch(drawn, 500e3, nperseg=8192)
    white = 2 * noise.sd**2 / 500e3
    assert np.median(density[frequency > 150e3]) == pytest.approx(white, rel=0.1)
    assert np.median(density[(frequency > 200) & (frequency < 500)]) > 4 * white


# --- Files, keys and seeds.


def test_the_same_order_gives_the_same_recording():
    one, two = (seal(order("ring", "cubic-stiffness", coloured=True)) for _ in range(2))
    other = seal(order("ring", "cubic-stiffness", coloured=True, seed=4))
    assert one.key() == two.key()
    for name, values in one.channels.items():
        np.testing.assert_array_equal(values, two.channels[name])
    assert not np.array_equal(one.channels["sense_x"], other.channels["sense_x"])


def test_a_written_recording_opens_and_tells_nothing(tmp_path):
    sealed = seal(order("ring", "channel-delay"))
    write(sealed, tmp_path / "sealed-001.h5")
    with h5py.File(tmp_path / "sealed-001.h5") as file:
        assert sorted(file) == ["channels", "device"]
        assert sorted(file.attrs) == ["format", "name", "version"]
        assert sorted(file["channels"]) == ["angle_x", "bias_x", "sense_x"]
        for data in file["channels"].values():
            assert sorted(data.attrs) == ["sample_rate", "start", "unit"]
            assert data.dtype == np.float32
        device = Device.from_toml(file["device"].attrs["toml"])
    assert device.name == "sealed"
    assert device.axes["x"].terms == {}
    assert sealed.key()["effects"][0]["effect"] == "channel-delay"
    recording = Recording.open(tmp_path / "sealed-001.h5")
    assert recording.device == device
    assert list(tmp_path.iterdir()) == [tmp_path / "sealed-001.h5"]


def test_the_plan_forgets_nothing_and_colours_a_third():
    plan = maker.plan(maker.COUNTS, seed=1)
    assert plan == maker.plan(maker.COUNTS, seed=1)
    assert plan != maker.plan(maker.COUNTS, seed=2)
    assert {kind: sum(o.kind == kind for o in plan) for kind in maker.COUNTS} == maker.COUNTS
    assert {name for o in plan for name in o.effects} == set(EFFECTS)
    assert len({o.name for o in plan}) == len({o.seed for o in plan}) == len(plan) >= 300
    for kind in maker.COUNTS:
        of_kind = [o for o in plan if o.kind == kind]
        assert sum(o.coloured for o in of_kind) == len(of_kind) // 3
    stages = {EFFECTS[name].stage for o in plan if o.kind == "unlisted" for name in o.effects}
    assert stages == {"drive", "mechanics", "capacitance", "readout", "timing", "optics"}


def test_an_interrupted_make_goes_on(tmp_path, monkeypatch):
    monkeypatch.setattr(maker, "FAMILIES", {"ring": worlds.ring})
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


def test_nothing_of_the_project_is_imported():
    names = "scanner", "phantoms", "estimation", "recon"
    code = (
        "import sys, benchmarks.concealed.make, benchmarks.concealed.score\n"
        f"print([m for m in sys.modules if m.split('.')[0] in {names}])"
    )
    root = str(maker.Path(__file__).parents[1])
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=root)
    assert done.stdout.strip() == "[]"


# --- What a recording can tell.


def test_a_lone_tone_is_as_plain_as_its_energy_says():
    sealed = seal(order("ring", "interference", seed=8))
    (seen,) = distances(sealed)
    tone = sealed.truth.tone
    assert seen["sigma"] == pytest.approx(tone * np.sqrt(sealed.world.samples / 2) / sealed.noise.sd, rel=0.1)
    assert seen["distance"] <= seen["sigma"]


def test_what_nobody_states_may_be_off_by_two_percent():
    """A filter of which no tolerance is stated lies only as many of the default off as its corners do."""
    sealed = seal(order("drive", "filter-lag"))
    (seen,) = distances(sealed)
    assert seen["sigma"] == pytest.approx(abs(sealed.hidden[0].size) / 0.02, rel=0.1)


def test_drag_lies_nearest_to_other_damping():
    (seen,) = distances(seal(order("ring", "quadratic-drag")))
    assert seen["nearest"] in {"cubic-damping", "coulomb-friction", "viscoelastic", "damping-drift"}
    assert 0.1 * seen["sigma"] < seen["distance"] < seen["sigma"]


@given(size=st.floats(0.1, 100.0), alike=st.floats(-0.99, 0.99), strength=st.floats(0.1, 1000.0))
def test_what_a_look_alike_leaves_over(size, alike, strength):
    """A free look-alike takes its projection; one held by a prior takes less, and nothing where it is too weak."""
    effect = size * np.array([1.0, 0.0])
    rival = strength * np.array([alike, np.sqrt(1 - alike**2)])
    gram = np.array([effect, rival]) @ np.array([effect, rival]).T
    assert left_over(gram, 0, [1]) == pytest.approx(size * np.sqrt(1 - alike**2), rel=1e-6)
    gram[1, 1] += 1.0
    exact = size * np.sqrt(1 - alike**2 * strength**2 / (strength**2 + 1))
    assert left_over(gram, 0, [1]) == pytest.approx(exact, rel=1e-6)


def test_what_is_read_after_the_motion_leaves_the_motion_alone():
    for family in ("tf", "ring"):
        world = seal(order(family)).scene.world
        truth = world.truth
        other = truth._replace(**{name: 0.5 if np.isinf(v) else v + 0.5 for name, v in after(truth).items()})
        np.testing.assert_array_equal(move(world, truth).states, move(world, other).states)
        assert move(world, truth._replace(b=1.1 * truth.b)).states[-1, THETA] != move(world, truth).states[-1, THETA]


def after(truth):
    return {name: getattr(truth, name) for name in AFTER_MOTION}
