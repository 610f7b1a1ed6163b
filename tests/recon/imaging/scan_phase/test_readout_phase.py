"""The phase error of the readout, estimated from the picture, and the coverage of its intervals."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from estimation.tracker import track
from phantoms.experiment import Experiment, simulate_experiment
from phantoms.optics import Detector, detect, sample_scene
from phantoms.targets import make_target
from recon.evaluation import truth_from_simulation
from recon.imaging.scan_phase.phase_error import PhaseError, PhaseErrorParts, PhaseEstimate
from recon.imaging.scan_phase.readout_phase import remove_readout_phase
from recon.imaging.scan_phase.readout_phase_model import (
    OFFSET_SDS_RAD,
    ReadoutPhase,
    average_jointly,
    average_separately,
    constant_prior,
    correlate_matern32,
    weigh_hypotheses,
)
from recon.pipeline import reconstruct
from recon.report.summary import summarise
from recon.steps.reconstruction import Options
from scanner.recording import Recording
from tests.support.simulated import imaging, with_sense

TIME_S = np.linspace(0.0, 0.04, 60)
POSTERIOR_TIME_S = np.linspace(0.0, 0.04, 41)


def measured(truth: np.ndarray, sd: float, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Measurements of a phase error that is known at ``POSTERIOR_TIME_S``, with their standard deviations [rad]."""
    return np.interp(TIME_S, POSTERIOR_TIME_S, truth) + rng.normal(0.0, sd, TIME_S.size), np.full(TIME_S.size, sd)


def estimated(value: np.ndarray, sd: np.ndarray, at: np.ndarray, sense_sd: float = 0.0) -> ReadoutPhase:
    """Posterior of one axis by its measurements at ``TIME_S``."""
    return average_separately(weigh_hypotheses(TIME_S, value, sd, at, sense_sd), constant_prior(OFFSET_SDS_RAD))


@pytest.mark.parametrize("kind", ["as stated", "constant", "drifting"])
def test_intervals_have_their_nominal_coverage(kind: str) -> None:
    rng = np.random.default_rng(5)
    covered, variances, errors = [], [], []
    for _ in range(40):
        truth = np.zeros(POSTERIOR_TIME_S.size)
        if kind != "as stated":
            truth += np.radians(10.0 ** rng.uniform(-1.5, 0.7))
        if kind == "drifting":
            covariance = np.radians(0.1) ** 2 * correlate_matern32(POSTERIOR_TIME_S[:, None] - POSTERIOR_TIME_S, 5e-3)
            truth += rng.multivariate_normal(np.zeros(POSTERIOR_TIME_S.size), covariance)
        posterior = estimated(*measured(truth, np.radians(0.03), rng), POSTERIOR_TIME_S)
        error = posterior.mean - truth
        covered.append(np.abs(error) < 1.96 * np.sqrt(posterior.variance))
        variances.append(posterior.variance)
        errors.append(error)
    assert np.mean(covered) > 0.9
    rms, stated = np.sqrt(np.mean(np.square(errors))), np.sqrt(np.mean(variances))
    assert rms < 1.2 * stated
    if kind == "drifting":
        assert 0.9 < np.mean(covered) < 0.99  # the intervals are not too wide
    if kind == "as stated":
        assert stated < np.radians(0.03) / np.sqrt(10.0)  # a constant alone would have 0.03°/sqrt(60)


def test_the_picture_reduces_the_random_error_of_the_estimator() -> None:
    rng = np.random.default_rng(8)
    sense_sd = np.radians(0.05)
    correlation = correlate_matern32(POSTERIOR_TIME_S[:, None] - POSTERIOR_TIME_S, 10e-3)
    errors, stated, values = [], [], []
    for _ in range(40):
        truth = sense_sd * rng.multivariate_normal(np.zeros(POSTERIOR_TIME_S.size), correlation)
        data = measured(truth, np.radians(0.03), rng)
        posterior = estimated(*data, POSTERIOR_TIME_S, sense_sd)
        errors.append(posterior.mean - truth)
        stated.append(np.sqrt(posterior.variance))
        values.append(posterior.value / posterior.sd)
    assert np.sqrt(np.mean(np.square(errors))) < 0.5 * sense_sd
    assert 0.9 < np.mean(np.abs(errors) < 1.96 * np.array(stated)) < 0.99
    assert np.mean(np.abs(values) > 3.0) < 0.05  # a random error of the estimator is not one of the readout


def test_a_large_constant_is_found_to_the_precision_of_the_mean() -> None:
    rng = np.random.default_rng(2)
    truth = np.full(POSTERIOR_TIME_S.size, np.radians(5.0))
    posterior = estimated(*measured(truth, np.radians(0.03), rng), POSTERIOR_TIME_S)
    assert posterior.sd == pytest.approx(np.radians(0.03) / np.sqrt(TIME_S.size), rel=0.5)
    assert abs(posterior.value - truth[0]) < 3.0 * posterior.sd


def test_without_measurements_there_is_no_estimate() -> None:
    nothing = np.full(TIME_S.size, np.nan), np.full(TIME_S.size, np.inf)
    assert not weigh_hypotheses(TIME_S, *nothing, POSTERIOR_TIME_S).determines_constant


def test_the_estimate_returns_to_the_constant_away_from_the_measurements() -> None:
    rng = np.random.default_rng(3)
    value, sd = measured(np.full(POSTERIOR_TIME_S.size, np.radians(1.0)), np.radians(0.03), rng)
    late = POSTERIOR_TIME_S + 10.0
    posterior = estimated(value, sd, late)
    np.testing.assert_allclose(posterior.mean, np.radians(1.0), atol=np.radians(0.03))
    inside = estimated(value, sd, POSTERIOR_TIME_S)
    assert posterior.variance.mean() >= inside.variance.mean()


def test_an_axis_measured_well_narrows_the_intervals_of_the_other_one_if_its_readout_does_not_drift() -> None:
    rng = np.random.default_rng(4)
    still = np.zeros(POSTERIOR_TIME_S.size)
    drift = np.radians(0.3) * np.sin(2.0 * np.pi * POSTERIOR_TIME_S / 0.03)
    stated = {"still": [], "drifting": []}  # of y, whose readout does not drift, over that without x
    for _ in range(10):
        y = weigh_hypotheses(TIME_S, *measured(still, np.radians(0.1), rng), POSTERIOR_TIME_S, np.radians(0.01))
        for kind, truth in (("still", still), ("drifting", drift)):
            x = weigh_hypotheses(TIME_S, *measured(truth, np.radians(0.01), rng), POSTERIOR_TIME_S, np.radians(0.01))
            alone = average_separately(y, constant_prior(OFFSET_SDS_RAD))
            stated[kind].append(np.mean(average_jointly({"x": x, "y": y})["y"].variance / alone.variance))
    assert max(stated["still"]) < 1.0 < min(stated["drifting"])


RATES = {"x": 2.0 * np.pi * 13.8e3, "y": 2.0 * np.pi * 3.3e3}


def test_a_delay_of_the_common_readout_that_one_axis_shows_is_known_in_the_other() -> None:
    rng = np.random.default_rng(6)
    ones = np.ones(POSTERIOR_TIME_S.size)
    nothing = np.full(TIME_S.size, np.nan), np.full(TIME_S.size, np.inf)
    for delay in (0.0, 0.5e-6, 1.0e-6):
        late = {axis: rate * delay for axis, rate in RATES.items()}
        x = weigh_hypotheses(TIME_S, *measured(late["x"] * ones, np.radians(0.03), rng), POSTERIOR_TIME_S)
        found = average_jointly({"x": x, "y": weigh_hypotheses(TIME_S, *nothing, POSTERIOR_TIME_S)}, RATES)
        assert found["x"].measured
        assert not found["y"].measured
        assert abs(found["y"].value - late["y"]) < np.radians(0.05)
        assert np.radians(0.05) < found["y"].sd < np.radians(0.3)  # feedthrough into one axis alone is not excluded


def test_intervals_of_both_axes_have_their_nominal_coverage_whatever_the_readout_does() -> None:
    rng = np.random.default_rng(7)
    sds, all_covered = {"x": np.radians(0.03), "y": np.radians(0.1)}, []
    for delayed_too, own in ((False, False), (True, False), (False, True), (True, True)):
        covered, ratio = [], []
        for _ in range(100):
            delay = 10.0 ** rng.uniform(-7.5, -6.0) if delayed_too else 0.0
            truth = {axis: rate * delay for axis, rate in RATES.items()}
            if own:
                truth["x"] += rng.choice([-1.0, 1.0]) * np.radians(10.0 ** rng.uniform(-1.5, 0.0))
            ones = np.ones(POSTERIOR_TIME_S.size)
            axes = {
                axis: weigh_hypotheses(TIME_S, *measured(truth[axis] * ones, sds[axis], rng), POSTERIOR_TIME_S)
                for axis in RATES
            }
            found = average_jointly(axes, RATES)
            error = [(found[axis].value - truth[axis]) / found[axis].sd for axis in RATES]
            covered.append(np.abs(error) < 1.96)
            ratio.append(found["y"].sd / average_separately(axes["y"], constant_prior(OFFSET_SDS_RAD)).sd)
        assert np.all(np.mean(covered, axis=0) > 0.8), (delayed_too, own)  # 0.85 in y where both are present
        all_covered += covered
        if delayed_too and not own:
            assert np.mean(ratio) < 0.8  # x determines the delay better than y does
    mean = np.mean(all_covered, axis=0)
    assert np.all((mean > 0.93) & (mean < 0.98)), mean


def delayed(sense: np.ndarray) -> np.ndarray:
    """The signal, delayed by half a microsecond."""
    frequency = np.fft.rfftfreq(2 * sense.size, 0.2e-6)
    mirrored = np.fft.rfft(np.concatenate([sense, sense[::-1]]))
    return np.fft.irfft(mirrored * np.exp(-2j * np.pi * frequency * 0.5e-6))[: sense.size]


def test_an_unstated_delay_is_estimated_corrected_and_reported() -> None:
    recording, simulated = imaging()
    truth = truth_from_simulation(simulated)
    result = reconstruct(with_sense(recording, delayed), Options(), truth, quiet=True)
    for axis, rate in (("x", 13840.0), ("y", 3270.0)):
        late = 2.0 * np.pi * rate * 0.5e-6
        assert result.readout_phase[axis].value == pytest.approx(late, abs=4.0 * result.readout_phase[axis].sd)
        assert np.degrees(result.evaluation[axis].phase_rmse) < 0.03
    assert any("a delay of 0.5 µs" in note and "lissajous diagnose" in note for note in result.notes)
    alone = reconstruct(with_sense(recording, delayed), Options(sense_only=True), truth, quiet=True)
    assert np.degrees(alone.evaluation["x"].phase_rmse) > 2.0
    assert not alone.readout_phase


def test_a_correctly_stated_readout_keeps_its_precision() -> None:
    recording, simulated = imaging()
    truth = truth_from_simulation(simulated)
    result, alone = (reconstruct(recording, Options(sense_only=only), truth, quiet=True) for only in (False, True))
    for axis in "xy":
        assert result.evaluation[axis].phase_rmse < 1.1 * alone.evaluation[axis].phase_rmse + np.radians(0.002)
    assert not any("late" in note or "early" in note for note in result.notes)


def phase_errors(x: float, y: float) -> list[PhaseError]:
    """Errors of three slices [deg] with standard deviations of 0.05 degrees; NaN determines none."""
    time, sd = 1e-3 * np.arange(16.0), float(np.radians(0.05))
    pair = [PhaseEstimate(float(np.radians(v)), float("inf") if np.isnan(v) else sd) for v in (x, y)]
    value, sds = np.tile(np.array(pair).T[:, None], (1, 16, 1))
    return [PhaseError(start + 8e-3, *pair, PhaseErrorParts(start + time, value, sds)) for start in (0.0, 0.02, 0.04)]


@pytest.mark.parametrize(("second", "third"), [(float("nan"), 1.0), (2.0, 1.0)])
def test_a_correction_that_the_next_picture_refutes_is_not_applied(second: float, third: float) -> None:
    motion = track(imaging()[0], imaging()[0].device)
    rounds = iter([phase_errors(second, 0.0), phase_errors(third, 0.0), phase_errors(third, 0.0)])
    corrected, _, found = remove_readout_phase(motion, phase_errors(1.0, 0.5), lambda _: next(rounds))
    assert set(found) == {"y"}
    np.testing.assert_array_equal(corrected.axes["x"].phase, motion.axes["x"].phase)
    assert np.all(corrected.axes["x"].phase_sd > 5.0 * motion.axes["x"].phase_sd)
    assert found["y"].value == pytest.approx(np.radians(0.5), abs=np.radians(0.05))


def test_a_correction_that_the_next_picture_confirms_is_applied() -> None:
    motion = track(imaging()[0], imaging()[0].device)
    rounds = iter([phase_errors(0.1, 0.0), phase_errors(0.0, 0.0)])
    _, _, found = remove_readout_phase(motion, phase_errors(1.0, 0.5), lambda _: next(rounds))
    assert found["x"].value == pytest.approx(np.radians(1.1), abs=np.radians(0.05))


def featureless() -> Recording:
    """The scan of a specimen without detail."""
    recording = imaging()[0]
    light = np.random.default_rng(0).poisson(200.0, recording["intensity"].size).astype(float)
    return recording.with_channel(replace(recording["intensity"], raw=light, gain=1.0, offset=0.0))


def test_a_specimen_without_detail_gives_a_wide_interval_and_a_note() -> None:
    result = reconstruct(featureless(), Options(), truth_from_simulation(imaging()[1]), quiet=True)
    for axis, rate in (("x", 13840.0), ("y", 3270.0)):
        assert axis not in result.readout_phase
        sd = result.motion.axes[axis].phase_sd
        assert np.all(sd > 2.0 * np.pi * rate * 0.49e-6)
    assert sum("determines no phase" in note for note in result.notes) == 2


@pytest.mark.parametrize("delay", [-0.9e-6, 0.9e-6])
def test_without_a_picture_the_interval_holds_an_unstated_delay_that_the_harmonics_do_not_show(delay: float) -> None:
    recording, simulated = featureless(), imaging()[1]
    late = recording.with_channel(replace(recording["sense"], start=recording["sense"].start + delay))
    result = reconstruct(late, Options(), truth_from_simulation(simulated), quiet=True)
    summary = summarise(result)
    for axis, rate in (("x", 13840.0), ("y", 3270.0)):
        error, sd = result.evaluation[axis].phase, result.motion.axes[axis].phase_sd
        assert abs(error.mean()) == pytest.approx(2.0 * np.pi * rate * abs(delay), rel=0.02)
        assert np.abs(error).max() < 1.96 * sd.min()
        assert summary["readout_phase_deg"][axis] is None


def lit(scene: np.ndarray, creep: float = 0.0, saturation: float = 1.0) -> Recording:
    """The scan of another scene.

    Args:
        scene: in place of the tissue.
        creep: motion of the specimen along x over the scan, relative to the half field.
        saturation: quantile of the intensity at which the detector saturates.
    """
    recording, simulated = imaging()
    angles, intensity = truth_from_simulation(simulated).angles, recording["intensity"]
    clocks = {axis: start + np.arange(values.size) / rate for axis, (values, rate, start) in angles.items()}
    x, y = (np.interp(intensity.time(), clocks[axis], angles[axis][0]) for axis in "xy")
    light = sample_scene(scene, x - creep * 0.18 * np.linspace(0.0, 1.0, x.size), y, 0.18, 0.18)
    volts = detect(light, intensity.sample_rate, Detector(photons_per_sample=300.0), np.random.default_rng(0))
    channels = {k: (c.read(), c.unit, c.sample_rate, c.start) for k, c in recording.channels.items()}
    channels["intensity"] = (np.minimum(volts, np.quantile(volts, saturation)), *channels["intensity"][1:])
    return Recording.from_arrays(channels, recording.device)


@pytest.mark.parametrize("case", ["repeats", "saturated", "moves"])
def test_a_difficult_scene_is_not_taken_for_a_readout_error(case: str) -> None:
    wave = 0.2 * np.sin(2.0 * np.pi * np.arange(800) / 20.0)  # 40 periods: finer than the registration's search
    recording = {
        "repeats": lambda: lit(0.5 + wave[:, None] + wave),
        "saturated": lambda: lit(make_target("immunohistochemistry"), saturation=0.1),
        "moves": lambda: lit(make_target("immunohistochemistry"), creep=0.01),
    }[case]()
    result = reconstruct(recording, Options(), truth_from_simulation(imaging()[1]), quiet=True)
    for axis in "xy":
        assert np.degrees(result.evaluation[axis].phase_rmse) < 0.05
    assert not any("late" in note or "early" in note for note in result.notes)
    if case == "repeats":
        assert not result.readout_phase
        assert sum("a pattern that repeats" in note for note in result.notes) == 2


@pytest.mark.parametrize(("target", "pixels"), [("siemens_star", 100), ("immunohistochemistry", 100)])
def test_a_short_scan_with_detail_below_a_pixel_keeps_the_phase_of_the_sense_signal(target: str, pixels: int) -> None:
    recording, simulated = simulate_experiment(Experiment(target=target, duration=0.006), 3)
    result = reconstruct(recording, Options(pixels=(pixels, pixels)), truth_from_simulation(simulated), quiet=True)
    for axis in "xy":
        assert np.degrees(result.evaluation[axis].phase_rmse) < 0.05
