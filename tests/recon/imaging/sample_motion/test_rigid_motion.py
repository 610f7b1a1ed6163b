"""The motion of a sample, found at the crossings of a scan with a known answer."""

import csv
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from phantoms.optics import sample_scene
from recon.cli import main
from recon.imaging.sample_motion.block_equations import PARTS, SHAPES, BlockEquations, block_equations
from recon.imaging.sample_motion.correction import describe_sample_motion
from recon.imaging.sample_motion.motion_smoother import smooth_motion
from recon.imaging.sample_motion.placed_samples import PlacedSamples
from recon.imaging.sample_motion.rigid_motion import MIN_LOG_LIKELIHOOD_GAIN, SampleMotion, estimate_sample_motion
from recon.imaging.sample_motion.vibrations import Vibration
from tests.support.sample_motion import BLOCKS, PERIOD, PIXELS, RATE, error_of, scan
from tests.support.simulated import imaging


def test_a_sample_at_rest_is_reported_at_rest() -> None:
    found = estimate_sample_motion(scan(np.zeros((2, 2))), PERIOD, (PIXELS, PIXELS))
    assert found is not None
    assert not found.moving
    assert found.gain < 0.5 * MIN_LOG_LIKELIHOOD_GAIN
    assert not found.shift.any()
    assert "none was found" in describe_sample_motion(found, RATE)
    assert not found.left.any()


def test_a_breathing_sample_is_followed_within_its_standard_deviation() -> None:
    phase = np.linspace(0.0, 2.0 * np.pi, 500)
    displacement = np.column_stack([5.0 * np.sin(phase), 2.0 * np.cos(phase)])
    found = estimate_sample_motion(scan(displacement), PERIOD, (PIXELS, PIXELS))
    assert found is not None
    assert found.moving
    error = error_of(found, displacement)
    assert np.sqrt(np.mean(error**2)) < 0.1
    assert np.mean(np.abs(error) < 1.96 * found.sd) > 0.85


def test_a_jump_is_found_at_its_moment() -> None:
    displacement = np.zeros((2001, 2))
    displacement[890:] = 6.0, -3.0
    found = estimate_sample_motion(scan(displacement), PERIOD, (PIXELS, PIXELS))
    assert found is not None
    (before,) = np.flatnonzero(np.diff(found.sample) == 1.0)
    assert found.sample[before] == pytest.approx(
        0.445 * BLOCKS * PERIOD, abs=0.25 * PERIOD
    )  # many samples leave the picture
    assert np.abs(np.delete(error_of(found, displacement), [before, before + 1], axis=0)).max() < 0.3


def test_a_phase_error_is_no_motion() -> None:
    """It displaces forward and backward half-periods in opposite directions."""
    samples = scan(np.zeros((2, 2)))
    late = PlacedSamples(np.roll(samples.x, 1), samples.y, samples.value)
    found = estimate_sample_motion(late, PERIOD, (PIXELS, PIXELS))
    assert found is not None
    assert not found.moving


def test_the_equations_show_a_known_translation() -> None:
    samples = scan(np.zeros((2, 2)))
    shift = np.zeros((BLOCKS * PARTS, 2))
    shift[50 * PARTS : 51 * PARTS] = 0.5, -0.3
    equations = block_equations(samples, shift, round(PERIOD / PARTS), (PIXELS, PIXELS), 1.0)
    information = equations.information[50, :2, :2]
    found = np.linalg.solve(information, equations.score[50, :2])
    sd = np.sqrt(np.diag(np.linalg.inv(information)))
    assert np.abs(found - (-0.5, 0.3)) == pytest.approx(0.0, abs=4.0 * sd.max())
    assert sd.max() < 0.15


def test_white_noise_of_the_position_is_smoothed_to_rest() -> None:
    rng = np.random.default_rng(2)
    strength = np.tile([50.0, 20.0], len(SHAPES))
    score = rng.standard_normal((400, strength.size)) * np.sqrt(strength)
    equations = BlockEquations(score, np.tile(np.diag(strength), (400, 1, 1)), 1.0, 1.0, independent)
    smoothed = smooth_motion(equations, np.zeros((400, 2)))
    assert smoothed.gain < 4.0
    assert np.abs(smoothed.position).max() < 0.1
    assert not smoothed.jumps
    assert not smoothed.vibrations


def independent(columns: np.ndarray, change: np.ndarray) -> np.ndarray:
    """Products of the scores for independent noise: not asked for where no vibration is found."""
    raise AssertionError


def test_a_scene_without_structure_and_a_scan_without_crossings_are_stated() -> None:
    samples = scan(np.zeros((2, 2)))
    flat = samples._replace(value=np.random.default_rng(3).poisson(20.0, samples.value.size).astype(np.float32))
    found = estimate_sample_motion(flat, PERIOD, (PIXELS, PIXELS))
    assert found is not None
    assert not found.moving
    assert "too little structure" in describe_sample_motion(found, RATE)
    line = (0.5 + 4.0 * (np.arange(samples.x.size) // 1800)).astype(np.float32)
    raster = PlacedSamples.from_arrays(samples.places(slice(None))[0], line, samples.value)
    assert estimate_sample_motion(raster, 1800.0, (PIXELS, PIXELS)) is None
    assert "too rarely" in describe_sample_motion(None, RATE)


@pytest.mark.slow
def test_the_command_removes_a_motion_and_states_it(tmp_path: Path) -> None:
    recording, truth = imaging()
    intensity, view = recording["intensity"], recording.device.require_scan()
    drift = np.linspace(0.0, 0.02, intensity.size) * view.half_angle_x
    light = sample_scene(
        np.asarray(truth["scene"], float),
        np.asarray(truth["angle_x"][0], float) - drift,  # type: ignore[index]
        np.asarray(truth["angle_y"][0], float),  # type: ignore[index]
        *view.mechanical_half_angles,
    )
    noise = 0.03 * np.random.default_rng(0).standard_normal(light.size)
    recording.with_channel(replace(intensity, raw=light + noise)).write(tmp_path / "scan.h5")
    out = tmp_path / "out"
    assert main(["reconstruct", str(tmp_path / "scan.h5"), "-o", str(out), "--sample-motion"]) == 0
    summary = json.loads((out / "summary.json").read_text())
    assert summary["sample_motion"]["moving"]
    assert summary["sample_motion"]["peak_to_peak_px"]["x"] == pytest.approx(4.0, abs=0.5)
    rows = list(csv.DictReader((out / "sample_motion.csv").open()))
    assert abs(float(rows[-1]["x_px"]) - float(rows[0]["x_px"])) == pytest.approx(4.0, abs=0.5)
    assert "Motion of the sample" in (out / "report.html").read_text()


def test_the_note_names_vibrations_and_what_is_left() -> None:
    shift = np.array([[0.0, 0.0], [3.0, 1.0]])
    vibration = Vibration(500.0 / RATE, np.array([1.5, 0.0]), np.array([0.0, 0.5]))
    found = SampleMotion(
        1000, np.array([0.0, 1e5]), shift, np.full((2, 2), 0.05), True, 99.0, np.array([0.4, 0.0]), (vibration,)
    )
    note = describe_sample_motion(found, RATE)
    assert "3 x 1 pixels peak to peak" in note
    assert "vibration at 500 Hz, 3 x 1 pixels peak to peak" in note
    assert "0.4 x 0 pixels rms (x, y) beside it could not be followed" in note


def vibration(hertz: float, size: float) -> np.ndarray:
    """A displacement [px] peak to peak along (0.8, 0.6), for :func:`scan`."""
    time = np.linspace(0.0, BLOCKS * PERIOD / RATE, 20 * BLOCKS)
    return 0.5 * size * np.outer(np.sin(2.0 * np.pi * hertz * time + 1.0), [0.8, 0.6])


@pytest.mark.parametrize(("hertz", "size"), [(400.0, 4.0), (1000.0, 1.0), (3500.0, 1.0)])
def test_a_vibration_on_top_of_a_drift_is_followed(hertz: float, size: float) -> None:
    drift = np.linspace(0.0, 4.0, 20 * BLOCKS)[:, None] * [0.5, -0.5]
    displacement = vibration(hertz, size) + drift
    found = estimate_sample_motion(scan(displacement), PERIOD, (PIXELS, PIXELS))
    assert found is not None
    assert [each.frequency * RATE for each in found.vibrations] == pytest.approx([hertz], abs=2.0)
    assert 2.0 * found.vibrations[0].peak == pytest.approx([0.8 * size, 0.6 * size], abs=0.1)
    error = error_of(found, displacement)
    assert np.sqrt(np.mean(error**2)) < 0.1
    assert np.mean(np.abs(error) < 1.96 * found.sd) > 0.8
    assert not found.left.any()


def test_a_vibration_above_the_band_is_stated() -> None:
    found = estimate_sample_motion(scan(vibration(4700.0, 4.0)), PERIOD, (PIXELS, PIXELS))
    assert found is not None
    assert found.left.max() > 0.5
    assert np.all(found.sd[:, np.argmax(found.left)] > 0.5)
    assert "could not be followed" in describe_sample_motion(found, RATE)
