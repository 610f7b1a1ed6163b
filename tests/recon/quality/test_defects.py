"""Recordings with tolerable defects are reconstructed; the defects are reported and the pixels marked."""

import json
import math
from collections.abc import Iterable, Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import cv2
import h5py
import numpy as np
import pytest
import tifffile
from hypothesis import given
from hypothesis import strategies as st

from recon.cli import main
from recon.evaluation import truth_from_simulation
from recon.imaging.gridding import map_samples
from recon.imaging.scan_phase.phase_error import PhaseError, PhaseEstimate
from recon.pipeline import reconstruct
from recon.quality.clock_jumps import detect_clock_jumps
from recon.quality.defects import Defect, describe_defects, find_defects
from recon.quality.dropped_samples import first_late_slice, slice_delays
from recon.report.summary import summarise
from recon.steps.preparation import prepare
from recon.steps.reconstruction import Options, Reconstruction
from scanner.device import Device
from scanner.recording import Recording
from scanner.sample_ranges import subtract_ranges, to_sample_ranges
from tests.support import two_axis_scan
from tests.support.simulated import imaging, separate_electrodes

SAMPLE_RATE_HZ = 5e6


def damaged(**changes: object) -> Recording:
    """The 20 ms scan, each channel named in ``changes`` replaced: by an array, or (array, start)."""
    recording, _ = imaging()
    channels = {name: (c.read(), c.unit, c.sample_rate, c.start) for name, c in recording.channels.items()}
    for name, change in changes.items():
        values, start = change if isinstance(change, tuple) else (change, 0.0)
        channels[name] = (values, channels.get(name, (0, "V"))[1], SAMPLE_RATE_HZ, start)
    return Recording.from_arrays(channels, recording.device)


def values(name: str) -> np.ndarray:
    return imaging()[0][name].read()


def with_gap(name: str, first: int, stop: int, value: float = np.nan) -> np.ndarray:
    signal = values(name)
    signal[first:stop] = value
    return signal


def defects_of(recording: Recording) -> list[Defect]:
    assert recording.device is not None
    return find_defects(recording, recording.device)


def reconstruct_scan(recording: Recording) -> Reconstruction:
    return reconstruct(
        recording, Options(pixels=(100, 100), sense_only=True), truth_from_simulation(imaging()[1]), quiet=True
    )


@pytest.fixture(scope="module")
def whole() -> Reconstruction:
    return reconstruct_scan(imaging()[0])


def test_an_intact_recording_has_no_defects(whole: Reconstruction) -> None:
    assert whole.defects == []
    assert whole.unlocated_samples == 0
    assert not whole.affected.any()


def test_the_stated_lag_of_the_detector_leaves_no_channel_missing() -> None:
    """It moves the intensity by four samples to times before the other channels begin."""
    recording, _ = imaging()
    assert recording.device is not None
    text = recording.device.to_toml() + "\n[x.terms.detector-lag]\nf_c = 200e3\n"
    prepared = prepare(recording, Device.from_toml(text))
    assert prepared.lagging.start < recording["sense"].start - 2.0 / SAMPLE_RATE_HZ
    assert not prepared.defects


def test_missing_intensities_change_only_the_coverage(whole: Reconstruction) -> None:
    signal = with_gap("intensity", 20_000, 25_000)
    signal[60_000] = np.inf
    result = reconstruct_scan(damaged(intensity=signal))
    assert result.defects == [
        Defect("intensity", "gap", 20_000 / SAMPLE_RATE_HZ, 25_000 / SAMPLE_RATE_HZ),
        Defect("intensity", "gap", 60_000 / SAMPLE_RATE_HZ, 60_001 / SAMPLE_RATE_HZ),
    ]
    missing_coverage = whole.picture.coverage.astype(int) - result.picture.coverage
    assert 0 < missing_coverage.sum() <= 5001  # at the turning points the beam is outside the field
    assert np.array_equal(result.affected, missing_coverage > 0)
    both = (result.picture.coverage > 0) & ~result.affected
    np.testing.assert_array_equal(result.picture.image[both], whole.picture.image[both])


def test_single_missing_samples_are_stated_with_their_share() -> None:
    """They are closer than the merged gap, so they are one interval, of which few samples are missing."""
    signal = damaged()["intensity"].read()
    signal[::50] = np.nan
    (defect,) = defects_of(damaged(intensity=signal))
    assert defect.fraction == pytest.approx(0.02, rel=1e-3)
    (line,) = describe_defects([defect])
    assert line.endswith("2% of the samples there")


def test_a_gap_in_the_sense_signal_is_bridged_and_its_pixels_marked(whole: Reconstruction) -> None:
    result = reconstruct_scan(damaged(sense=with_gap("sense", 40_000, 50_000)))  # 2 ms of 20
    assert result.defects == [Defect("sense", "gap", 0.008, 0.01)]
    assert result.unlocated_samples == 0
    assert 0.3 < result.affected.mean() < 0.9
    assert any("sense: gap for 2 ms" in note for note in result.notes)
    for axis in "xy":
        assert np.degrees(result.evaluation[axis].phase_rmse) < np.degrees(whole.evaluation[axis].phase_rmse) + 0.1


@pytest.mark.parametrize("value", ["last", "rail", "zero"])
def test_a_held_sense_signal_is_bridged_as_a_gap(whole: Reconstruction, value: str) -> None:
    """A converter that repeats a sample, an amplifier at its rail, and a cable that came off."""
    signal = values("sense")
    number = {"last": signal[40_000], "rail": signal.max(), "zero": 0.0}[value]
    result = reconstruct_scan(damaged(sense=with_gap("sense", 40_000, 50_000, number)))  # 2 ms of 20
    (defect,) = result.defects
    assert (defect.channel, defect.kind) == ("sense", "held")
    assert (defect.start, defect.stop) == pytest.approx((0.008, 0.01), abs=1e-6)
    assert any("sense: held at one value for 2 ms" in note for note in result.notes)
    for axis in "xy":
        assert np.degrees(result.evaluation[axis].phase_rmse) < np.degrees(whole.evaluation[axis].phase_rmse) + 0.1


def test_a_held_position_maps_no_samples_and_leads_the_conclusion_where_it_is_used() -> None:
    channels = {**two_axis_scan.sensors(772002), "intensity": (two_axis_scan.light(772002), "V", two_axis_scan.RATE_HZ)}
    position = channels["sense_x"][0]
    position[10_000:20_000] = position[10_000]  # 10 ms of 40
    device = Device.from_toml("[x]\n[y]\n" + two_axis_scan.READOUTS + two_axis_scan.FIELD)
    held = Recording.from_arrays(channels, device)
    result = reconstruct(held, Options(pixels=(80, 80)), quiet=True)
    assert result.motion.estimator == "sensor"
    assert 10_000 <= result.unlocated_samples < 13_000
    assert result.limits == []
    assert any("sense_x: held at one value for 10 ms" in note for note in result.notes)
    assert any("sense_x: 10000 samples" in note and "are left out of phase, amplitude" in note for note in result.notes)
    stated = summarise(result)["x"]
    assert stated["phase_sd_deg"] < 1.0
    assert stated["amplitude_rad"] == pytest.approx(0.97 * two_axis_scan.HALF_RAD, rel=0.01)
    taken = reconstruct(held, Options(pixels=(80, 80), estimator="sine-ukf", allow_outside=True), quiet=True)
    assert any(line.startswith("sense_x: stands at one value for 10 ms") for line in taken.limits)


def test_gaps_in_a_drive_do_not_change_the_phase(whole: Reconstruction) -> None:
    result = reconstruct_scan(damaged(drive_x=with_gap("drive_x", 30_000, 33_000)))
    assert [each.channel for each in result.defects] == ["drive_x"]
    assert np.degrees(result.evaluation["x"].phase_rmse) < np.degrees(whole.evaluation["x"].phase_rmse) + 0.05


def test_clipping_of_the_sense_signal_is_reported_with_its_time() -> None:
    signal = values("sense")
    top = np.quantile(signal, 0.97)
    clipped = signal.copy()
    clipped[50_000:70_000] = np.minimum(signal[50_000:70_000], top)
    clipped[:50_000] = np.where(signal[:50_000] > top, top - 0.01, signal[:50_000])
    clipped[70_000:] = np.where(signal[70_000:] > top, top - 0.01, signal[70_000:])
    (defect,) = defects_of(damaged(sense=clipped))
    assert (defect.channel, defect.kind) == ("sense", "clipped")
    assert 0.0099 < defect.start < defect.stop < 0.0141


def test_samples_without_a_known_angle_are_omitted_and_counted() -> None:
    recording, truth = separate_electrodes()
    channels = {name: (c.read(), c.unit, c.sample_rate, c.start) for name, c in recording.channels.items()}
    channels["intensity"] = (np.ones(60_000), "V", SAMPLE_RATE_HZ, 0.0)
    first_part = channels["sense_x"][0][:40_000]  # 8 ms of 12
    channels["sense_x"] = (first_part, "V", SAMPLE_RATE_HZ, 0.0)
    channels["intensity"][0][::2] = 2.0
    result = reconstruct(
        Recording.from_arrays(channels, recording.device), Options(), truth_from_simulation(truth), quiet=True
    )
    assert result.defects == [Defect("sense_x", "missing", 0.008, 0.012)]
    assert 0.6 * 20_000 < result.unlocated_samples < 20_000
    assert result.picture.coverage.sum() <= 60_000 - result.unlocated_samples


CHANNELS = ("sense", "drive_x", "drive_y", "intensity")


def without_samples(names: Iterable[str], first: int, count: int) -> Recording:
    """The scan with ``count`` samples of some channels lost, without a gap in their time base."""
    return damaged(**{name: np.delete(values(name), np.s_[first : first + count]) for name in names})


@pytest.mark.parametrize(("names", "lost"), [(CHANNELS, 100), (CHANNELS, 2), (("sense",), 30), (("drive_x",), 5000)])
def test_lost_samples_are_detected_as_a_phase_jump(names: tuple[str, ...], lost: int) -> None:
    jumps = detect_clock_jumps(without_samples(names, 60_000, lost))
    assert jumps
    assert {jump.channel for jump in jumps} <= set(names)
    assert all(jump.start < 0.012 < jump.stop and jump.stop - jump.start < 0.006 for jump in jumps)


def test_continuous_motion_has_no_clock_jump() -> None:
    time = np.arange(200_000) / 2e6
    sweep = np.sin(2 * np.pi * (2e4 * time + 0.5 * 2e3 / 0.1 * time**2))
    steps = np.sin(2 * np.pi * np.cumsum(np.where(time < 0.05, 2e4, 2.02e4)) / 2e6)
    settling = np.sin(2 * np.pi * 2e4 * time + 2.0 * np.exp(-time / 0.004))
    noise = np.random.default_rng(0).standard_normal(time.size)
    off = np.where(time < 0.06, np.sin(2 * np.pi * 2e4 * time), 1e-3 * noise)
    drive = np.sin(2 * np.pi * 2e4 * time)
    gap = np.where((time > 0.03) & (time < 0.08), np.nan, drive)
    for drives, sense in (
        (gap, drive),
        (drive, gap),
        (sweep, sweep),
        (steps, drive),
        (drive, settling),
        (drive, drive + noise),
        (off, off),
    ):
        channels = {"drive_x": (drives, "V", 2e6, 0.0), "sense_x": (sense, "V", 2e6, 0.0)}
        assert detect_clock_jumps(Recording.from_arrays(channels)) == []


def test_a_sense_signal_that_alone_lost_samples_is_used_up_to_the_loss(whole: Reconstruction) -> None:
    """The longer segment after the loss has the sense signal early by the lost samples."""
    result = reconstruct_scan(without_samples(("sense",), 40_000, 30))
    (note,) = (note for note in result.notes if "as if sense alone lost samples" in note)
    assert "and that of its drive does not" in note
    assert result.motion.axes["x"].angle.start == 0.0
    assert result.picture.coverage.sum() <= 40_000
    for axis in "xy":
        assert np.degrees(result.evaluation[axis].phase_rmse) < np.degrees(whole.evaluation[axis].phase_rmse) + 0.1


def test_jumps_of_two_lines_at_one_time_are_one_interval() -> None:
    jumps = [Defect("sense", "leap", 0.02, 0.03), Defect("sense", "leap", 0.021, 0.028)]
    (line,) = describe_defects(jumps)
    assert line == "sense: phase jump for 10 ms in one interval, the first at 0.02 s"


def test_the_longest_segment_between_clock_jumps_is_reconstructed(whole: Reconstruction) -> None:
    first, lost = 30_000, 100
    result = reconstruct_scan(without_samples(CHANNELS, first, lost))
    assert {each.kind for each in result.defects} == {"leap"}
    begin = max(each.stop for each in result.defects)
    assert result.motion.axes["x"].angle.start >= begin - 1 / SAMPLE_RATE_HZ
    assert result.picture.coverage.sum() <= (0.02 - begin) * SAMPLE_RATE_HZ
    assert any("a phase jumps as if samples were lost" in note for note in result.notes)
    x, y = (result.motion.axes[axis].angle.read() for axis in "xy")
    at = round(result.motion.axes["x"].angle.start * SAMPLE_RATE_HZ) + lost  # their index in the whole scan
    mirrored = {}
    for angle, axis in ((x, "x"), (y, "y")):
        same = whole.motion.axes[axis].angle.read()[at : at + angle.size]
        error = angle - np.sign(angle @ same) * same  # an even capacitance does not determine the sign
        assert np.sqrt(np.mean(error**2)) < 2e-3 * np.abs(angle).max()
        mirrored[axis] = bool(angle @ same < 0)
    axes = [whole.motion.axes[axis].negated() if mirrored[axis] else whole.motion.axes[axis] for axis in "xy"]
    unused_path = [axis.angle.read(first + lost, at) for axis in axes]  # from the lost samples to the used segment
    crossed = map_samples(*unused_path, np.zeros(unused_path[0].size), result.picture.grid).coverage > 0
    assert 0.2 < crossed.mean() < 0.9
    assert result.affected[crossed].mean() > 0.95  # paths differ by a pixel at their edges
    assert result.affected.mean() < 0.7


@pytest.mark.slow
@pytest.mark.parametrize("missing", [2, 300, -50])
def test_samples_dropped_from_the_intensity_alone_are_located_and_the_timing_is_restored(
    whole: Reconstruction, missing: int
) -> None:
    at = 45_000
    light = values("intensity")
    shortened = np.r_[light[:at], light[at + missing :]]  # negative: repeated samples
    result = reconstruct_scan(damaged(intensity=shortened))
    (jump,) = (each for each in result.defects if each.kind == "leap")
    assert jump.channel == "intensity"
    assert jump.start * SAMPLE_RATE_HZ - 300 < at < jump.stop * SAMPLE_RATE_HZ + 300
    count = f"{missing} samples lost" if missing > 0 else f"{-missing} samples too many"
    assert any(f"intensity: {count} at" in note for note in result.notes)
    assert 0 < result.affected.mean() < 0.3
    both = (result.picture.coverage > 0) & (whole.picture.coverage > 0) & ~result.affected
    assert np.mean(result.picture.image[both] == whole.picture.image[both]) > 0.99
    assert both.mean() > 0.6 * (whole.picture.coverage > 0).mean()


@pytest.mark.slow
def test_a_specimen_that_changed_is_not_reported_as_dropped_samples(whole: Reconstruction) -> None:
    light = values("intensity")
    light[40_000:] = np.random.default_rng(0).permutation(light[40_000:])
    result = reconstruct_scan(damaged(intensity=light))
    assert result.defects == []
    assert any("forward and backward half-periods disagree" in limit for limit in result.limits)
    assert not any("forward and backward half-periods disagree" in limit for limit in whole.limits)


def test_only_a_lasting_sudden_delay_counts_as_dropped_samples(whole: Reconstruction) -> None:
    radians_per_sample = [2 * np.pi * np.median(whole.motion.axes[axis].frequency) / SAMPLE_RATE_HZ for axis in "xy"]

    def slices_of(delays: Sequence[float], sd: float = 0.02) -> list[PhaseError]:
        return [
            PhaseError(1e-3 * i, *(PhaseEstimate(delay * scale, sd * scale) for scale in radians_per_sample))
            for i, delay in enumerate(delays)
        ]

    np.testing.assert_allclose(slice_delays(slices_of([0.0, 3.0]), whole.motion), [0.0, 3.0])
    assert first_late_slice(slices_of([0.1, -0.1, 3.0, 3.0]), whole.motion) == 2
    assert (
        first_late_slice(slices_of([0.0, 3.0, np.nan], np.inf), whole.motion) is None
    )  # no estimate after the first slice
    assert first_late_slice(slices_of([0.0, 0.0, 0.0, 0.0]), whole.motion) is None
    assert first_late_slice(slices_of([0.0, 3.0, 0.0, 0.0]), whole.motion) is None
    assert first_late_slice(slices_of([0.4, 0.6, 0.6, 0.6]), whole.motion) is None  # a constant delay near the limit
    assert first_late_slice(slices_of([2.0, 2.0, 2.0]), whole.motion) is None  # a constant delay
    assert first_late_slice(slices_of([0.0, 0.0, 3.0]), whole.motion) is None  # followed by no complete slice
    after_the_motion = [replace(each, time=1.0 + each.time) for each in slices_of([np.nan, np.nan], np.inf)]
    assert first_late_slice([*slices_of([0.0, 0.0]), *after_the_motion], whole.motion) is None


def test_a_constant_phase_error_of_an_axis_that_is_determined_only_later_is_no_loss(whole: Reconstruction) -> None:
    """At the start of a scan the amplitude of an axis may still grow; there the delay is that of the other axis."""
    aligned, unknown = PhaseEstimate(0.0, 1e-3), PhaseEstimate(math.nan, math.inf)
    late = PhaseEstimate(np.radians(3.0), 1e-4)
    axes = [(unknown, aligned)] * 2 + [(late, aligned)] * 4
    slices = [PhaseError(1e-3 * i, x, y) for i, (x, y) in enumerate(axes)]
    assert first_late_slice(slices, whole.motion) is None
    lost = [PhaseError(1e-3 * i, aligned if i < 2 else late, unknown) for i in range(6)]
    assert first_late_slice(lost, whole.motion) == 2


@pytest.mark.slow
def test_folder_and_summary_report_defects(tmp_path: Path) -> None:
    damaged(intensity=with_gap("intensity", 20_000, 25_000)).write(tmp_path / "a.h5")
    assert main(["reconstruct", str(tmp_path / "a.h5"), "-o", str(tmp_path / "out"), "--pixels", "100x100"]) == 0
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert summary["trouble"] == [
        {"channel": "intensity", "kind": "gap", "start": 0.004, "stop": 0.005, "fraction": 1.0}
    ]
    affected = tifffile.imread(tmp_path / "out" / "affected.tif")
    assert affected.dtype == np.uint8
    assert set(np.unique(affected)) == {0, 1}
    assert summary["affected"] == pytest.approx(affected.mean())
    preview = cv2.imread(str(tmp_path / "out" / "image.png")).astype(int)
    grey = np.ptp(preview, axis=2) == 0
    assert not grey[affected == 1].any()
    assert grey[(affected == 0) & (tifffile.imread(tmp_path / "out" / "coverage.tif") > 0)].all()
    with h5py.File(tmp_path / "out" / "motion.h5") as motion:
        assert np.isfinite(motion["x/angle"][:]).all()


def test_seconds_become_sample_ranges_and_ranges_are_subtracted() -> None:
    intensity = imaging()[0]["intensity"]
    assert to_sample_ranges([(0.01, 0.02), (-1.0, 1e-6), (0.0, 2e-6), (0.03, 0.04)], intensity) == [
        (0, 10),
        (50_000, 100_000),
    ]
    assert subtract_ranges([(0, 10), (20, 30)], [(5, 22), (28, 29)]) == [(0, 5), (22, 28), (29, 30)]


@given(st.lists(st.tuples(st.integers(0, 40), st.integers(0, 40)), max_size=6), st.integers(0, 2**32 - 1))
def test_range_operations_equal_set_operations(pairs: list[tuple[int, int]], seed: int) -> None:
    intensity = imaging()[0]["intensity"]
    others = np.random.default_rng(seed).integers(0, 41, (3, 2)).tolist()

    def of_seconds(given: Iterable[Sequence[int]]) -> list[tuple[int, int]]:
        return to_sample_ranges([(min(each) / SAMPLE_RATE_HZ, max(each) / SAMPLE_RATE_HZ) for each in given], intensity)

    def members(ranges: list[tuple[int, int]]) -> set[int]:
        return {i for first, stop in ranges for i in range(first, stop)}

    a, b = of_seconds(pairs), of_seconds(others)
    assert members(a) == {i for each in pairs for i in range(min(each), max(each))}
    assert members(subtract_ranges(a, b)) == members(a) - members(b)
    assert all(one[1] < two[0] for one, two in pairwise(a))
