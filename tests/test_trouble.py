"""Recordings with trouble that can be lived with: reconstructed, the trouble named, the pixels marked."""

import json
from collections.abc import Iterable, Sequence
from itertools import pairwise
from pathlib import Path

import cv2
import h5py
import numpy as np
import pytest
import tifffile
from hypothesis import given
from hypothesis import strategies as st
from worlds import imaging, separate_electrodes

from recon.cli import main
from recon.leaps import leaps
from recon.lost_light import delays, torn
from recon.mapping import map_samples
from recon.pipeline import Options, Reconstruction, reconstruct
from recon.registration import Estimate, PhaseError
from recon.score import told_truth
from recon.trouble import Trouble, samples, troubles, without
from scanner.recording import Recording

RATE = 5e6


def damaged(**changes: object) -> Recording:
    """The 20 ms scan, each channel named in ``changes`` replaced: by an array, or (array, start)."""
    recording, _ = imaging()
    channels = {name: (c.read(), c.unit, c.sample_rate, c.start) for name, c in recording.channels.items()}
    for name, change in changes.items():
        values, start = change if isinstance(change, tuple) else (change, 0.0)
        channels[name] = (values, channels.get(name, (0, "V"))[1], RATE, start)
    return Recording.from_arrays(channels, recording.device)


def values(name: str) -> np.ndarray:
    return imaging()[0][name].read()


def with_gap(name: str, first: int, stop: int, value: float = np.nan) -> np.ndarray:
    signal = values(name)
    signal[first:stop] = value
    return signal


def of(recording: Recording) -> Reconstruction:
    return reconstruct(recording, Options(pixels=(100, 100)), told_truth(imaging()[1]), quiet=True)


@pytest.fixture(scope="module")
def whole() -> Reconstruction:
    return of(imaging()[0])


def test_a_whole_recording_has_no_trouble(whole: Reconstruction) -> None:
    assert whole.trouble == []
    assert whole.dropped == 0
    assert not whole.affected.any()


def test_intensities_that_are_missing_poison_no_pixel(whole: Reconstruction) -> None:
    signal = with_gap("intensity", 20_000, 25_000)
    signal[60_000] = np.inf
    result = of(damaged(intensity=signal))
    assert result.trouble == [
        Trouble("intensity", "gap", 20_000 / RATE, 25_000 / RATE),
        Trouble("intensity", "gap", 60_000 / RATE, 60_001 / RATE),
    ]
    lost = whole.picture.coverage.astype(int) - result.picture.coverage
    assert 0 < lost.sum() <= 5001  # the beam leaves the field at the turns
    assert np.array_equal(result.affected, lost > 0)
    both = (result.picture.coverage > 0) & ~result.affected
    np.testing.assert_array_equal(result.picture.image[both], whole.picture.image[both])


def test_a_gap_in_the_sense_signal_is_bridged_and_its_pixels_marked(whole: Reconstruction) -> None:
    result = of(damaged(sense=with_gap("sense", 40_000, 50_000)))  # 2 ms of 20
    assert result.trouble == [Trouble("sense", "gap", 0.008, 0.01)]
    assert result.dropped == 0
    assert 0.3 < result.affected.mean() < 0.9
    assert any("sense: gap for 2 ms" in note for note in result.notes)
    for axis in "xy":
        assert np.degrees(result.errors[axis].phase_rmse) < np.degrees(whole.errors[axis].phase_rmse) + 0.1


def test_gaps_in_a_drive_leave_the_phase_where_it_was(whole: Reconstruction) -> None:
    result = of(damaged(drive_x=with_gap("drive_x", 30_000, 33_000)))
    assert [each.channel for each in result.trouble] == ["drive_x"]
    assert np.degrees(result.errors["x"].phase_rmse) < np.degrees(whole.errors["x"].phase_rmse) + 0.05


def test_a_clipped_sense_signal_is_named() -> None:
    signal = values("sense")
    top = np.quantile(signal, 0.97)
    late = signal.copy()
    late[50_000:70_000] = np.minimum(signal[50_000:70_000], top)
    late[:50_000] = np.where(signal[:50_000] > top, top - 0.01, signal[:50_000])
    late[70_000:] = np.where(signal[70_000:] > top, top - 0.01, signal[70_000:])
    (found,) = troubles(damaged(sense=late))
    assert (found.channel, found.kind) == ("sense", "clipped")
    assert 0.0099 < found.start < found.stop < 0.0141


def test_samples_of_which_no_one_can_say_where_the_mirror_was_are_dropped_and_counted() -> None:
    recording, truth = separate_electrodes()
    channels = {name: (c.read(), c.unit, c.sample_rate, c.start) for name, c in recording.channels.items()}
    channels["intensity"] = (np.ones(60_000), "V", RATE, 0.0)
    short = channels["sense_x"][0][:40_000]  # 8 ms of 12
    channels["sense_x"] = (short, "V", RATE, 0.0)
    channels["intensity"][0][::2] = 2.0
    result = reconstruct(Recording.from_arrays(channels, recording.device), Options(), told_truth(truth), quiet=True)
    assert result.trouble == [Trouble("sense_x", "missing", 0.008, 0.012)]
    assert 0.6 * 20_000 < result.dropped < 20_000
    assert result.picture.coverage.sum() <= 60_000 - result.dropped


CHANNELS = ("sense", "drive_x", "drive_y", "intensity")


def without_samples(names: Iterable[str], first: int, count: int) -> Recording:
    """The scan, ``count`` samples of the channels named lost on the way, and no gap in their time base."""
    return damaged(**{name: np.delete(values(name), np.s_[first : first + count]) for name in names})


@pytest.mark.parametrize(("names", "lost"), [(CHANNELS, 100), (CHANNELS, 2), (("sense",), 30), (("drive_x",), 5000)])
def test_lost_samples_show_as_a_leap(names: tuple[str, ...], lost: int) -> None:
    found = leaps(without_samples(names, 60_000, lost))
    assert found
    assert {each.channel for each in found} <= set(names)
    assert all(each.start < 0.012 < each.stop and each.stop - each.start < 0.006 for each in found)


def test_what_moves_evenly_does_not_leap() -> None:
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
        assert leaps(Recording.from_arrays(channels)) == []


def test_the_longest_stretch_between_leaps_is_reconstructed(whole: Reconstruction) -> None:
    first, lost = 30_000, 100
    result = of(without_samples(CHANNELS, first, lost))
    assert {each.kind for each in result.trouble} == {"leap"}
    begin = max(each.stop for each in result.trouble)
    assert result.motion.axes["x"].angle.start >= begin - 1 / RATE
    assert result.picture.coverage.sum() <= (0.02 - begin) * RATE
    assert any("leaps as where samples were lost" in note for note in result.notes)
    x, y = (result.motion.axes[axis].angle.read() for axis in "xy")
    at = round(result.motion.axes["x"].angle.start * RATE) + lost  # where these samples were in the whole scan
    turned = {}
    for angle, axis in ((x, "x"), (y, "y")):
        same = whole.motion.axes[axis].angle.read()[at : at + angle.size]
        error = angle - np.sign(angle @ same) * same  # an even capacitance does not know the sign
        assert np.sqrt(np.mean(error**2)) < 2e-3 * np.abs(angle).max()
        turned[axis] = bool(angle @ same < 0)
    own = [whole.motion.axes[axis].turned() if turned[axis] else whole.motion.axes[axis] for axis in "xy"]
    since = [axis.angle.read(first + lost, at) for axis in own]  # from the loss to what is used
    there = map_samples(*since, np.zeros(since[0].size), result.picture.grid).coverage > 0
    assert 0.2 < there.mean() < 0.9
    assert result.affected[there].mean() > 0.95  # a pixel more or less at the path's side
    assert result.affected.mean() < 0.7


@pytest.mark.parametrize("missing", [2, 300, -50])
def test_samples_lost_from_the_intensity_alone_are_found_and_put_back(whole: Reconstruction, missing: int) -> None:
    at = 45_000
    light = values("intensity")
    torn_light = np.r_[light[:at], light[at + missing :]]  # below 0: samples that come twice
    result = of(damaged(intensity=torn_light))
    (leap,) = (each for each in result.trouble if each.kind == "leap")
    assert leap.channel == "intensity"
    assert leap.start * RATE - 300 < at < leap.stop * RATE + 300
    count = f"{missing} samples lost" if missing > 0 else f"{-missing} samples too many"
    assert any(f"intensity: {count} at" in note for note in result.notes)
    assert 0 < result.affected.mean() < 0.3
    both = (result.picture.coverage > 0) & (whole.picture.coverage > 0) & ~result.affected
    assert np.mean(result.picture.image[both] == whole.picture.image[both]) > 0.99
    assert both.mean() > 0.6 * (whole.picture.coverage > 0).mean()


def test_a_sample_that_changed_is_no_loss(whole: Reconstruction) -> None:
    light = values("intensity")
    light[40_000:] = np.random.default_rng(0).permutation(light[40_000:])
    result = of(damaged(intensity=light))
    assert result.trouble == []
    assert any("sweeps agree no more" in note for note in result.notes)
    assert not any("sweeps agree no more" in note for note in whole.notes)


def test_only_what_tears_at_once_and_stays_torn_is_a_loss(whole: Reconstruction) -> None:
    turn = {axis: 2 * np.pi * np.median(whole.motion.axes[axis].frequency) / RATE for axis in "xy"}

    def seen(samples: Sequence[float], sd: float = 0.02) -> list[PhaseError]:
        return [
            PhaseError(float(i), *(Estimate(each * turn[axis], sd * turn[axis]) for axis in "xy"))
            for i, each in enumerate(samples)
        ]

    np.testing.assert_allclose(delays(seen([0.0, 3.0]), whole.motion), [0.0, 3.0])
    assert torn(seen([0.1, -0.1, 3.0, 3.0]), whole.motion) == 2
    assert torn(seen([0.0, 3.0, np.nan], np.inf), whole.motion) is None  # nothing told from the first slice on
    assert torn(seen([0.0, 0.0, 0.0, 0.0]), whole.motion) is None
    assert torn(seen([0.0, 3.0, 0.0, 0.0]), whole.motion) is None
    assert torn(seen([2.0, 2.0, 2.0]), whole.motion) is None  # a delay from the beginning on
    assert torn(seen([0.0, 0.0, 3.0]), whole.motion) is None  # no whole slice behind it


def test_the_folder_and_the_summary_say_so(tmp_path: Path) -> None:
    damaged(intensity=with_gap("intensity", 20_000, 25_000)).write(tmp_path / "a.h5")
    assert main(["reconstruct", str(tmp_path / "a.h5"), "-o", str(tmp_path / "out"), "--pixels", "100x100"]) == 0
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert summary["trouble"] == [{"channel": "intensity", "kind": "gap", "start": 0.004, "stop": 0.005}]
    affected = tifffile.imread(tmp_path / "out" / "affected.tif")
    assert affected.dtype == np.uint8
    assert set(np.unique(affected)) == {0, 1}
    assert summary["affected"] == pytest.approx(affected.mean())
    eye = cv2.imread(str(tmp_path / "out" / "image.png")).astype(int)
    grey = np.ptp(eye, axis=2) == 0
    assert not grey[affected == 1].any()
    assert grey[(affected == 0) & (tifffile.imread(tmp_path / "out" / "coverage.tif") > 0)].all()
    with h5py.File(tmp_path / "out" / "motion.h5") as motion:
        assert np.isfinite(motion["x/angle"][:]).all()


def test_ranges() -> None:
    intensity = imaging()[0]["intensity"]
    assert samples([(0.01, 0.02), (-1.0, 1e-6), (0.0, 2e-6), (0.03, 0.04)], intensity) == [(0, 10), (50_000, 100_000)]
    assert without([(0, 10), (20, 30)], [(5, 22), (28, 29)]) == [(0, 5), (22, 28), (29, 30)]


@given(st.lists(st.tuples(st.integers(0, 40), st.integers(0, 40)), max_size=6), st.integers(0, 2**32 - 1))
def test_ranges_are_sets_of_samples(pairs: list[tuple[int, int]], seed: int) -> None:
    intensity = imaging()[0]["intensity"]
    others = np.random.default_rng(seed).integers(0, 41, (3, 2)).tolist()

    def of_seconds(given: Iterable[Sequence[int]]) -> list[tuple[int, int]]:
        return samples([(min(each) / RATE, max(each) / RATE) for each in given], intensity)

    def members(ranges: list[tuple[int, int]]) -> set[int]:
        return {i for first, stop in ranges for i in range(first, stop)}

    a, b = of_seconds(pairs), of_seconds(others)
    assert members(a) == {i for each in pairs for i in range(min(each), max(each))}
    assert members(without(a, b)) == members(a) - members(b)
    assert all(one[1] < two[0] for one, two in pairwise(a))
