"""Frames of a growing recording: parts, continued tracks and signs."""

import itertools
from dataclasses import replace

import numpy as np
import pytest

from estimation.estimate import estimate
from estimation.tracker import track_end
from recon.evaluation import evaluate_axis, truth_from_simulation
from recon.imaging.scan_phase.carried_readout_phase import apply_readout_phase
from recon.live.live_frames import (
    add_part,
    finish_frame,
    first_picture,
    match_signs,
    measure_readout,
    part_edges,
)
from recon.pipeline import reconstruct
from recon.steps.reconstruction import Options
from scanner.errors import BadInput
from scanner.recording import Recording
from tests.support.simulated import imaging, with_sense


def test_signs_are_continued_from_frame_to_frame() -> None:
    recording, _ = imaging()
    first, second = (
        reconstruct(recording.slice(*part), Options(), quiet=True).motion for part in ((0.0, 0.008), (0.01, 0.02))
    )
    again = {name: axis.negated() for name, axis in second.axes.items()}
    for each in (second, type(second)(again, second.estimator)):
        motion = match_signs(each, first)
        for name in "xy":
            straight = first.axes[name].angle.motion.at(np.array([0.0101]))[0]
            assert np.cos(motion.axes[name].angle.motion.at(np.array([0.0101]))[0] - straight) > 0.9


def test_a_frame_uses_the_readout_error_that_earlier_frames_showed() -> None:
    recording, truth = imaging()
    late = with_sense(recording, lambda sense: np.interp(np.arange(sense.size) - 2.5, np.arange(sense.size), sense))
    options, scan, errors = Options(pixels=(200, 200)), None, []
    for start in (0.0, 0.01):
        known = scan.readout_phase if scan else {}
        scan, frame = add_part(late, start, start + 0.01, scan, None, options)
        scan = replace(scan, readout_phase=measure_readout(frame.longest, known))
        motion = apply_readout_phase(scan.motion, known)
        angle = truth_from_simulation(truth).angles["x"]
        errors.append(np.degrees(evaluate_axis(motion.axes["x"], *angle).phase_rmse))
    assert errors[0] > 2.0  # half a microsecond late at 13.8 kHz
    assert errors[1] < 0.1


def test_a_long_frame_has_a_short_last_part() -> None:
    assert part_edges(0.0, 0.004, 1 / 3270) == [0.0, 0.004]
    assert part_edges(0.0, 0.02, 1 / 3270) == [0.0, 0.02]
    assert part_edges(0.0, 0.04, 1 / 3270) == pytest.approx([0.0, 0.04 - 50 / 3270, 0.04])
    assert part_edges(1.0, 1.1, 1 / 3270) == pytest.approx(
        [1.0, 1.1 - 200 / 3270, 1.1 - 100 / 3270, 1.1 - 50 / 3270, 1.1]
    )


@pytest.mark.parametrize("kind", ["mean", "kernel"])
def test_a_frame_in_parts_is_the_frame(kind: str) -> None:
    recording, truth = imaging(0.06)
    options, angles = Options(pixels=(128, 128), picture=kind, sense_only=True), truth_from_simulation(truth).angles
    scan, first = add_part(recording, 0.0, 0.01, None, None, options)
    scan = finish_frame(scan, first, options)
    edges, frame = [0.01, 0.03, 0.05, 0.06], None
    for begin, end in itertools.pairwise(edges):
        scan, frame = add_part(recording, begin, end, scan, frame, options)
        for name in "xy":
            assert np.degrees(evaluate_axis(scan.motion.axes[name], *angles[name]).phase_rmse) < 0.05
    quick = first_picture(scan, frame, options)
    scan = finish_frame(scan, frame, options)
    np.testing.assert_array_equal(quick.image, scan.estimate.picture.image)
    whole = reconstruct(recording.slice(0.01, 0.06), options, quiet=True)
    assert int(quick.coverage.sum()) + quick.outside == recording.slice(0.01, 0.06)["intensity"].size
    difference, sd = quick.image - whole.picture.image, np.hypot(whole.picture_sd, scan.estimate.sd)
    assert np.nanmean(np.abs(difference) < sd) > 0.95  # the same samples, and nearly the same motion
    assert np.nanmedian(scan.estimate.sd / whole.picture_sd) == pytest.approx(1.0, abs=0.05)


def test_each_sample_belongs_to_one_part_wherever_their_edges_lie() -> None:
    recording, _ = imaging()
    options, intensity = Options(pixels=(40, 40), sense_only=True), recording["intensity"]
    scan, first = add_part(recording, 0.0, 0.01, None, None, options)
    scan = finish_frame(scan, first, options)
    edge = 0.015 + 0.3 / intensity.sample_rate
    scan, frame = add_part(recording, 0.01, edge, scan, None, options)
    scan, frame = add_part(recording, edge, 0.02, scan, frame, options)
    assert frame.sums.samples == recording.slice(0.01, 0.02)["intensity"].size


@pytest.mark.parametrize("kind", ["kernel", "posterior"])
def test_a_frame_without_samples_is_refused_and_the_next_one_is_shown(kind: str) -> None:
    recording, _ = imaging()
    light = recording["intensity"].read().astype(float)
    light[light.size // 3 : 2 * light.size // 3] = np.nan
    channels = {name: (c.read(), c.unit, c.sample_rate, c.start) for name, c in recording.channels.items()}
    dark = Recording.from_arrays(channels | {"intensity": (light, *channels["intensity"][1:])}, recording.device)
    options, scan, third = Options(pixels=(60, 60), picture=kind), None, 0.02 / 3
    for number in range(3):
        scan, frame = add_part(dark, number * third, (number + 1) * third, scan, None, options)
        if number == 1:
            with pytest.raises(BadInput, match="no sample lies in the field"):
                finish_frame(scan, frame, options)
        else:
            first_picture(scan, frame, options)
            scan = finish_frame(scan, frame, options)
            assert np.isfinite(scan.estimate.picture.image).mean() > 0.9


def test_a_continued_track_is_as_good_as_a_long_one() -> None:
    recording, truth = imaging(0.06)
    angles, previous, errors = truth_from_simulation(truth).angles, None, {"x": [], "y": []}
    for k in range(6):
        begin = 0.0 if previous is None else track_end(previous)
        previous = estimate(recording.slice(begin, 0.01 * (k + 1)), before=previous)
        for name, axis in previous.axes.items():
            errors[name].append(np.degrees(evaluate_axis(axis, *angles[name]).phase_rmse))
    assert all(np.max(error[1:]) < 0.04 for error in errors.values())  # 0.1 from a new start every 10 ms


def test_a_segment_elsewhere_does_not_continue_a_track() -> None:
    recording, _ = imaging(0.06)
    first = estimate(recording.slice(0.0, 0.01))
    later = estimate(recording.slice(0.03, 0.04), before=first)
    np.testing.assert_allclose(later.axes["x"].phase, estimate(recording.slice(0.03, 0.04)).axes["x"].phase, atol=2e-3)


def test_a_sensor_of_noise_gives_no_frame() -> None:
    recording, _ = imaging()
    dead = with_sense(recording, lambda sense: np.random.default_rng(4).normal(0.0, 0.01, sense.size))
    with pytest.raises(BadInput, match="sense: shows no motion, only noise"):
        add_part(dead, 0.0, 0.01, None, None, Options(pixels=(100, 100)))
