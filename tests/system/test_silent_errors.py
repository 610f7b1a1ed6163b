"""Wrong inputs from which a picture can be made: the report begins with what is wrong, or one line refuses them."""

from __future__ import annotations

import json
import logging
import os
from pathlib import Path

import numpy as np
import pytest
import tifffile

import lissajous
from recon.cli import main
from scanner.device import Device
from scanner.errors import BadInput
from scanner.recording import Recording
from tests.support.two_axis_scan import (
    EDGES,
    FIELD,
    FREQUENCIES_HZ,
    RATE_HZ,
    READOUTS,
    SAMPLES,
    TIME,
    angles,
    crossings,
    edges,
    light,
    reconstruct,
    sensors,
)


def test_a_right_recording_has_no_limits() -> None:
    result = reconstruct({**sensors(772002), "intensity": (light(772002), "V", RATE_HZ)}, READOUTS + FIELD)
    assert result.limits == []
    assert not any("covers little" in note or "not mapped" in note for note in result.notes)


@pytest.mark.parametrize("rate", [1.01e6, 0.993e6])
def test_a_rate_of_the_intensity_that_is_one_percent_off_is_stated(rate: float) -> None:
    result = reconstruct({**sensors(772003), "intensity": (light(772003), "V", rate)}, READOUTS + FIELD)
    assert any("those of one place at different times do not" in limit for limit in result.limits), result.limits
    assert any("a sample_rate is wrong" in note for note in result.notes)


def test_a_drive_of_combs_in_place_of_a_linear_one_is_stated() -> None:
    drives = "".join(f'[{a}.drive]\nkind = "electrostatic"\nfrequency = {f}\n' for a, f in FREQUENCIES_HZ.items())
    result = reconstruct({"intensity": (light(772004, 0.0), "V", RATE_HZ)}, drives + FIELD)
    assert sum("equals its mirror image" in limit and "check kind" in limit for limit in result.limits) == 2


def test_a_figure_that_closes_too_soon_is_named() -> None:
    drives = "".join(f'[{a}.drive]\nkind = "linear"\nfrequency = {f}\n' for a, f in (("x", 9300.0), ("y", 3110.0)))
    with pytest.raises(BadInput, match="nearly 3 : 1"):
        reconstruct({"intensity": (light(772005), "V", RATE_HZ)}, drives + FIELD)


def test_edges_that_are_all_stored_twice_are_refused() -> None:
    twice = np.sort(np.r_[crossings("x"), crossings("x") + 5e-6])
    with pytest.raises(BadInput, match="are missing; edges lie"):
        reconstruct(edges(twice, crossings("y")), EDGES)


def test_the_edges_of_one_axis_for_both_are_refused() -> None:
    with pytest.raises(BadInput, match="hold the same edges"):
        reconstruct(edges(crossings("x"), crossings("x")), EDGES)


def test_samples_after_the_last_edge_are_not_counted_as_outside_the_field() -> None:
    x = crossings("x")
    result = reconstruct(edges(x[x < 0.02], crossings("y")), EDGES)
    assert result.picture.outside == 0
    assert any("48% of the samples, the first at 0.02" in note for note in result.notes), result.notes


def test_a_clipped_position_signal_is_stated_first() -> None:
    channels = {**sensors(772006), "intensity": (light(772006), "V", RATE_HZ)}
    values, *rest = channels["sense_x"]
    result = reconstruct({**channels, "sense_x": (np.minimum(values, 1.2), *rest)}, READOUTS + FIELD)
    assert "sense_x: is clipped in 2" in "".join(result.limits[:1])


@pytest.mark.parametrize(("gain", "words"), [(0.02, "no mirror turns so far"), (30.0, "covers little")])
def test_a_wrong_gain_is_named(gain: float, words: str) -> None:
    device = READOUTS.replace("gain = 20.0", f"gain = {gain}") + FIELD
    channels = {**sensors(772007), "intensity": (light(772007), "V", RATE_HZ)}
    try:
        said = reconstruct(channels, device).notes
    except BadInput as error:
        said = [str(error)]
    assert any(words in line for line in said), said


def run(arguments: list[object], capsys: pytest.CaptureFixture) -> tuple[int, str, str]:
    capsys.readouterr()
    code = main([str(each) for each in arguments])
    captured = capsys.readouterr()
    return code, captured.out, captured.err


def test_an_unknown_key_of_the_geometry_is_noted(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    channels = {**sensors(772008), "range": (8.0 + 0.01 * light(772008), "m", RATE_HZ)}
    device = READOUTS + FIELD + "[geometry]\nincidance = 0.3\n"
    Recording.from_arrays(channels, Device.from_toml(device)).write(tmp_path / "scan.h5")
    code, out, _ = run(["point-cloud", tmp_path / "scan.h5", "-o", tmp_path / "out"], capsys)
    assert code == 0
    assert "geometry.incidance: is no key of a device" in out
    assert "by the angles alone" in out.splitlines()[0]


def table(times: np.ndarray, encoding: str = "utf-8") -> bytes:
    rows = "".join(f"{t:.9g},{k},{2 * k}\n" for k, t in enumerate(times))
    return f"Time (s),CH1 (V),CH2 (V)\n{rows}".encode(encoding)


@pytest.mark.parametrize(
    ("times", "words"),
    [
        (np.r_[TIME[:50], TIME[40:90]], "sample 50 is 9e-06 s earlier than the one before; remove what is repeated"),
        (np.r_[TIME[:50], TIME[70:120]], "sample 50 is 2.1e-05 s later than the one before, not 1e-06 s"),
        (np.repeat(TIME[:10], 10), "stated with too few digits"),
    ],
)
def test_times_that_are_no_clock_are_named_where_they_jump(
    times: np.ndarray, words: str, tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    (tmp_path / "scope.csv").write_bytes(table(times))
    convert = ["convert", tmp_path / "scope.csv", "--channel", "sense_x=CH1", "-o", tmp_path / "scan.h5"]
    code, _, err = run(convert, capsys)
    assert code == 2
    assert words in err
    assert not (tmp_path / "scan.h5").exists()


@pytest.mark.parametrize("encoding", ["utf-16", "utf-8-sig"])
def test_tables_with_a_byte_order_mark_are_read(encoding: str, tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    (tmp_path / "scope.csv").write_bytes(table(TIME[:100], encoding))
    convert = ["convert", tmp_path / "scope.csv", "--channel", "sense_x=CH2", "-o", tmp_path / "scan.h5"]
    assert run(convert, capsys)[0] == 0
    assert np.array_equal(lissajous.Recording.open(tmp_path / "scan.h5")["sense_x"].read(), 2.0 * np.arange(100))


@pytest.mark.parametrize("units", [["V", "velocity_x=deg/s"], ["velocity_x=deg/s", "V"]])
def test_a_unit_of_one_channel_overrides_that_of_all(
    units: list[str], tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    np.savez(tmp_path / "scan.npz", a=np.full(20, 180.0), b=np.ones(20))
    given = [word for unit in units for word in ("--unit", unit)]
    channels = ["--channel", "velocity_x=a", "--channel", "intensity=b", "--rate", "1e6"]
    assert run(["convert", tmp_path / "scan.npz", *channels, *given, "-o", tmp_path / "scan.h5"], capsys)[0] == 0
    assert lissajous.Recording.open(tmp_path / "scan.h5")["velocity_x"].read() == pytest.approx(np.pi)


def test_the_number_of_missing_samples_is_stated() -> None:
    channels = {**sensors(772009), "intensity": (light(772009), "V", RATE_HZ)}
    values, *rest = channels["sense_y"]
    values = np.where((TIME > 0.01) & (TIME < 0.02), np.nan, values)
    notes = reconstruct({**channels, "sense_y": (values, *rest)}, READOUTS + FIELD).notes
    assert (
        "sense_y: left out 9999 missing samples (25%) in 1 gap too long to interpolate; no angle is known there"
        in notes
    )


def film(shift: float, frames: int = 6, side: int = 64) -> np.ndarray:
    """Frames of soft spots with photon noise, whose odd lines lie ``shift`` pixels to the right of the even ones."""
    rng = np.random.default_rng(772010)
    row, column = np.mgrid[:side, :side].astype(float)
    column = column - np.where(row % 2 == 0, -0.5, 0.5) * shift * np.sqrt(1.0 - (0.8 * (2 * column / side - 1)) ** 2)
    scene = np.full((side, side), 2.0)
    for _ in range(30):
        y, x, size = *rng.uniform(0, side, 2), rng.uniform(1.5, 3.0)
        scene += rng.uniform(5.0, 40.0) * np.exp(-((row - y) ** 2 + (column - x) ** 2) / (2 * size**2))
    return rng.poisson(scene, (frames, side, side)).astype(np.int16)


def test_a_film_on_a_baseline_that_gets_worse_is_noted(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    notes = {}
    for name, baseline in (("counts", 0), ("baseline", -3000)):
        tifffile.imwrite(tmp_path / f"{name}.tif", film(4.0) + np.int16(baseline), photometric="minisblack")
        code, out, _ = run(["bidirectional", tmp_path / f"{name}.tif", "-o", tmp_path / name, "--json"], capsys)
        assert code == 0
        notes[name] = any("--values means" in note for note in json.loads(out)["notes"])
    assert notes == {"counts": False, "baseline": True}


@pytest.mark.parametrize("wrong", ["right", "turned", "saturated"])
def test_a_film_that_is_turned_or_saturated_is_noted(wrong: str, tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    frames = film(2.0)
    made = {"right": frames, "turned": frames.swapaxes(1, 2), "saturated": np.minimum(frames, 30)}[wrong]
    tifffile.imwrite(tmp_path / "film.tif", made, photometric="minisblack")
    code, out, _ = run(["bidirectional", tmp_path / "film.tif", "-o", tmp_path / "out", "--json"], capsys)
    notes = " ".join(json.loads(out)["notes"])
    assert code == 0
    assert ("transpose the frames" in notes) == (wrong == "turned")
    assert ("at the top value 30" in notes) == (wrong == "saturated")


def test_a_film_whose_lines_stand_twice_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    tifffile.imwrite(tmp_path / "film.tif", film(2.0)[:, ::2].repeat(2, axis=1), photometric="minisblack")
    code, _, err = run(["bidirectional", tmp_path / "film.tif", "-o", tmp_path / "out"], capsys)
    assert code == 2
    assert "51% of its lines equal the line before" in err  # 32 of the 63 lines that have one before


def test_a_truncated_film_is_refused_in_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture, caplog: pytest.LogCaptureFixture
) -> None:
    tifffile.imwrite(tmp_path / "film.tif", film(2.0), photometric="minisblack")
    content = (tmp_path / "film.tif").read_bytes()
    (tmp_path / "film.tif").write_bytes(content[: len(content) // 2])
    with caplog.at_level(logging.WARNING):
        code, _, err = run(["bidirectional", tmp_path / "film.tif", "-o", tmp_path / "out"], capsys)
    assert code == 2
    assert "is truncated" in err
    assert not caplog.records


def test_amplitudes_in_degrees_are_refused(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    arguments = ["new-device", "--kind", "galvo", "--amplitude-y", "4.5", "-o", tmp_path / "device.toml"]
    code, _, err = run(arguments, capsys)
    assert code == 2
    assert "--amplitude-y: is 4.5 rad" in err
    assert "0.07854 rad" in err


def test_a_killed_run_leaves_nothing_half_written(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    (tmp_path / "in").mkdir()
    channels = {**sensors(772011), "intensity": (light(772011), "V", RATE_HZ)}
    Recording.from_arrays(channels, Device.from_toml(READOUTS + FIELD)).write(tmp_path / "in" / "a.h5")
    unfinished, foreign = tmp_path / "out" / ".a.k1ll3d.part", tmp_path / "out" / ".b.other.part"
    for folder in (unfinished, foreign):
        folder.mkdir(parents=True)
        os.utime(folder, (1e9, 1e9))
    arguments = ["reconstruct", tmp_path / "in", "-o", tmp_path / "out", "--pixels", "40x40", "--workers", "1"]
    assert run(arguments, capsys)[0] == 0
    assert (tmp_path / "out" / "a" / "image.tif").exists()
    assert not unfinished.exists()
    assert foreign.exists()


def test_frames_that_were_written_one_by_one_are_one_film(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    tifffile.imwrite(tmp_path / "whole.tif", film(3.0), photometric="minisblack")
    with tifffile.TiffWriter(tmp_path / "single.tif") as file:
        for frame in film(3.0):
            file.write(frame, photometric="minisblack", contiguous=False)
    shifts = []
    for name in ("whole", "single"):
        code, out, _ = run(["bidirectional", tmp_path / f"{name}.tif", "-o", tmp_path / name, "--json"], capsys)
        assert code == 0
        shifts.append(json.loads(out)["shift_px"]["median"])
        assert tifffile.imread(tmp_path / name / "corrected.tif").shape == film(3.0).shape
    assert shifts[0] == shifts[1]


def test_frames_of_different_sizes_are_refused(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    with tifffile.TiffWriter(tmp_path / "film.tif") as file:
        for side in (64, 64, 60):
            file.write(film(3.0, 1, side)[0], photometric="minisblack", contiguous=False)
    code, _, err = run(["bidirectional", tmp_path / "film.tif", "-o", tmp_path / "out"], capsys)
    assert code == 2
    assert "holds 3 series (60x60 YX int16, 64x64 YX int16)" in err
    assert not (tmp_path / "out").exists()


def test_a_detector_that_shows_nothing_is_named() -> None:
    counts = light(772012)
    two = Recording.from_arrays(
        {**sensors(772012), "intensity": (np.column_stack([counts, 0.0 * counts]), "V", RATE_HZ)},
        Device.from_toml(READOUTS + FIELD),
        detectors=("PMT1", "PMT2"),
    )
    limits = lissajous.reconstruct(two, pixels=(40, 40)).limits
    assert limits == ["intensity, PMT2: every sample is 0: the picture shows nothing; check the detector"]


def test_a_constant_range_is_named_as_range(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    channels = {**sensors(772013), "range": (np.full(SAMPLES, 8.0), "m", RATE_HZ)}
    Recording.from_arrays(channels, Device.from_toml(READOUTS + FIELD)).write(tmp_path / "scan.h5")
    code, _, err = run(["point-cloud", tmp_path / "scan.h5", "-o", tmp_path / "out"], capsys)
    assert code == 2
    assert "range: is constant, 8 m" in err


def test_a_hysteresis_in_degrees_is_refused() -> None:
    angle = angles()["x"] - 0.03
    at = np.flatnonzero(angle[:-1] * angle[1:] < 0.0)
    times = (at - angle[at] / (angle[at + 1] - angle[at])) / RATE_HZ
    stated = {"sync_x": (times, "s", {"angle": 0.03, "hysteresis": 1.5})}
    with pytest.raises(BadInput, match=r"hysteresis is 1\.5 rad, more than the amplitude"):
        reconstruct(edges(crossings("x"), crossings("y")) | stated, EDGES)


def test_a_rate_in_megahertz_is_noted() -> None:
    channels = {name: (values, unit, 1.0) for name, (values, unit, _) in sensors(772014).items()}
    notes = reconstruct({**channels, "intensity": (light(772014), "V", 1.0)}, READOUTS + FIELD).notes
    assert sum("check the unit of time and sample_rate, 1 Hz" in note for note in notes) == 2


def test_a_diagnosis_says_what_it_did_not_test(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    channels = {**sensors(772013), "intensity": (light(772013), "V", RATE_HZ)}
    Recording.from_arrays(channels, Device.from_toml(READOUTS + FIELD)).write(tmp_path / "scan.h5")
    code, out, _ = run(["diagnose", tmp_path / "scan.h5", "-o", tmp_path / "out"], capsys)
    assert code == 0
    assert "Not tested: drive and mechanics, because the device states no mechanics." in out.splitlines()[0]
    only_x = {name: values for name, values in channels.items() if name != "sense_y"}
    device = READOUTS[: READOUTS.index("[y.")]
    Recording.from_arrays(only_x, Device.from_toml(device)).write(tmp_path / "x.h5")
    code, _, err = run(["diagnose", tmp_path / "x.h5", "-o", tmp_path / "none"], capsys)
    assert code == 2
    assert "tests nothing: the device states no mechanics" in err
