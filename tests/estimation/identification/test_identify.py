"""Identification: intervals have their nominal coverage, and the command writes its files."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from benchmarks.papers.sine import driven, linear_axis
from benchmarks.papers.threshold import sensing_axis
from estimation.identification.calibrate import identify
from estimation.identification.classification import classify_recording
from estimation.identification.fits import DrivenRecord, fit_mechanics, fit_ringdown
from phantoms.forward import InitialState, Plan, settled_state, simulate, simulate_trajectory
from phantoms.waveforms import Constant, Sine, Sweep
from recon.cli import main
from scanner.device import Axis, Device
from scanner.devices import load
from scanner.drift import Drift
from scanner.errors import BadInput
from scanner.recording import Recording
from scanner.stages import Mechanics
from tests.support.identified import coverage, decay_under_bias

DRIVEN = load("chen2020-driven")
AXIS = DRIVEN.axis("x")
RATE, PSD = 5e6, 2e-4


@pytest.fixture(scope="module")
def moving() -> list[DrivenRecord]:
    """Noiseless driven motion at three frequencies."""
    records = []
    for f in (31400.0, 31480.0, 31560.0):
        plan = Plan({"x": Sine(f, 30.0, 30.0)}, 0.004, RATE, substeps=4)
        angle = simulate_trajectory(AXIS, plan, settled_state(AXIS, replace(plan, settle=0.04)), 0.0, 0.004).angle
        records.append(DrivenRecord(angle[:-1:4], plan.drives["x"](np.arange(20000) / RATE), f / 2, RATE))
    return records


@pytest.fixture(scope="module")
def decay() -> tuple[np.ndarray, np.ndarray]:
    return decay_under_bias()


def test_driven_motion_determines_inertia_damping_and_stiffness(moving):
    """A ringdown determines only ratios of J, k and b. Driven motion determines all three."""
    m = AXIS.require_mechanics()
    draws = []
    for seed in range(40):
        rng = np.random.default_rng(seed)
        noisy = [replace(r, angle=r.angle + PSD * rng.standard_normal(r.angle.size)) for r in moving]
        draws.append(fit_mechanics(AXIS, noisy))
    truth = {"J": m.J, "b": m.b, "k": m.k}
    for key, value in truth.items():
        assert np.mean([d[key].value for d in draws]) == pytest.approx(value, rel=2e-3)
    assert min(coverage(draws, truth).values()) >= 0.8


def test_a_sweep_at_a_high_quality_factor_is_no_series_of_steady_tones() -> None:
    """The amplitude changes by less than 2 % in 200 cycles, but the decay time is 1270 cycles: as steady tones, J was
    12 % too small (16 standard deviations) and b/J 15 % too large."""
    m = AXIS.require_mechanics()
    true = replace(AXIS, mechanics=replace(m, b=np.sqrt(m.k * m.J) / 2000.0), tolerance={"C0": 1e-9, "theta0": 1e-9})
    start = settled_state(true, Plan({"x": Sine(31209.0, 8.0, 8.0)}, 0.01, 1e6, substeps=1, settle=0.5))
    plan = Plan({"x": Sweep(31209.0, 31185.0, 0.25, 8.0, 8.0)}, 0.25, 6e5, substeps=5)
    angle = simulate_trajectory(true, plan, start, 0.0, 0.25).angle[:-1:5]
    volt = plan.drives["x"](np.arange(angle.size) / 6e5)
    noisy = angle + 2e-4 * np.random.default_rng(0).standard_normal(angle.size)
    channels = {"angle_x": (noisy, "rad", 6e5, 0.0), "drive_x": (volt, "V", 6e5, 0.0)}
    found = identify([Recording.from_arrays(channels)], replace(DRIVEN, axes={"x": true})).values["x"]
    truth = {"J": m.J, "b_over_J": true.require_mechanics().b / m.J, "k_over_J": m.k / m.J}
    for key, value in truth.items():
        assert found[key].value == pytest.approx(value, abs=4.5 * found[key].sd)
        assert found[key].sd < 1e-3 * value


def test_a_linear_drive_determines_inertia_damping_and_stiffness():
    true = linear_axis(1000.0, 50.0)
    records = []
    for f in (960.0, 1030.0):
        angle, drive = driven(true, f, 0.05, 0.1, Drift())
        noisy = angle + PSD * np.random.default_rng(int(f)).standard_normal(angle.size)
        records.append(DrivenRecord(noisy, drive(np.arange(angle.size) / 1e6), f, 1e6))
    found, m = fit_mechanics(true, records), true.require_mechanics()
    for key in ("J", "b", "k"):
        assert found[key].value == pytest.approx(getattr(m, key), abs=4 * found[key].sd)
        assert found[key].sd < 1e-3 * getattr(m, key)


def test_one_drive_frequency_is_not_enough(moving):
    with pytest.raises(BadInput, match="two or more drive frequencies"):
        fit_mechanics(AXIS, moving[:1])


@pytest.mark.slow
def test_a_ringdown_determines_frequency_and_damping(decay):
    axis = sensing_axis()
    m = axis.require_mechanics()
    off = replace(axis, mechanics=replace(m, k=m.k * 1.004, b=m.b * 0.9))
    draws = []
    for seed in range(25):
        angle = decay[0] + PSD * np.random.default_rng(seed).standard_normal(decay[0].size)
        draws.append(fit_ringdown(angle, 500e3, off, 10.0)[0])
    truth = {"k_over_J": m.k / m.J, "b_over_J": m.b / m.J, "J": m.J}
    assert min(coverage(draws, truth).values()) >= 0.8
    assert np.mean([d["b_over_J"].value for d in draws]) == pytest.approx(m.b / m.J, rel=1e-3)
    assert draws[0]["J"].sd > 20 * draws[0]["k_over_J"].sd / draws[0]["k_over_J"].value * m.J


def test_a_decay_on_which_its_bias_has_no_effect_leaves_the_inertia_as_stated() -> None:
    device = load("chen2019")
    axis, time = device.axis("x"), np.arange(40_000) / 5e5
    angle = 0.15 * np.exp(-60.0 * time) * np.cos(2 * np.pi * axis.resonance * time)
    noisy = angle + 1e-4 * np.random.default_rng(0).standard_normal(time.size)
    channels = {"angle_x": (noisy, "rad", 5e5, 0.0), "bias_x": (np.full(time.size, 10.0), "V", 5e5, 0.0)}
    found = identify([Recording.from_arrays(channels, device)], device)
    assert "J" not in fit_ringdown(noisy, 5e5, axis, 10.0)[0]
    assert found.device.axis("x").require_mechanics().J == axis.require_mechanics().J
    assert any("the bias has no visible effect" in note for note in found.notes)


def with_comb_errors(axis: Axis, rng: np.random.Generator) -> Axis:
    """The axis with errors of 2 % (standard deviation) in the comb, as in a data sheet."""
    comb, tolerance = axis.require_capacitance(), {"C0": 0.02, "theta0": 0.02}
    off = 1.0 + 0.02 * rng.standard_normal(2)
    off_comb = replace(comb, C0=off[0] * comb.C0, theta0=off[1] * comb.theta0)
    return replace(axis, capacitance=off_comb, tolerance={**axis.tolerance, **tolerance})


def test_intervals_have_their_coverage_when_the_comb_is_uncertain(moving):
    m = AXIS.require_mechanics()
    draws, tolerances = [], []
    for seed in range(40):
        rng = np.random.default_rng(seed)
        recordings = [
            Recording.from_arrays(
                {
                    "angle_x": (r.angle + PSD * rng.standard_normal(r.angle.size), "rad", RATE, 0.0),
                    "drive_x": (r.voltage, "V", RATE, 0.0),
                }
            )
            for r in moving
        ]
        found = identify(recordings, replace(DRIVEN, axes={"x": with_comb_errors(AXIS, rng)}))
        draws.append(dict(found.values["x"]))
        tolerances.append([found.device.tolerance("x", key) for key in "Jbk"])
    held = coverage(draws, {"J": m.J, "b": m.b, "k": m.k})
    assert min(held.values()) >= 0.85
    assert np.mean([d["J"].sd for d in draws]) < 0.06 * m.J  # 2 % of C0, twice 2 % of theta0
    # The device keeps what does not depend on the torque's scale: the resonance, k / J.
    assert np.max(tolerances) < 0.01


def test_a_free_decay_under_bias_determines_inertia_up_to_the_comb_uncertainty(decay):
    axis = sensing_axis()
    J = axis.require_mechanics().J
    draws = []
    for seed in range(8):
        rng = np.random.default_rng(seed)
        angle = decay[0][:20000] + 1e-6 * rng.standard_normal(20000)
        channels = {"angle_x": (angle, "rad", 500e3, 0.0), "bias_x": (np.full(20000, 10.0), "V", 500e3, 0.0)}
        found = identify([Recording.from_arrays(channels)], Device("decaying", {"x": with_comb_errors(axis, rng)}))
        draws.append(dict(found.values["x"]))
    assert coverage(draws, {"J": J})["J"] >= 0.75
    assert np.mean([d["J"].sd for d in draws]) > 0.02 * J


def test_a_free_decay_without_bias_keeps_the_nominal_inertia_and_its_tolerance(decay):
    axis = replace(sensing_axis(), tolerance={"J": 0.03})
    channels = {"angle_x": (decay[0][:20000], "rad", 500e3, 0.0)}
    found = identify([Recording.from_arrays(channels)], Device("decaying", {"x": axis}))
    J, k = (found.values["x"][key] for key in "Jk")
    assert J.sd == pytest.approx(0.03 * J.value)
    assert k.sd == pytest.approx(0.03 * k.value, rel=0.01)
    assert any("J is the nominal one" in note for note in found.notes)


def test_only_mechanics_are_identified_on_a_shared_electrode(moving):
    quiet = np.random.default_rng(0).standard_normal(moving[0].angle.size)
    recordings = [
        Recording.from_arrays(
            {
                "angle_x": (r.angle, "rad", RATE, 0.0),
                "drive_x": (r.voltage, "V", RATE, 0.0),
                "sense": (quiet, "V", RATE, 0.0),
            }
        )
        for r in moving
    ]
    found = identify(recordings, DRIVEN)
    assert {"J", "b", "k"} <= set(found.values["x"])
    assert any(note.startswith("sense: the electrode is shared by both axes") for note in found.notes)


def calibration(folder) -> list:
    """Files of one rest and two driven recordings, simulated with a device that differs from the stated one."""
    m, readout = AXIS.require_mechanics(), AXIS.require_readout()
    true = replace(
        DRIVEN,
        axes={
            "x": replace(
                AXIS,
                mechanics=replace(m, J=m.J * 1.06, b=m.b * 1.1, k=m.k * 1.06),
                readout=replace(readout, a_cir=-3.7e11, b_cir=6.6),
            )
        },
    )
    paths = []
    for f in (31450.0, 31530.0):
        plan = Plan({"x": Sine(f, 30.0, 30.0)}, 0.01, RATE, settle=0.04, references=("angle",))
        recording, _ = simulate(true, plan, seed=int(f), nominal=DRIVEN)
        paths.append(folder / f"{f:.0f}.h5")
        recording.write(paths[-1])
    rng = np.random.default_rng(0)
    quiet = {"sense_x": (0.9 + 0.0139 * rng.standard_normal(50000), "V", RATE, 0.0)}
    paths.append(folder / "rest.h5")
    Recording.from_arrays(quiet, DRIVEN).write(paths[-1])
    return paths


def test_the_command_writes_a_device_closer_to_the_truth(tmp_path, capsys):
    paths = calibration(tmp_path)
    assert main(["identify", *map(str, paths), "-o", str(tmp_path / "out"), "--json"]) == 0
    summary = json.loads(capsys.readouterr().out)
    assert json.loads((tmp_path / "out" / "summary.json").read_text()) == summary
    assert "constants of" in summary["conclusion"]
    assert summary["output"] == str(tmp_path / "out")
    values = summary["axes"]["x"]["values"]
    device = Device.load(tmp_path / "out" / "device.toml")
    axis, m = device.axis("x"), AXIS.require_mechanics()
    assert pytest.approx(1.06 * m.J, rel=0.01) == axis.mechanics.J
    assert axis.mechanics.b == pytest.approx(1.1 * m.b, rel=0.01)
    assert axis.mechanics.resonance == pytest.approx(AXIS.resonance, rel=1e-4)
    assert axis.readout.a_cir == pytest.approx(-3.7e11, rel=0.01)
    assert axis.readout.b_cir == pytest.approx(6.6, rel=0.01)
    assert values["noise_var"]["ci95"][0] < 0.0139**2 < values["noise_var"]["ci95"][1]
    assert device.tolerance("x", "k") == values["k"]["tolerance"] < 0.01
    assert values["k_over_J"]["tolerance"] is None
    assert "95 % interval" in (tmp_path / "out" / "report.html").read_text(encoding="utf-8")


def test_a_recording_is_classified_as_rest_free_decay_or_driven(decay):
    n = 2000
    still, swinging = np.random.default_rng(1).standard_normal(n), np.sin(np.arange(n) / 50.0)
    rate = 1e5

    def made(**channels):
        units = {"drive": "V", "angle": "rad", "sense": "V"}
        return Recording.from_arrays({f"{k}_x": (v, units[k], rate, 0.0) for k, v in channels.items()})

    assert classify_recording(made(sense=still), "x") == "rest"
    assert classify_recording(made(angle=swinging, sense=swinging), "x") == "free decay"
    assert classify_recording(made(angle=swinging, drive=swinging), "x") == "driven"
    assert classify_recording(made(sense=swinging), "x") == "free decay without a reference angle"
    assert classify_recording(made(sense=swinging, drive=swinging), "x") == "driven motion without a reference angle"
    assert classify_recording(made(sense=still, drive=swinging), "x") is None
    assert classify_recording(made(sense=still), "y") is None
    gap = np.where(np.arange(n) == 100, np.nan, swinging)
    with pytest.raises(BadInput, match=r"drive_x: sample 100 at 0\.001 s is not finite"):
        classify_recording(made(angle=swinging, drive=gap), "x")


@pytest.mark.parametrize("channel", ["angle_x", "velocity_x", "sense_x", "bias_x"])
def test_a_sample_that_is_not_finite_is_refused_in_every_channel_that_is_read(decay, tmp_path, capsys, channel) -> None:
    """With one NaN an angle counted as without motion, and the ratios came from the sense signal alone; a sense signal
    or a bias ended with a traceback."""
    angle, sense = decay
    channels = {"angle_x": (angle, "rad"), "sense_x": (sense, "V"), "bias_x": (np.full(angle.size, 10.0), "V")}
    if channel == "velocity_x":
        channels["velocity_x"] = (np.gradient(channels.pop("angle_x")[0]) * 5e5, "rad/s")
    values, unit = channels[channel]
    channels[channel] = (np.where(np.arange(values.size) == 1000, np.nan, values), unit)
    path = tmp_path / "nan.h5"
    Recording.from_arrays({name: (*each, 5e5) for name, each in channels.items()}).write(path)
    device = tmp_path / "device.toml"
    device.write_text(Device("d", {"x": sensing_axis()}).to_toml(), encoding="utf-8")
    assert main(["identify", str(path), "--device", str(device), "-o", str(tmp_path / "out")]) == 2
    assert f"{channel}: sample 1000 at 0.002 s is not finite; cut the recording there" in capsys.readouterr().err


def test_driven_recordings_without_a_reference_angle_are_refused(tmp_path, capsys):
    path = tmp_path / "no.h5"
    swinging = np.sin(np.arange(3000) / 50.0)
    channels = {"sense_x": (swinging, "V", RATE, 0.0), "drive_x": (swinging, "V", RATE, 0.0)}
    Recording.from_arrays(channels, DRIVEN).write(path)
    assert main(["identify", str(path), "-o", str(tmp_path / "out")]) == 2
    assert "reference angle" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
    with pytest.raises(BadInput, match="no recording"):
        identify([], DRIVEN)


def test_terms_that_the_device_states_are_named_as_left_out() -> None:
    """A Duffing resonator, whose device file states its cubic stiffness: the fitted law has none."""
    linear = linear_axis(1000.0, 50.0)
    axis = replace(linear, terms={"cubic-stiffness": {"k3": 0.1 * linear.require_mechanics().k / 0.1**2}})
    plan = Plan({"x": Constant(0.0)}, 0.05, 2e5, references=("angle",))
    recording, _ = simulate(Device("d", {"x": axis}), plan, start={"x": InitialState(0.05, 0.0)}, seed=1)
    channels = {"angle_x": (recording["angle_x"].read(), "rad", 2e5)}
    for each, count in ((axis, 1), (linear, 0)):
        found = identify([Recording.from_arrays(channels)], Device("d", {"x": each}))
        assert sum("without the terms that the device states (cubic-stiffness)" in n for n in found.notes) == count


@pytest.mark.parametrize("samples_per_period", [2.3, 3.3, 4.1, 4.9])
def test_a_motion_of_few_samples_a_period_is_no_rest(samples_per_period: float) -> None:
    time, rng = np.arange(4000), np.random.default_rng(0)
    motion = np.exp(-time / 1000) * np.sin(2 * np.pi * time / samples_per_period)
    noise = rng.normal(0.0, 1e-3, time.size)
    for values, kind in ((motion + noise, "free decay without a reference angle"), (noise, "rest")):
        assert classify_recording(Recording.from_arrays({"sense_x": (values, "V", 1e4)}), "x") == kind


@pytest.mark.parametrize("softening", [0.0, 0.01])
def test_ratios_of_a_free_decay_and_of_noisy_driven_motion_are_averaged(softening: float) -> None:
    """The decay determines resonance and Q, the driven motion J; a decay of another stiffness contradicts it."""
    true = linear_axis(1000.0, 50.0)
    m = true.require_mechanics()
    changed = replace(true, mechanics=replace(m, k=(1.0 - softening) * m.k))
    plan = Plan({"x": Constant(0.0)}, 0.05, 1e5, references=("angle",))
    free, _ = simulate(Device("d", {"x": changed}), plan, start={"x": InitialState(0.05, 0.0)}, seed=1)
    noise = np.random.default_rng(0)
    quiet = free["angle_x"].read() + 1e-4 * noise.standard_normal(free["angle_x"].size)
    decay = Recording.from_arrays({"angle_x": (quiet, "rad", 1e5)})
    tones = []
    for f in (980.0, 1020.0):
        angle, drive = driven(true, f, 0.05, 0.1, Drift())
        noisy = angle + 0.005 * noise.standard_normal(angle.size)
        volt = drive(np.arange(angle.size) / 1e6)
        tones.append(Recording.from_arrays({"angle_x": (noisy, "rad", 1e6), "drive_x": (volt, "V", 1e6)}))
    alone, both = (identify(each, Device("d", {"x": true})) for each in (tones, [decay, *tones]))
    ratio = both.values["x"]["k_over_J"]
    assert ratio.value == pytest.approx((1.0 - softening) * m.k / m.J, abs=4.0 * ratio.sd)
    assert both.values["x"]["J"] == alone.values["x"]["J"]
    assert any("free decay and driven motion differ in k/J" in note for note in both.notes) == (softening > 0.0)
    if not softening:
        assert ratio.sd < 0.5 * alone.values["x"]["k_over_J"].sd
        assert both.values["x"]["k"].value == pytest.approx(ratio.value * both.values["x"]["J"].value)


def test_a_quiet_decay_of_a_high_q_has_no_bias() -> None:
    """Steps of an integration made an error of 6e-7 of k/J, ten standard deviations."""
    w, quality, rate = 2 * np.pi * 2000.0, 800.0, 1e5
    axis = Axis(Mechanics(1e-9, 1e-9 * w / 700.0, 1e-9 * w**2), name="x")
    time, z = np.arange(20_000) / rate, []
    for seed in range(6):
        angle = 0.08 * np.exp(-0.5 * w / quality * time) * np.cos(w * np.sqrt(1.0 - 0.25 / quality**2) * time)
        noisy = angle + 2e-5 * np.random.default_rng(seed).standard_normal(time.size)
        value = fit_ringdown(noisy, rate, axis)[0]["k_over_J"]
        z.append((value.value - w**2) / value.sd)
    assert abs(np.mean(z)) < 1.5
