"""A field of view that does not fit the motion: refused, or stated in a note."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from recon.cli import main
from recon.imaging.picture import Grid, Picture
from recon.pipeline import reconstruct
from recon.report.figures import UNVISITED
from recon.steps.field_check import check_field
from recon.steps.reconstruction import Options, Reconstruction
from scanner.angle_tracks import SampledAngle
from scanner.device import Device
from scanner.errors import DeviceInvalid
from scanner.motion import AxisMotion, Motion
from scanner.recording import Recording
from scanner.stages import Scan
from tests.support.simulated import imaging


def with_field(scan: Scan | None, allow_outside: bool = False) -> Reconstruction:
    recording, _ = imaging()
    assert recording.device is not None
    device = replace(recording.device, scan=scan)
    options = Options(device=device, estimator="constant", pixels=(60, 60), allow_outside=allow_outside)
    return reconstruct(recording, options, quiet=True)


def test_most_samples_outside_are_refused_unless_allowed() -> None:
    with pytest.raises(DeviceInvalid, match=r"(9\d|100)% of the samples lie outside .*of 0\.02"):
        with_field(Scan(0.02, 0.02))
    result = with_field(Scan(0.02, 0.02), allow_outside=True)
    assert any("lie outside the field of view" in note for note in result.notes)
    assert result.picture.outside > result.picture.coverage.sum()


@pytest.mark.parametrize(
    ("half_angle", "noise_sd", "offset", "moved", "reason"),
    [
        (0.1, 0.0, 0.0, True, "the sample moved there"),
        (0.1, 0.01, 0.0, False, "the noise of the position signals moves them there"),
        (0.1, 1e-4, 0.015, False, "check offset in [x.readout] of the device"),
        (0.095, 0.01, 0.0, True, "check [scan] and the gain, unless intended"),
    ],
)
def test_the_note_on_samples_outside_names_what_moves_them(
    half_angle: float, noise_sd: float, offset: float, moved: bool, reason: str
) -> None:
    """A motion of 0.1 rad, and a picture that has lost a tenth of the samples."""
    rng = np.random.default_rng(0)
    angles = 0.1 * np.sin(2 * np.pi * np.outer([0.011, 0.0137], np.arange(20_000)))
    angles += rng.normal(0.0, noise_sd, angles.shape) if noise_sd else 0.0
    angles[0] += offset
    time, ones = np.array([0.0, 0.02]), np.ones(2)
    axes = {
        name: AxisMotion(
            time, 0 * ones, 0.1 * ones, 1e4 * ones, 0 * ones, SampledAngle(each, 1e6), angle_noise_sd=noise_sd
        )
        for name, each in zip("xy", angles, strict=True)
    }
    grid = Grid(10, 10, half_angle, half_angle)
    picture = Picture(np.zeros((10, 10), np.float32), np.full((10, 10), 180), grid, outside=2000)
    (note,) = check_field(picture, Motion(axes, "sensor", {}), False, moved)
    assert note.startswith("10% of the samples lie outside")
    assert reason in note


def test_some_samples_outside_are_noted() -> None:
    notes = with_field(Scan(0.18, 0.19)).notes
    assert any("of the samples lie outside the field of view" in note for note in notes)


@pytest.mark.parametrize(("scan", "unit"), [(Scan(10.3, 10.3), "degrees"), (Scan(180.0, 0.18), "mrad")])
def test_half_angles_in_another_unit_are_recognised(scan: Scan, unit: str) -> None:
    with pytest.raises(DeviceInvalid, match=rf"half_angle_x: is .* rad and looks like {unit}: the amplitude is"):
        with_field(scan)


def test_a_motion_that_covers_little_of_the_field_is_noted() -> None:
    assert any("covers little of the field" in note for note in with_field(Scan(1.2, 1.2)).notes)


def test_a_missing_field_is_that_of_the_motion() -> None:
    result = with_field(None)
    assert any("states no [scan]: the field is the motion's own" in note for note in result.notes)
    assert result.picture.outside < 0.05 * result.intensity.size


def test_a_sensor_with_an_offset_is_noted_and_its_whole_motion_shown() -> None:
    """A position sensor whose offset the device file leaves out, and no field."""
    rate, turns = 10_000.0, 2 * np.pi * np.arange(20_000) / 10_000.0
    device = Device.from_toml("".join(f'[{a}.readout]\nkind = "position"\ngain = 1.0\nnoise_sd = 1e-3\n' for a in "xy"))
    noise = np.random.default_rng(2).normal(0.0, 1e-3, (2, turns.size))
    channels = {
        "sense_x": (0.5 + 0.1 * np.sin(40.0 * turns) + noise[0], "V", rate),
        "sense_y": (0.1 * np.sin(31.0 * turns) + noise[1], "V", rate),
        "intensity": (np.random.default_rng(3).poisson(20.0, turns.size).astype(float), "", rate),
    }
    result = reconstruct(Recording.from_arrays(channels, device), Options(pixels=(60, 60)), quiet=True)
    (note,) = (note for note in result.notes if "centred" in note)
    assert note.startswith("x is centred at +0.5 rad, and moves by ±0.1")
    assert "check offset in [x.readout]" in note
    assert result.picture.outside < 0.05 * turns.size
    assert not any("centred" in note for note in with_field(Scan(0.18, 0.18)).notes)


@pytest.mark.parametrize("fill", [[], ["--fill", "2"]])
def test_image_png_shows_unvisited_pixels_unless_filling_is_asked_for(fill: list[str], tmp_path: Path) -> None:
    imaging()[0].slice(0.0, 0.005).write(tmp_path / "scan.h5")
    out = tmp_path / "out"
    arguments = ["reconstruct", str(tmp_path / "scan.h5"), "-o", str(out), "--pixels", "200x200", *fill]
    assert main([*arguments, "--estimator", "constant"]) == 0
    image = cv2.imread(str(out / "image.png"))[..., ::-1]
    blue = np.frombuffer(bytes.fromhex(UNVISITED[1:]), np.uint8)
    unvisited = np.mean((image == blue).all(axis=-1))
    page = (out / "report.html").read_text(encoding="utf-8")
    if fill:
        assert unvisited < 0.1
        assert "unvisited pixels within 2 px of a visited one filled" in page
    else:
        assert unvisited > 0.3
        assert "not filled; blue: pixels never visited" in page


@pytest.mark.filterwarnings("error")
def test_a_wrong_rate_of_the_intensity_is_named_where_nearly_no_sample_is_mapped() -> None:
    """At 1 kHz in place of 1 MHz, all samples at known angles are at one place of the motion, outside the field."""
    rate, time = 1e6, np.arange(100_000) / 1e6
    angles = {
        f"angle_{name}": (0.085 * np.cos(2 * np.pi * frequency * time), "rad", rate)
        for name, frequency in (("x", 2000.0), ("y", 835.0))
    }
    counts = np.random.default_rng(1).poisson(20.0, time.size)
    device = Device.from_toml(
        "[x.mechanics]\nJ = 1e-10\nb = 1e-8\nk = 0.0158\n[y.mechanics]\nJ = 1e-10\nb = 1e-8\nk = 0.00275\n"
        "[scan]\nhalf_angle_x = 0.08\nhalf_angle_y = 0.08\n"
    )
    recording = Recording.from_arrays({**angles, "intensity": (counts, "counts", 1e3)}, device)
    with pytest.raises(DeviceInvalid, match="a sample_rate is wrong; or: correct half_angle_x"):
        reconstruct(recording, Options(pixels=(60, 60)), quiet=True)
