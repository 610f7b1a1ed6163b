"""The diagnosis on small recordings made by another integrator (scipy's), and the commands around it."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from itertools import accumulate
from pathlib import Path

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.interpolate import CubicSpline

from estimation.mismatch.diagnosis import diagnose
from estimation.mismatch.experiment import between, experiment, is_steady, strongest_line, thinned
from estimation.mismatch.fit import Comparison, solve
from estimation.mismatch.free import FREE
from estimation.mismatch.instead import instead
from estimation.mismatch.lines import strongest_foreign_line
from estimation.mismatch.model import Candidate, Model
from estimation.mismatch.noise import noise_psd, whitener
from estimation.mismatch.screen import all_candidates
from estimation.mismatch.start import first_whiteners, grown, measured_whiteners, started, windows
from recon.cli import main
from scanner.device import Axis, Device, Drive, Mechanics, Position
from scanner.recording import Recording
from scanner.terms import catalogue

F0, RATE, N = 500.0, 40e3, 8000
K = 1e-12 * (2 * np.pi * F0) ** 2
DEVICE = Device(
    "bench",
    {
        "x": Axis(
            Mechanics(1e-12, 1e-12 * 2 * np.pi * F0 / 40, K),
            drive=Drive("linear", 1e-9),
            readout=Position(20.0, 2e-3),
            tolerance={"k": 0.01, "b": 0.1, "torque_per_volt": 0.05, "gain": 0.03},
            name="x",
        )
    },
)


@cache
def signals(k3: float, b2: float, shaken: float = 0.0, stop: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """Drive voltage and angle of a device a little off its nominal values, driven by a multisine.

    ``shaken``: share of the stiffness that goes up and down, six times over the recording. ``stop``: share of it that a
    spring adds beyond 1 mrad, on one side.
    """
    rng = np.random.default_rng(5)
    lines, phases = 30.0 + 62.5 * np.arange(14), rng.uniform(0, 2 * np.pi, 14)

    def voltage(t):  # type: ignore[no-untyped-def]
        return 1.5 * np.sin(2 * np.pi * np.multiply.outer(t, lines) + phases).sum(-1)

    J, b, k = 1e-12, 1.05 * DEVICE.axis("x").mechanics.b, 1.004 * K

    def rates(t, s):  # type: ignore[no-untyped-def]
        stiff = k * (1 + shaken * np.cos(2 * np.pi * 6 * t * RATE / N))
        spring = stiff * s[0] + k3 * s[0] ** 3 + stop * k * max(s[0] - 1e-3, 0.0)
        return [s[1], (1e-9 * voltage(t) - b * s[1] - spring - b2 * abs(s[1]) * s[1]) / J]

    time = np.arange(N) / RATE
    done = solve_ivp(rates, (0, time[-1]), [1e-4, 0.5], "DOP853", time, rtol=1e-9, atol=1e-12, max_step=1e-4)
    return voltage(time), done.y[0]


def recording(k3: float = 0.0, b2: float = 0.0, seed: int = 0, coloured: bool = False, **change: float) -> Recording:
    drive, angle = signals(k3, b2, change.get("shaken", 0.0), change.get("stop", 0.0))
    if "late" in change:  # seconds at a swing of 1 mrad, and as its square
        time = np.arange(N) / RATE
        square = angle**2 + (np.gradient(angle, 1 / RATE) / (2 * np.pi * F0)) ** 2
        if "memory" in change:  # seconds
            kept = change["memory"] * RATE
            square = np.array(list(accumulate(square, lambda held, now: held + (now - held) / kept)))
        angle = CubicSpline(time, angle)(time - change["late"] * square / 1e-6)
    if "play" in change:  # half-width in radians of a play through which two fifths of the signal go
        follower = accumulate(angle, lambda held, now: float(np.clip(held, now - change["play"], now + change["play"])))
        angle = 0.6 * angle + 0.4 * np.array(list(follower))
    rng = np.random.default_rng(seed)
    noise = rng.normal(0, 2e-3, N)
    if coloured:
        from scipy.signal import lfilter

        slow = lfilter([1.0], [1.0, -0.95], rng.normal(0, 1e-3, N))
        noise = noise + slow + 1e-3 * np.cos(2 * np.pi * 50 * np.arange(N) / RATE + 1.0)
    sense = 20.0 * angle * (1 + change.get("gain", 0.0) * np.arange(N) / N) + noise
    sense += change.get("drift", 0.0) * np.cos(np.pi * np.arange(N) / N)
    sense += change.get("hum", 0.0) * np.cos(2 * np.pi * 50 * np.arange(N) / RATE + 1.0)
    sense = np.clip(sense, -change.get("limit", np.inf), change.get("limit", np.inf))
    channels = {"drive_x": (drive, "V", RATE, 0.0), "sense_x": (sense, "V", RATE, 0.0)}
    return Recording.from_arrays(channels, device=DEVICE, name="bench <b>")


@pytest.mark.parametrize(("seed", "coloured"), [(1, False), (2, False), (3, True), (4, True)])
def test_nothing_is_found_where_nothing_is_missing(seed: int, coloured: bool) -> None:
    found = diagnose([recording(seed=seed, coloured=coloured)])
    assert (found.verdict, found.findings, found.unexplained) == ("consistent", (), None)
    assert found.search.final.held_chi2 == pytest.approx(1.0, abs=0.15)


def test_a_cubic_spring_is_named_with_an_interval_that_holds_it() -> None:
    size = np.abs(signals(0.0, 0.0)[1]).max()
    k3 = 0.06 * K / size**2
    found = diagnose([recording(k3=k3, seed=6)])
    (finding,) = found.findings
    assert (finding.effect, finding.stage, finding.axis) == ("cubic-stiffness", "mechanics", "x")
    low, high = finding.parameters[0].ci95
    assert low < k3 < high
    assert high - low < 0.4 * k3
    assert finding.heldout["after"] < 1.1 < finding.heldout["before"]
    assert found.device.axis("x").terms["cubic-stiffness"]["k3"] == finding.parameters[0].value


def test_the_improved_device_is_consistent_with_its_own_recording() -> None:
    size = np.abs(signals(0.0, 0.0)[1]).max()
    made = recording(k3=0.06 * K / size**2, seed=7)
    improved = diagnose([made]).device
    again = diagnose([made], Device.from_toml(improved.to_toml()))
    assert again.verdict == "consistent"


def test_a_readout_gain_that_drifts_is_placed_in_the_readout() -> None:
    found = diagnose([recording(gain=0.1, seed=8)])
    assert [(f.effect, f.stage) for f in found.findings] == [("gain-drift", "readout")]
    assert found.findings[0].parameters[0].value == pytest.approx(0.1, rel=0.15)


def test_a_drifting_baseline_is_neither_hum_nor_slow_noise() -> None:
    """Hum of both mains at once takes after it, and what they leave passes for noise that would excuse it."""
    told = diagnose([recording(drift=0.03, seed=8)])
    assert [(each.effect, each.stage) for each in told.findings] == [("offset-drift", "readout")]
    low, high = told.findings[0].parameters[0].ci95
    assert low < 0.03 < high


def test_hum_is_clipped_with_the_signal() -> None:
    """Hum behind the clip left what interference or a drifting offset before it explains: two findings for one."""
    size = 20.0 * np.abs(signals(0.0, 0.0)[1]).max()
    told = diagnose([recording(limit=0.6 * size, hum=2e-3, seed=9)])
    assert [each.effect for each in told.findings] == ["saturation"]
    (limit,) = told.findings[0].parameters
    assert limit.ci95[0] < 0.6 * size < limit.ci95[1]
    assert told.search.final.held_chi2 == pytest.approx(1.0, abs=0.15)


def test_the_nominal_fit_finds_the_values_within_their_errors() -> None:
    made = recording(seed=9)
    run = experiment(made, DEVICE)
    model = Model([run], DEVICE)
    comparison = Comparison([run], first_whiteners(model))
    stops = windows(model)
    fit = grown(comparison, model, started(comparison, model, stops[0]).x, stops)[-1]
    axis = model.nominal("x", fit.x)
    assert axis.resonance / F0 == pytest.approx(np.sqrt(1.004), abs=2e-4)
    assert axis.quality == pytest.approx(40 / 1.05 * np.sqrt(1.004), rel=0.01)


def test_what_is_made_ahead_is_what_is_asked_for() -> None:
    run = experiment(recording(seed=9), DEVICE)
    candidate = Candidate(catalogue()["second-mode"], "x", "sense")
    ahead, model = (Model([run], DEVICE, [candidate]) for _ in range(2))
    points = np.random.default_rng(0).normal(0.0, 0.3, (11, len(model.free)))
    ahead.prepare(list(points), 0.5)
    assert len(ahead._ready) == len(points)
    for x in points:
        np.testing.assert_array_equal(ahead.outputs(x, 0.5)[0][0], model.outputs(x, 0.5)[0][0])
    assert not ahead._ready


def test_half_the_step_changes_less_than_a_tenth_of_the_noise() -> None:
    made = recording(seed=10)
    values = []
    for finer in (1, 2):
        run = experiment(made, DEVICE, finer=finer)
        model = Model([run], DEVICE)
        x = np.zeros(len(model.free))
        x[[i for i, f in enumerate(model.free) if f.kind == "start"]] = 0.1
        values.append(model.outputs(x)[0][0])
    n = min(v.size for v in values)
    assert np.abs(values[0][:n] - values[1][:n]).max() < 0.1 * 2e-3


def test_whitened_noise_is_white_and_of_unit_size() -> None:
    from scipy.signal import lfilter

    rng = np.random.default_rng(11)
    noise = lfilter([1.0], [1.0, -0.9], rng.normal(0, 0.1, 20000))
    psd, _ = noise_psd(noise, 8001, 1e-4, [100.0], 5.0)
    white = whitener(psd, noise.size, (20, 20))(noise)
    assert white.std() == pytest.approx(1.0, abs=0.03)
    assert abs(np.corrcoef(white[:-1], white[1:])[0, 1]) < 0.05


def test_a_strong_drift_leaves_the_measured_noise_as_it_is() -> None:
    """Through the window alone it raised the noise of the ten slowest bins a hundredfold, and passed for it."""
    noise = np.random.default_rng(12).normal(0.0, 1.0, 4000)
    turn = np.pi * (np.arange(4000) + 0.5) / 4000
    drift = 300.0 * np.cos(turn) - 100.0 * np.cos(2 * turn) + 200.0 * np.cos(3 * turn)
    still, _ = noise_psd(noise, 2001, 1e-4, [100.0], 5.0)
    drifting, _ = noise_psd(noise + drift, 2001, 1e-4, [100.0], 5.0)
    np.testing.assert_allclose(drifting, still, rtol=1e-6)
    settling = 300.0 * np.exp(-turn / (0.3 * np.pi))  # no sum of a few cosines: through the window alone 14 times
    drifting, _ = noise_psd(noise + settling, 2001, 1e-4, [100.0], 5.0)
    assert (drifting[9:] / still[9:]).max() < 2.0


def test_the_ends_of_red_noise_are_as_white_as_its_middle() -> None:
    """A step from noise to nothing would be lifted above the noise by the whitening, and pass for a drift."""
    from scipy.signal import lfilter

    n, guard = 4000, (25, 25)
    rng = np.random.default_rng(8)
    frequency = np.arange(n // 2 + 1) / n
    psd = n / np.abs(1.0 - 0.998 * np.exp(-2j * np.pi * frequency)) ** 2
    whiten = whitener(psd, n, guard)
    ends = [
        whiten(lfilter([1.0], [1.0, -0.998], rng.normal(size=3 * n))[-n:])[whiten.keep][[0, 1, -2, -1]]
        for _ in range(200)
    ]
    assert np.mean(np.square(ends)) == pytest.approx(1.0, abs=0.15)


def test_slow_noise_is_excused_as_far_as_a_steeper_spectrum_explains_it() -> None:
    n = 4000
    white = np.random.default_rng(5).normal(0.0, 1.0, n)
    turn = 2 * np.pi * np.arange(n) / n
    whiten = whitener(np.full(n // 2 + 1, float(n)), n, (0, 0), first=10.0)
    slow, measured = 4.0 * np.sqrt(2 / n) * np.cos(turn), 4.0 * np.sqrt(2 / n) * np.cos(12 * turn)
    assert whiten.excused(white) < 2.0
    assert whiten.excused(white + measured) < 2.0
    excused = whiten.excused(white + slow)  # sixteen in chi-square are there to be excused
    assert 4.0 < excused < 16.0
    assert whiten.excused(white + 10.0 * slow) < 0.99 * 1600.0  # and never all of a large drift
    assert replace(whiten, first=0.0).excused(white + slow) == 0.0


def test_red_noise_is_measured_between_the_lines_of_a_multisine() -> None:
    from scipy.signal import lfilter

    noise = lfilter([1.0], [1.0, -0.95], np.random.default_rng(3).normal(0, 1e-3, N))
    run = experiment(recording(), DEVICE)
    model = Model([run], DEVICE)
    x = np.zeros(len(model.free))
    data = model.outputs(x)[0][0] + noise[: run.outputs[0].data.size]
    noisy = replace(run, outputs=(replace(run.outputs[0], data=data),))
    whiten = measured_whiteners(Model([noisy], DEVICE), x)[0][0]
    white = whiten(noise[: data.size])
    slow = np.abs(np.fft.rfft(white))[2:100] ** 2 / white.size  # below 500 Hz, where lines stand every 62.5 Hz
    assert 0.6 < slow.mean() < 1.3


def test_thinning_leaves_the_compared_band_as_it_is() -> None:
    t = np.arange(20_000)
    for f in (0.02, 0.1, 0.3):  # of the thinned rate; 0.35 is the highest that is compared
        shown = thinned(np.sin(2 * np.pi * f / 4 * t), 4)[50:-50]
        assert np.abs(shown - np.sin(2 * np.pi * f / 4 * t[::4])[50:-50]).max() < 1e-4


def test_two_effects_are_found_around_a_free_correction() -> None:
    """Around a fit that follows the motion, first order tells which two named terms would do the same."""
    size = np.abs(signals(0.0, 0.0)[1]).max()
    run = experiment(recording(k3=0.06 * K / size**2, gain=0.15, seed=4), DEVICE)
    nominal = Model([run], DEVICE)
    comparison = Comparison([run], first_whiteners(nominal))
    stops = windows(nominal)
    early = grown(comparison, nominal, started(comparison, nominal, stops[0]).x, stops)[-1]
    free = Candidate(FREE["free-mechanics"], "x", "sense")
    model = Model([run], DEVICE, [free], nominal.mains)
    stood_in = solve(comparison, model, model.embed(early.model, early.x), turns=20)
    pool = [c for c in all_candidates(DEVICE, nominal, catalogue().values()) if not c.channel.startswith("angle")]
    best = instead(comparison, stood_in, [free], pool, pairs=True)[0]
    assert {each.term.effect for each in best.model.candidates} == {"cubic-stiffness", "gain-drift"}
    assert best.evidence < stood_in.evidence - 100.0


def test_a_tone_among_the_lines_of_a_multisine_is_seen() -> None:
    """A multisine of many lines leaves hardly a bin clear of them, a tone next to one of them least of all."""
    rng = np.random.default_rng(7)
    time, lines = np.arange(N) / RATE, 20.0 + 15.0 * np.arange(80)
    drive = 0.3 * np.sin(2 * np.pi * np.multiply.outer(time, lines) + rng.uniform(0, 2 * np.pi, 80)).sum(-1)
    channels = {"drive_x": (drive, "V", RATE, 0.0), "sense_x": (rng.normal(0, 2e-3, N), "V", RATE, 0.0)}
    run = experiment(Recording.from_arrays(channels, device=DEVICE, name="tone"), DEVICE)
    model = Model([run], DEVICE)
    moved = model.outputs(np.zeros(len(model.free)))[0][0]
    wave = np.cos(2 * np.pi * 336.0 * run.outputs[0].step * np.arange(moved.size))
    for tone, seen in ((0.0, False), (5e-3, True)):
        data = moved + rng.normal(0, 2e-3, moved.size) + tone * wave
        told = Model([replace(run, outputs=(replace(run.outputs[0], data=data),))], DEVICE)
        comparison = Comparison(told.runs, first_whiteners(told))
        line = strongest_foreign_line(solve(comparison, told, np.zeros(len(told.free)), turns=1))
        assert (line is not None and abs(line - 336.0) < 3.0) == seen


@pytest.mark.parametrize("seconds", [0.005, 0.02, 0.3])  # 5e3 to 3e5 samples: more than a line is looked for in
@pytest.mark.parametrize(
    ("drive", "steady"),
    [
        (lambda t: np.sin(2 * np.pi * 27680.37 * t), True),
        (lambda t: 20.0 * (np.sin(2 * np.pi * 27680.37 * t) > 0.0), True),
        (lambda t: 20.0 * ((27680.37 * t) % 1.0 < 0.25), True),
        (lambda t: np.sin(2 * np.pi * (27000.0 + 4000.0 * t / t[-1]) * t), False),
        (lambda t: sum(np.cos(2 * np.pi * f * t + f) for f in np.linspace(22e3, 33e3, 23)), False),
        (lambda t: np.random.default_rng(1).standard_normal(t.size), False),
    ],
    ids=["sine", "square", "pulses", "sweep", "multisine", "noise"],
)
def test_a_tone_is_told_from_a_sweep_however_long(
    drive: Callable[[np.ndarray], np.ndarray], steady: bool, seconds: float
) -> None:
    values = drive(np.arange(0.0, seconds, 1e-6))
    assert is_steady(strongest_line(values, 1e6), values, 1e6) == steady


def test_a_jump_stays_sharp_and_a_sine_is_exact_between_samples() -> None:
    at = np.arange(0.0, 900.0, 0.5)
    step = np.repeat([1.0, 3.0], 500)
    assert set(between(step, at)) == {1.0, 3.0}
    sine = np.sin(0.9 * np.arange(1000))
    np.testing.assert_allclose(between(sine, at)[100:], np.sin(0.9 * at)[100:], atol=2e-3)


def test_the_commands_write_what_the_contract_says(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    size = np.abs(signals(0.0, 0.0)[1]).max()
    file = tmp_path / "bench.h5"
    recording(k3=0.06 * K / size**2, seed=12).write(file)
    assert main(["diagnose", str(file), "-o", str(tmp_path / "out"), "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    written = json.loads((tmp_path / "out" / "diagnosis.json").read_text())
    assert written["schema"] == "lissajous-diagnosis/1"
    assert written["verdict"] == told["verdict"] == "mismatch"
    (finding,) = written["findings"]
    assert set(finding) >= {
        "axis",
        "stage",
        "effect",
        "equation",
        "parameters",
        "where",
        "probability",
        "rivals",
        "heldout",
    }
    assert set(finding["parameters"][0]) == {"name", "value", "ci95", "unit"}
    assert written["unexplained"] is None
    report = (tmp_path / "out" / "report.html").read_text()
    assert "bench &lt;b&gt;" in report
    assert "bench <b>" not in report

    errors = {}
    for name, device in (("nominal", []), ("improved", ["--device", str(tmp_path / "out" / "device.toml")])):
        assert main(["predict", str(file), "-o", str(tmp_path / name), *device, "--json"]) == 0
        errors[name] = json.loads(capsys.readouterr().out)["channels"]["sense_x"]["rmse"]
        with Recording.open(tmp_path / name / "predicted.h5") as predicted:
            assert predicted["sense_x"].size == N
    assert errors["improved"] < 1.1 * 2e-3 < 2 * errors["improved"] < errors["nominal"]


@pytest.mark.parametrize(
    ("drop", "complaint"),
    [("drive_x", "linear drive"), ("sense_x", "no channel that the device could be held against")],
)
def test_what_is_missing_is_said_in_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], drop: str, complaint: str
) -> None:
    whole = recording(seed=13)
    channels = {n: (c.read(), c.unit, c.sample_rate, c.start) for n, c in whole.channels.items() if n != drop}
    file = tmp_path / "part.h5"
    Recording.from_arrays(channels, device=DEVICE).write(file)
    assert main(["diagnose", str(file), "-o", str(tmp_path / "out")]) == 2
    error = capsys.readouterr().err.strip().splitlines()[-1]
    assert complaint in error
    assert str(file) in error
    assert not (tmp_path / "out").exists()
