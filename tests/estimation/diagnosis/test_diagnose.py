"""The diagnosis of short recordings simulated with scipy's integrator, and the commands that use it."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from estimation.candidate_terms.discrepancy import DISCREPANCY_TERMS
from estimation.candidate_terms.linearisation import linear_model
from estimation.candidate_terms.screening import all_candidates
from estimation.device_fit.data import prepare_run
from estimation.device_fit.drive_lines import is_steady, strongest_line
from estimation.device_fit.fit import Likelihood, fit_model
from estimation.device_fit.initial import (
    estimate_whiteners,
    fit_progressively,
    flat_whiteners,
    window_schedule,
)
from estimation.device_fit.model import Model
from estimation.device_fit.noise import Whitener, make_whitener, noise_psd
from estimation.device_fit.parameters import Candidate
from estimation.device_fit.resampling import decimate, resample_drive
from estimation.device_fit.slow_noise import gain_of_steeper_noise
from estimation.diagnosis.diagnose import diagnose
from recon.cli import main
from scanner.arrays import Array
from scanner.device import Device
from scanner.recording import Recording
from scanner.terms import catalogue
from tests.support.bench import DEVICE, RESONANCE_HZ, SAMPLES, STIFFNESS, bench_recording, bench_signals


@pytest.mark.slow
@pytest.mark.parametrize(("seed", "coloured"), [(1, False), (2, False), (3, True), (4, True)])
def test_a_complete_model_is_consistent_and_has_no_findings(seed: int, coloured: bool) -> None:
    diagnosis = diagnose([bench_recording(seed=seed, coloured=coloured)])
    assert (diagnosis.verdict, diagnosis.findings, diagnosis.unexplained) == ("consistent", (), None)
    assert diagnosis.search.final.validation_chi2 == pytest.approx(1.0, abs=0.15)


@pytest.mark.slow
def test_a_cubic_spring_is_found_and_its_interval_contains_the_true_value() -> None:
    size = np.abs(bench_signals(0.0, 0.0)[1]).max()
    k3 = 0.06 * STIFFNESS / size**2
    diagnosis = diagnose([bench_recording(k3=k3, seed=6)])
    (finding,) = diagnosis.findings
    assert (finding.effect, finding.stage, finding.axis) == ("cubic-stiffness", "mechanics", "x")
    low, high = finding.parameters[0].ci95
    assert low < k3 < high
    assert high - low < 0.4 * k3
    assert finding.heldout["after"] < 1.1 < finding.heldout["before"]
    assert diagnosis.device.axis("x").terms["cubic-stiffness"]["k3"] == finding.parameters[0].value


@pytest.mark.slow
def test_the_improved_device_is_consistent_with_its_own_recording() -> None:
    size = np.abs(bench_signals(0.0, 0.0)[1]).max()
    made = bench_recording(k3=0.06 * STIFFNESS / size**2, seed=7)
    improved = diagnose([made]).device
    again = diagnose([made], Device.from_toml(improved.to_toml()))
    assert again.verdict == "consistent"


@pytest.mark.slow
def test_a_gain_drift_is_found_in_the_readout() -> None:
    diagnosis = diagnose([bench_recording(gain_drift=0.1, seed=8)])
    assert [(finding.effect, finding.stage) for finding in diagnosis.findings] == [("gain-drift", "readout")]
    assert diagnosis.findings[0].parameters[0].value == pytest.approx(0.1, rel=0.15)


@pytest.mark.slow
def test_an_offset_drift_is_not_reported_as_hum_or_noise() -> None:
    """Hum at both mains frequencies approximates the drift, and the remainder can be fitted as coloured noise."""
    diagnosis = diagnose([bench_recording(offset_drift=0.03, seed=8)])
    assert [(finding.effect, finding.stage) for finding in diagnosis.findings] == [("offset-drift", "readout")]
    low, high = diagnosis.findings[0].parameters[0].ci95
    assert low < 0.03 < high


@pytest.mark.slow
def with_hum(amplitudes: Sequence[float]) -> Recording:
    """A recording of the bench without an effect, with harmonics of 50 Hz in its sense channel [V]."""
    recording = bench_recording(seed=9)
    sense = recording["sense_x"]
    time = np.arange(sense.size) / sense.sample_rate
    hum = sum(a * np.cos(2 * np.pi * 50.0 * n * time + n) for n, a in enumerate(amplitudes, 1))
    return recording.with_channel(replace(sense, raw=sense.read() + hum, gain=1.0, offset=0.0))


def test_hum_stronger_than_the_noise_is_stated_and_no_effect() -> None:
    noise_sd, amplitudes = 2e-3, (1.5e-2, 2e-3, 5e-3, 1e-3, 3e-3)
    diagnosis = diagnose([with_hum(amplitudes)])
    assert diagnosis.verdict == "consistent"
    (of,) = diagnosis.hum.values()
    assert of["frequency"] == pytest.approx(50.0, abs=0.05)
    assert of["rms"] == pytest.approx(np.hypot.reduce(amplitudes) / 2**0.5, rel=0.03)
    assert of["relative"] == pytest.approx(of["rms"] / noise_sd)


def test_a_tone_at_the_frequency_of_the_mains_is_interference() -> None:
    assert [finding.effect for finding in diagnose([with_hum((1.5e-2,))]).findings] == ["interference"]


def test_hum_is_clipped_together_with_the_signal() -> None:
    """Hum added after the clipping would leave a residual that interference or an offset drift explains."""
    size = 20.0 * np.abs(bench_signals(0.0, 0.0)[1]).max()
    diagnosis = diagnose([bench_recording(clip_level=0.6 * size, hum=2e-3, seed=9)])
    assert [finding.effect for finding in diagnosis.findings] == ["saturation"]
    (limit,) = diagnosis.findings[0].parameters
    assert limit.ci95[0] < 0.6 * size < limit.ci95[1]
    assert diagnosis.search.final.validation_chi2 == pytest.approx(1.0, abs=0.15)


def test_the_nominal_fit_recovers_resonance_and_quality() -> None:
    made = bench_recording(seed=9)
    run = prepare_run(made, DEVICE)
    model = Model([run], DEVICE)
    likelihood = Likelihood([run], flat_whiteners(model))
    stops = window_schedule(model)
    fit = fit_progressively(likelihood, model, stops)[-1]
    axis = model.nominal("x", fit.x)
    assert axis.resonance / RESONANCE_HZ == pytest.approx(np.sqrt(1.004), abs=2e-4)
    assert axis.quality == pytest.approx(40 / 1.05 * np.sqrt(1.004), rel=0.01)


def test_outputs_prepared_in_advance_equal_outputs_computed_on_demand() -> None:
    run = prepare_run(bench_recording(seed=9), DEVICE)
    candidate = Candidate(catalogue()["second-mode"], "x", "sense")
    ahead, model = (Model([run], DEVICE, [candidate]) for _ in range(2))
    points = np.random.default_rng(0).normal(0.0, 0.3, (11, len(model.parameters)))
    ahead.prefetch_trajectories(list(points), 0.5)
    assert len(ahead._trajectories._prefetched) == len(points)
    for x in points:
        np.testing.assert_array_equal(ahead.outputs(x, 0.5)[0][0], model.outputs(x, 0.5)[0][0])
    assert not ahead._trajectories._prefetched


def test_halving_the_integration_step_changes_outputs_by_less_than_a_tenth_of_the_noise() -> None:
    made = bench_recording(seed=10)
    values = []
    for finer in (1, 2):
        run = prepare_run(made, DEVICE, oversample=finer)
        model = Model([run], DEVICE)
        x = np.zeros(len(model.parameters))
        x[[i for i, f in enumerate(model.parameters) if f.kind == "start"]] = 0.1
        values.append(model.outputs(x)[0][0])
    n = min(v.size for v in values)
    assert np.abs(values[0][:n] - values[1][:n]).max() < 0.1 * 2e-3


def test_whitened_noise_is_white_with_unit_variance() -> None:
    from scipy.signal import lfilter

    rng = np.random.default_rng(11)
    noise = lfilter([1.0], [1.0, -0.9], rng.normal(0, 0.1, 20000))
    psd, _ = noise_psd(noise, 8001, 1e-4, [100.0], 5.0)
    white = make_whitener(psd, noise.size, (20, 20))(noise)
    assert white.std() == pytest.approx(1.0, abs=0.03)
    assert abs(np.corrcoef(white[:-1], white[1:])[0, 1]) < 0.05


def test_a_strong_drift_does_not_change_the_noise_estimate() -> None:
    """A window alone does not suppress it: the noise in the ten lowest bins would be a hundred times too large."""
    noise = np.random.default_rng(12).normal(0.0, 1.0, 4000)
    turn = np.pi * (np.arange(4000) + 0.5) / 4000
    drift = 300.0 * np.cos(turn) - 100.0 * np.cos(2 * turn) + 200.0 * np.cos(3 * turn)
    still, _ = noise_psd(noise, 2001, 1e-4, [100.0], 5.0)
    drifting, _ = noise_psd(noise + drift, 2001, 1e-4, [100.0], 5.0)
    np.testing.assert_allclose(drifting, still, rtol=1e-6)
    settling = 300.0 * np.exp(-turn / (0.3 * np.pi))  # not a sum of a few cosines; a window alone gives a factor of 14
    drifting, _ = noise_psd(noise + settling, 2001, 1e-4, [100.0], 5.0)
    assert (drifting[9:] / still[9:]).max() < 2.0


def test_red_noise_is_whitened_at_the_ends_too() -> None:
    """Whitening would amplify a step from noise to zero at the ends above the noise, like a drift."""
    from scipy.signal import lfilter

    n, guard = 4000, (25, 25)
    rng = np.random.default_rng(8)
    frequency = np.arange(n // 2 + 1) / n
    psd = n / np.abs(1.0 - 0.998 * np.exp(-2j * np.pi * frequency)) ** 2
    whiten = make_whitener(psd, n, guard)
    ends = [
        whiten(lfilter([1.0], [1.0, -0.998], rng.normal(size=3 * n))[-n:])[whiten.keep][[0, 1, -2, -1]]
        for _ in range(200)
    ]
    assert np.mean(np.square(ends)) == pytest.approx(1.0, abs=0.15)


def test_the_variance_of_white_noise_is_that_of_all_frequencies_whatever_band_is_compared() -> None:
    n, variance = 1000, 4.0
    for bins in (501, 300, 100):
        whitener = make_whitener(np.full(bins, n * variance), n, (0, 0))
        assert whitener.noise_variance == pytest.approx(variance, rel=0.01)
        assert whitener.measured_noise_variance == pytest.approx(variance, rel=0.01)


def test_the_measured_variance_of_noise_has_no_extrapolated_level() -> None:
    n, psd = 1000, np.full(501, 4000.0)
    psd[:10] = 4e6
    whitener = make_whitener(psd, n, (0, 0), first=10.0)
    assert whitener.measured_noise_variance == pytest.approx(4.0, rel=0.01)
    assert whitener.noise_variance == pytest.approx(4.0 + 2.0 * 10 * 4e6 / n**2, rel=0.01)


def test_low_frequency_misfit_is_attributed_to_noise_as_far_as_a_steeper_spectrum_explains_it() -> None:
    n = 4000
    white = np.random.default_rng(5).normal(0.0, 1.0, n)
    turn = 2 * np.pi * np.arange(n) / n
    whitener = make_whitener(np.full(n // 2 + 1, float(n)), n, (0, 0), first=10.0)
    slow, measured = 4.0 * np.sqrt(2 / n) * np.cos(turn), 4.0 * np.sqrt(2 / n) * np.cos(12 * turn)

    def gain(residual: Array, *sensitivities: Array, whitener: Whitener = whitener) -> float:
        columns = np.column_stack([*sensitivities, residual])
        precision, x = np.full(len(sensitivities), 1e-4), np.zeros(len(sensitivities))
        return gain_of_steeper_noise([whitener], columns, np.ones(n, bool), precision, x)

    assert gain(white) < 2.0
    assert gain(white + measured) < 2.0
    assert 4.0 < gain(white + slow) < 16.0  # the slow cosine adds 16 to chi-square
    assert gain(white + 10.0 * slow) < 0.99 * 1600.0  # a large drift is never attributed to noise entirely
    assert gain(white + slow, whitener=replace(whitener, first=0.0)) == 0.0
    assert gain(white + slow, slow) < 2.0  # nothing is left beside a drift that is fitted


def test_red_noise_is_measured_between_the_lines_of_a_multisine() -> None:
    from scipy.signal import lfilter

    noise = lfilter([1.0], [1.0, -0.95], np.random.default_rng(3).normal(0, 1e-3, SAMPLES))
    run = prepare_run(bench_recording(), DEVICE)
    model = Model([run], DEVICE)
    x = np.zeros(len(model.parameters))
    data = model.outputs(x)[0][0] + noise[: run.outputs[0].data.size]
    noisy = replace(run, outputs=(replace(run.outputs[0], data=data),))
    whiten = estimate_whiteners(Model([noisy], DEVICE), x)[0][0]
    white = whiten(noise[: data.size])
    slow = np.abs(np.fft.rfft(white))[2:100] ** 2 / white.size  # below 500 Hz; the lines are 62.5 Hz apart
    assert 0.6 < slow.mean() < 1.3


def test_decimation_preserves_the_compared_band() -> None:
    t = np.arange(20_000)
    for f in (0.02, 0.1, 0.3):  # relative to the decimated rate; frequencies up to 0.35 are compared
        shown = decimate(np.sin(2 * np.pi * f / 4 * t), 4)[50:-50]
        assert np.abs(shown - np.sin(2 * np.pi * f / 4 * t[::4])[50:-50]).max() < 1e-4


@pytest.mark.slow
def test_a_pair_of_laws_is_selected_around_a_discrepancy() -> None:
    """Around a fit with a free torque, the linear model has the pair of named laws that replaces it."""
    size = np.abs(bench_signals(0.0, 0.0)[1]).max()
    run = prepare_run(bench_recording(k3=0.06 * STIFFNESS / size**2, gain_drift=0.15, seed=4), DEVICE)
    nominal = Model([run], DEVICE)
    likelihood = Likelihood([run], flat_whiteners(nominal))
    stops = window_schedule(nominal)
    early = fit_progressively(likelihood, nominal, stops)[-1]
    free = Candidate(DISCREPANCY_TERMS["free-mechanics"], "x", "sense")
    model = Model([run], DEVICE, [free], nominal.mains)
    free_fit = fit_model(likelihood, model, model.map_parameters_from(early.model, early.x), max_iterations=20)
    pool = all_candidates(nominal, [*catalogue().values(), *DISCREPANCY_TERMS.values()])
    linear = linear_model(likelihood, free_fit, [c for c in pool if not c.channel.startswith("angle")])
    assert linear.effects(linear.select().laws) == {("x", "cubic-stiffness"), ("x", "gain-drift")}


@pytest.mark.parametrize("seconds", [0.005, 0.02, 0.3])  # 3e5 samples are more than the line search uses
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
def test_a_steady_drive_is_distinguished_from_a_sweep_at_any_length(
    drive: Callable[[np.ndarray], np.ndarray], steady: bool, seconds: float
) -> None:
    values = drive(np.arange(0.0, seconds, 1e-6))
    assert is_steady(strongest_line(values, 1e6), values, 1e6) == steady


def test_interpolation_keeps_steps_sharp_and_sines_exact() -> None:
    at = np.arange(0.0, 900.0, 0.5)
    step = np.repeat([1.0, 3.0], 500)
    assert set(resample_drive(step, at)) == {1.0, 3.0}
    sine = np.sin(0.9 * np.arange(1000))
    np.testing.assert_allclose(resample_drive(sine, at)[100:], np.sin(0.9 * at)[100:], atol=2e-3)


@pytest.mark.slow
def test_diagnose_and_predict_write_the_documented_files_and_keys(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    size = np.abs(bench_signals(0.0, 0.0)[1]).max()
    file = tmp_path / "bench.h5"
    bench_recording(k3=0.06 * STIFFNESS / size**2, seed=12).write(file)
    assert main(["diagnose", str(file), "-o", str(tmp_path / "out"), "--json"]) == 0
    answer = json.loads(capsys.readouterr().out)
    written = json.loads((tmp_path / "out" / "diagnosis.json").read_text())
    assert written["schema"] == "lissajous-diagnosis/1"
    assert written["verdict"] == answer["verdict"] == "mismatch"
    assert written["conclusion"].startswith("The nominal device lacks cubic-stiffness in the mechanics of axis x")
    assert written["conclusion"].split(". ")[0] in (tmp_path / "out" / "report.html").read_text(encoding="utf-8")
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
    assert f"<td>{finding['share']:.1%}</td>" in report
    loops = written["open_loop"]["sense_x"].values()
    assert all(f"<td>{loop['rmse']:.3g} ({loop['fraction']:.1%})</td>" in report for loop in loops)

    errors = {}
    for name, device in (("nominal", []), ("improved", ["--device", str(tmp_path / "out" / "device.toml")])):
        assert main(["predict", str(file), "-o", str(tmp_path / name), *device, "--json"]) == 0
        errors[name] = json.loads(capsys.readouterr().out)["channels"]["sense_x"]["rmse"]
        with Recording.open(tmp_path / name / "predicted.h5") as predicted:
            assert predicted["sense_x"].size == SAMPLES
    assert errors["improved"] < 1.1 * 2e-3 < 2 * errors["improved"] < errors["nominal"]


@pytest.mark.parametrize(
    ("drop", "complaint"),
    [("drive_x", "linear drive"), ("sense_x", "no channel that the device can simulate")],
)
def test_a_missing_channel_is_reported_in_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], drop: str, complaint: str
) -> None:
    whole = bench_recording(seed=13)
    channels = {n: (c.read(), c.unit, c.sample_rate, c.start) for n, c in whole.channels.items() if n != drop}
    file = tmp_path / "part.h5"
    Recording.from_arrays(channels, device=DEVICE).write(file)
    assert main(["diagnose", str(file), "-o", str(tmp_path / "out")]) == 2
    error = capsys.readouterr().err.strip().splitlines()[-1]
    assert complaint in error
    assert str(file) in error
    assert not (tmp_path / "out").exists()
