"""The sign of an axis after it nearly rested is taken from the picture, or said to be open where that shows none."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from skimage import data
from skimage.transform import resize

from recon.steps.sign_after_rest import find_rests, follow_signs
from scanner.angle_tracks import SampledAngle
from scanner.arrays import Array
from scanner.channel import Channel
from scanner.device import Device
from scanner.motion import AxisMotion, Motion
from tests.support.two_axis_scan import EDGES

RATE, DURATION, REST = 1e6, 0.04, 0.017
FREQUENCIES = {"x": 13_800.0, "y": 3_270.0}
DEVICE = Device.from_toml(EDGES)
TIME = np.arange(int(RATE * DURATION)) / RATE


def axis_motion(frequency: float, amplitude: Array, sign: str = "ambiguous") -> AxisMotion:
    """An axis of a slowly varying amplitude, whose sign is that of the motion [rad]."""
    blocks = slice(200, None, 400)
    knots = TIME[blocks]
    return AxisMotion(
        time=knots,
        phase=np.zeros(knots.size),
        amplitude=np.abs(amplitude[blocks]),
        frequency=np.full(knots.size, frequency),
        phase_sd=np.full(knots.size, 1e-3),
        angle=SampledAngle(amplitude * np.sin(2 * np.pi * frequency * TIME), RATE),
        sign=sign,
    )


def motion_of(name: str, amplitude: Array) -> Motion:
    """Motion whose axis ``name`` has an amplitude; the other's is constant."""
    amplitudes = dict.fromkeys("xy", np.full(TIME.size, 0.19)) | {name: amplitude}
    return Motion({key: axis_motion(FREQUENCIES[key], amplitudes[key]) for key in "xy"}, "tracker")


def intensity_along(motion: Motion, photons: float = 100.0, structured: bool = True) -> Channel:
    """Photon counts along a motion over a picture, or over a specimen that is the same everywhere."""
    scene = resize(data.camera().astype(float) / 255, (128, 128)) if structured else np.full((128, 128), 0.5)
    column, row = (np.clip(((motion.axes[key].angle.read() / 0.2 + 1) * 64).astype(int), 0, 127) for key in "xy")
    counts = np.random.default_rng(3).poisson(photons * scene[row, column])
    return Channel("intensity", "counts", RATE, 0.0, counts.astype(float), 0, counts.size)


def scan(name: str, photons: float = 100.0, structured: bool = True) -> tuple[Motion, Motion, Channel]:
    """True motion, whose axis ``name`` passes rest, the same with the wrong sign after it, and the intensity."""
    amplitude = 0.19 * np.minimum(1.0, np.abs(TIME - REST) / 4e-3)
    true, wrong = motion_of(name, np.where(TIME < REST, amplitude, -amplitude)), motion_of(name, amplitude)
    return true, wrong, intensity_along(true, photons, structured)


@pytest.mark.parametrize(("name", "photons"), [("x", 100.0), ("y", 100.0), ("x", 3.0)])
def test_a_sign_that_the_noise_chose_is_corrected_by_the_picture(name: str, photons: float) -> None:
    true, wrong, intensity = scan(name, photons)
    found, notes = follow_signs(wrong, DEVICE, intensity, 0.0)
    assert [note.split(":")[0] for note in notes] == [f"{name} nearly rests at 0.017 s"]
    assert "was changed" in notes[0]
    error = found.axes[name].angle.read() - true.axes[name].angle.read()
    assert np.abs(error[np.abs(TIME - REST) > 4.2e-3]).max() < 1e-3 * 0.19
    assert np.abs(error[np.abs(TIME - REST) > 1e-3]).max() < 0.05 * 0.19  # half a cycle while the amplitude grows


def test_parts_agree_with_each_other_after_a_first_part_that_is_too_short() -> None:
    """The first millisecond suggests the wrong sign for all that follows, and does not determine it."""
    early = 1e-3
    amplitude = 0.19 * np.minimum(1.0, np.minimum(np.abs(TIME - early), np.abs(TIME - REST)) / 8e-4)
    estimated = motion_of("x", amplitude)
    intensity = intensity_along(motion_of("x", np.where(early > TIME, amplitude, -amplitude)), photons=3.0)
    assert [round(time, 3) for time in find_rests(estimated.axes["x"])] == [early, REST]
    found, notes = follow_signs(estimated, DEVICE, intensity, 0.0)
    assert found is estimated
    assert notes == ["x nearly rests at 0.001 s: the picture does not show its sign after that"]


def test_a_right_sign_is_kept_without_a_note() -> None:
    true, _, intensity = scan("x")
    assert follow_signs(true, DEVICE, intensity, 0.0) == (true, [])


def test_a_sign_that_the_user_turned_is_followed_too() -> None:
    true, wrong, intensity = scan("x")
    turned = replace(wrong, axes={**wrong.axes, "x": replace(wrong.axes["x"].negated(), sign="known: --flip-x")})
    found, notes = follow_signs(turned, DEVICE, intensity, 0.0)
    assert len(notes) == 1
    error = found.axes["x"].angle.read() + true.axes["x"].angle.read()
    assert np.abs(error[np.abs(TIME - REST) > 4.2e-3]).max() < 1e-3 * 0.19


def test_a_known_sign_is_not_questioned() -> None:
    _, wrong, intensity = scan("x")
    known = replace(wrong, axes={**wrong.axes, "x": replace(wrong.axes["x"], sign="known: sync edges")})
    assert follow_signs(known, DEVICE, intensity, 0.0) == (known, [])


def test_a_specimen_without_structure_shows_no_sign() -> None:
    _, wrong, intensity = scan("x", structured=False)
    found, notes = follow_signs(wrong, DEVICE, intensity, 0.0)
    assert found is wrong
    assert notes == ["x nearly rests at 0.017 s: the picture does not show its sign after that"]


def test_a_start_from_rest_separates_no_parts() -> None:
    rising = axis_motion(13_800.0, 0.19 * (1.0 - np.exp(-TIME / 5e-3)))
    assert find_rests(rising) == []
