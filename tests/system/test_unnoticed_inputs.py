"""Wrong inputs that made a plausible picture in silence, or destroyed a file: each is named."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import numpy as np
import pytest

import lissajous
from recon.cli import main
from recon.quality.overflow import count_overflows
from scanner.device import Device
from scanner.errors import BadInput
from scanner.recording import Recording
from tests.support.two_axis_scan import EDGES, FIELD, RATE_HZ, READOUTS, SAMPLES, angles, crossings, light, sensors


@cache
def channels() -> dict[str, tuple]:
    return {**sensors(776_001), "intensity": (light(776_002), "V", RATE_HZ)}


def limits_and_notes(changed: dict[str, tuple], device: str = READOUTS + FIELD) -> tuple[list[str], list[str]]:
    recording = Recording.from_arrays(changed, Device.from_toml(device))
    result = lissajous.reconstruct(recording, pixels=(60, 60))
    return result.limits, result.notes


def refused(arguments: list[str], words: str, capsys: pytest.CaptureFixture) -> None:
    capsys.readouterr()
    assert main(arguments) == 2
    lines = [line for line in capsys.readouterr().err.splitlines() if line.startswith("lissajous ")]
    assert len(lines) == 1
    assert words in lines[0]


def test_a_right_recording_gets_none_of_these_lines() -> None:
    limits, notes = limits_and_notes(channels())
    assert limits == []
    assert all(note.startswith("the sign of") for note in notes)


@pytest.mark.parametrize("name", ["sense_x", "intensity"])
def test_a_converter_that_overflows_is_named(name: str) -> None:
    values = channels()[name][0]
    codes = np.round(values / np.ptp(values) * 350.0).astype(np.int64).astype(np.uint8)
    limits, _ = limits_and_notes({**channels(), name: (codes.astype(float) / 100.0, "V", RATE_HZ)})
    assert any(line.startswith(f"{name}: jumps ") and "overflows, and the picture is wrong" in line for line in limits)


def test_rare_photons_do_not_overflow() -> None:
    for seed in range(3):
        counts = np.random.default_rng(seed).poisson(0.015, 200_000).astype(float)
        assert counts.max() == 2.0
        assert count_overflows(counts) == 0


def test_only_overflows_jump_from_one_end_to_the_other_and_back() -> None:
    rng, time = np.random.default_rng(776_003), np.arange(100_000)
    sine = np.sin(2 * np.pi * time / 500.0)
    assert count_overflows(np.mod(1.3 * sine + 1.0, 2.0)) > 100
    pulses = np.where(rng.random(time.size) < 0.02, rng.exponential(1.0, time.size), 0.01 * rng.normal(size=time.size))
    others = {
        "sine": sine,
        "square wave": np.sign(sine),
        "sawtooth": np.mod(time / 500.0, 1.0),
        "pulses": pulses,
        "few counts": rng.poisson(0.3, time.size).astype(float),
        "noise": rng.normal(size=time.size),
        "no samples": np.full(9, np.nan),
        "constant": np.ones(9),
        "two levels in noise": 5.0 * (np.sin(time / 7.0) > 0.9) + 0.01 * rng.normal(size=time.size),
    }
    for name, values in others.items():
        assert count_overflows(values) == 0, name


@pytest.mark.parametrize("noise", ["samples in another order", "exponential", "normal"])
def test_an_intensity_that_does_not_belong_to_the_scan_is_named(noise: str) -> None:
    for seed in range(776_010, 776_014):
        rng = np.random.default_rng(seed)
        values = {
            "samples in another order": rng.permutation(channels()["intensity"][0]),
            "exponential": rng.exponential(1.0, SAMPLES),
            "normal": rng.normal(1.0, 0.1, SAMPLES),
        }[noise]
        limits, _ = limits_and_notes({**channels(), "intensity": (values, "V", RATE_HZ)})
        assert any("noise" in line for line in limits), (noise, limits)


def test_a_faint_specimen_is_not_called_noise() -> None:
    rng = np.random.default_rng(776_020)
    photons = rng.poisson(0.05 + 0.3 * channels()["intensity"][0]).astype(float)
    limits, _ = limits_and_notes({**channels(), "intensity": (photons, "count", RATE_HZ)})
    assert limits == []


def test_an_intensity_too_slow_for_the_motion_is_noted() -> None:
    slow = channels()["intensity"][0].reshape(-1, 50).mean(axis=1)
    _, notes = limits_and_notes({**channels(), "intensity": (slow, "V", RATE_HZ / 50)})
    (line,) = [note for note in notes if "record at a higher rate" in note]
    assert line.startswith("intensity: at 20000 Hz the beam moves by ")
    assert "of the field in x and" in line


def test_an_intensity_in_decibels_is_noted_and_not_called_inverted() -> None:
    level = 20.0 * np.log10(np.maximum(channels()["intensity"][0], 1e-3))
    _, notes = limits_and_notes({**channels(), "intensity": (level, "dB", RATE_HZ)})
    assert [note for note in notes if note.startswith("intensity: is in dB, and a pixel is the mean of logarithms")]
    assert not any("invert the channel" in note for note in notes)


@pytest.mark.parametrize("event", ["zero-crossing-up", "turn"])
def test_an_event_at_one_place_and_an_angle_at_another_are_refused(event: str) -> None:
    """A detector beside the centre that gives upward edges would be taken for one in the centre."""
    times = crossings("x")
    with pytest.raises(BadInput, match=f"sync_x: states event {event}, which is at the .* and a detector at 0.03 rad"):
        Recording.from_arrays({"sync_x": (times, "s", {"event": event, "angle": 0.03})}, Device.from_toml(EDGES))
    Recording.from_arrays({"sync_x": (times, "s", {"event": event, "angle": 0.0})}, Device.from_toml(EDGES))


def test_a_dead_detector_is_named(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    values = np.stack([channels()["intensity"][0], np.full(SAMPLES, np.nan)], axis=1)
    changed = {**channels(), "intensity": (values, "V", RATE_HZ)}
    Recording.from_arrays(changed, Device.from_toml(READOUTS + FIELD)).write(tmp_path / "scan.h5")
    words = "intensity: detector 1 holds no sample that can be used; leave it out"
    refused(["reconstruct", str(tmp_path / "scan.h5"), "-o", str(tmp_path / "out")], words, capsys)
    assert not (tmp_path / "out").exists()


def lock_in(late_rad: float) -> dict[str, tuple]:
    """Amplitude and phase of both axes at 10 kHz, the latter ``late_rad`` late."""
    rng, time = np.random.default_rng(776_030), np.arange(SAMPLES // 100) * 100 / RATE_HZ
    out = {"intensity": channels()["intensity"]}
    for (axis, frequency), phase in zip({"x": 1870.0, "y": 733.0}.items(), (0.4, 1.9), strict=True):
        amplitude = np.abs(angles()[axis]).max() * (1.0 + 1e-3 * rng.normal(size=time.size))
        shown = phase + 0.1 * time / time[-1] - late_rad + 1e-3 * rng.normal(size=time.size)
        about = (RATE_HZ / 100, 0.0, {"reference": frequency})
        out |= {f"amplitude_{axis}": (amplitude, "rad", *about), f"phase_{axis}": (shown, "rad", *about)}
    return out


def test_a_lock_in_amplifier_of_the_cosine_is_named() -> None:
    limits, notes = limits_and_notes(lock_in(0.0), EDGES)
    assert limits == []
    assert not any("is not used" in note for note in notes)
    limits, _ = limits_and_notes(lock_in(0.5 * np.pi), EDGES)
    for axis, line in zip("xy", limits, strict=True):
        assert line.startswith(f"{axis}: forward and backward half-periods disagree")
        assert f"check unit, sign and reference of phase_{axis}, which belongs to the sine" in line


def test_a_controlled_amplitude_is_constant_and_one_of_zero_is_refused() -> None:
    held = lock_in(0.0)
    for axis in "xy":
        amplitude, *about = held[f"amplitude_{axis}"]
        held[f"amplitude_{axis}"] = (np.full(amplitude.size, amplitude.mean()), *about)
    limits, _ = limits_and_notes(held, EDGES)
    assert limits == []
    with pytest.raises(BadInput, match="amplitude_y: is 0 throughout; check that it was connected"):
        limits_and_notes({**held, "amplitude_y": (0.0 * held["amplitude_y"][0], *held["amplitude_y"][1:])}, EDGES)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda r: np.where(np.arange(r.size) % 3 == 0, 65.535, r), "33% of the values are exactly 65.535 m"),
        (lambda r: 2.0 * r / 3e8, "not a time of flight"),
        (lambda r: r, None),
    ],
)
def test_ranges_that_are_no_distances_are_noted(change, words: str | None) -> None:  # type: ignore[no-untyped-def]
    from recon.point_cloud import make_point_cloud
    from recon.steps.reconstruction import Options

    ranges = change(8.0 + 0.01 * np.random.default_rng(776_040).normal(size=SAMPLES))
    made = {**sensors(776_041), "range": (ranges, "m", RATE_HZ)}
    notes = make_point_cloud(Recording.from_arrays(made, Device.from_toml(READOUTS + FIELD)), Options(), True).notes
    found = [note for note in notes if note.startswith("range:")]
    assert len(found) == (words is not None)
    assert words is None or words in found[0]


def test_no_command_overwrites_what_it_reads(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    table = tmp_path / "scope.csv"
    table.write_text("Time (s),CH1 (V)\n" + "".join(f"{k}e-6,{k}\n" for k in range(30)), encoding="utf-8")
    device = tmp_path / "device.toml"
    assert main(["new-device", "--kind", "parametric", "-o", str(device)]) == 0
    before = table.read_bytes(), device.read_bytes()
    words = "is read by this command and would be overwritten; name another with -o"
    refused(["convert", str(table), "--channel", "sense_x=CH1", "-o", str(table)], words, capsys)
    refused(["simulate", "--device", str(device), "-o", str(device)], words, capsys)
    assert before == (table.read_bytes(), device.read_bytes())


def test_times_of_day_are_named_as_no_numbers(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    lines = "".join(f"12:00:00.{k:06d},{k}\n" for k in range(40))
    (tmp_path / "log.csv").write_text("Time,CH1 (V)\n" + lines, encoding="utf-8")
    words = "holds no table of numbers: in line 2 '12:00:00.000000' is no number"
    refused(
        ["convert", str(tmp_path / "log.csv"), "--channel", "sense_x=CH1", "-o", str(tmp_path / "o")], words, capsys
    )


def test_combs_driven_at_the_resonance_are_refused(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    known = ["--resonance-x", "10000", "--drive-frequency-x", "10000"]
    words = "combs move the mirror at half of that; its resonance is 10000 Hz; drive it near 20000 Hz"
    output = tmp_path / "device.toml"
    refused(["new-device", "--kind", "parametric", *known, "-o", str(output)], words, capsys)
    assert not output.exists()
    assert main(["new-device", "--kind", "electromagnetic", *known, "-o", str(output)]) == 0


def test_a_scheduler_that_does_not_answer_leaves_nothing(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    for name in ("first", "second"):
        Recording.from_arrays(channels(), Device.from_toml(READOUTS + FIELD)).write(tmp_path / f"{name}.h5")
    for made in (False, True):
        (tmp_path / "out").mkdir() if made else None
        arguments = ["reconstruct", str(tmp_path), "-o", str(tmp_path / "out"), "--scheduler", "tcp://127.0.0.1:9"]
        refused(arguments, "no Dask scheduler answers at tcp://127.0.0.1:9", capsys)
        assert (tmp_path / "out").exists() == made


def test_a_fleet_that_is_not_there_leaves_nothing(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    refused(
        ["diagnose", "--each", str(tmp_path / "none"), "-o", str(tmp_path / "out")], "no such file or folder", capsys
    )
    assert not (tmp_path / "out").exists()
