"""The optics of a recording judged by its own picture; what is hidden is made here, not by the terms."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

from phantoms.optics import Detector, detect, sample
from phantoms.targets import target
from recon.diagnosing import diagnose_all
from recon.diagnosis_report import diagnosis_report
from recon.mapping import Grid, map_samples
from recon.undo import placed, with_light
from scanner.device import Device
from scanner.optics import delay, gain, place
from scanner.recording import Recording

RATE, DURATION = 2e6, 0.012
TURN = {"x": 2 * np.pi * 9000.0, "y": 2 * np.pi * 2130.0}
HALF = 0.1
DEVICE = Device.from_toml("[x]\n[y]\n[scan]\nhalf_angle_x = 0.1\nhalf_angle_y = 0.1\n")


@cache
def scene(name: str) -> np.ndarray:
    return target(name)


def scan(
    name: str = "immunohistochemistry",
    late: float = 0.0,
    fade: float = 0.0,
    creep: float = 0.0,
    phase_x: float = 0.0,
    bandwidth: float | None = None,
    seed: int = 0,
) -> Recording:
    """Sensors right to 0.01 degrees, the intensity ``late`` [s]; ``fade`` and ``creep`` over it all."""
    rng = np.random.default_rng(seed)
    time = np.arange(round(RATE * DURATION)) / RATE
    start = rng.uniform(0, 2 * np.pi, 2)

    def angle(axis: str, t: np.ndarray, off: float = 0.0) -> np.ndarray:
        return HALF * np.sin(TURN[axis] * t + start["xy".index(axis)] + off)

    x = angle("x", time - late) - creep * HALF * time / DURATION
    light = sample(scene(name), x, angle("y", time - late), HALF, HALF) * np.exp(-fade * time / DURATION)
    seen = detect(light, RATE, Detector(photons_per_sample=1000.0, bandwidth_hz=bandwidth), rng)
    wrong = np.radians(0.01) * rng.normal(size=2)
    channels = {
        "angle_x": (angle("x", time, wrong[0] - phase_x), "rad", RATE, 0.0),
        "angle_y": (angle("y", time, wrong[1]), "rad", RATE, 0.0),
        "intensity": (seen, "V", RATE, 0.0),
    }
    return Recording.from_arrays(channels, DEVICE, "scan")


def test_nothing_hidden_draws_no_name() -> None:
    diagnosis = diagnose_all([scan()])
    assert diagnosis.verdict == "consistent"
    told = {(each["effect"], each["axis"]): each["told"] for each in diagnosis.optics[0]["effects"]}
    assert told["intensity-delay", "x"]
    assert not told["field-distortion", "x"]


@pytest.mark.parametrize(
    ("hidden", "effect", "value"),
    [
        ({"late": 2e-6}, "intensity-delay", 2e-6),
        ({"late": -1e-6}, "channel-delay", 1e-6),
        ({"bandwidth": 1e5}, "detector-lag", 1e5),
        ({"fade": 0.3, "name": "retina"}, "bleaching", DURATION / 0.3),
        ({"creep": 0.06}, "sample-motion", 0.06 * HALF / DURATION),
    ],
)
def test_a_hidden_effect_is_named_and_its_size_lies_within_the_interval(
    hidden: dict[str, float], effect: str, value: float
) -> None:
    (finding,) = diagnose_all([scan(**hidden)]).findings  # type: ignore[arg-type]
    low, high = finding.parameters[0].ci95
    assert (finding.effect, finding.axis) == (effect, "x")
    assert low < value < high
    assert high - low < 0.4 * value
    assert finding.heldout["after"] < 0.8 * finding.heldout["before"]


def test_a_phase_of_one_axis_is_no_delay_of_the_intensity() -> None:
    (finding,) = diagnose_all([scan(phase_x=0.05)]).findings
    assert (finding.effect, finding.axis, finding.stage) == ("unknown", "x", "timing")
    assert "deg" in finding.where


def test_a_sample_without_features_tells_nothing_and_says_so() -> None:
    recording = scan(late=2e-6)
    rng = np.random.default_rng(1)
    blank = rng.normal(0.5, 0.02, recording["intensity"].size)
    channels = {name: (recording[name].read(), "rad", RATE, 0.0) for name in ("angle_x", "angle_y")}
    diagnosis = diagnose_all([Recording.from_arrays({**channels, "intensity": (blank, "V", RATE, 0.0)}, DEVICE)])
    assert diagnosis.verdict == "consistent"
    assert not any(each["told"] for each in diagnosis.optics[0]["effects"] if each["effect"] != "bleaching")


def test_the_improved_device_brings_the_picture_back() -> None:
    """Two effects at once, found, written, read back and undone: what is left is the noise of the picture."""
    hidden, clean = scan(late=2e-6, fade=0.3), scan()
    diagnosis = diagnose_all([hidden])
    device = Device.from_toml(diagnosis.device.to_toml())
    assert (
        {each.effect for each in diagnosis.findings} == {"intensity-delay", "bleaching"} == set(device.axis("x").terms)
    )
    assert "cannot tell" in diagnosis_report(diagnosis, ["scan"])
    assert delay(device, 1 / RATE) == pytest.approx(2e-6, rel=0.1)

    grid = Grid(80, 80, HALF, HALF)
    x, y = clean["angle_x"].read(), clean["angle_y"].read()
    truth = map_samples(x, y, clean["intensity"].read(), grid).image
    light = with_light(hidden, device)["intensity"]
    early = np.interp(light.time(), clean["angle_x"].time(), x), np.interp(light.time(), clean["angle_y"].time(), y)
    undone = map_samples(*early, light.read(), grid).image
    wrong = map_samples(x, y, hidden["intensity"].read(), grid).image
    assert np.nanstd(undone - truth) < 0.35 * np.nanstd(wrong - truth)


def test_optics_terms_of_a_device_act_on_place_and_light() -> None:
    terms = "[x.terms.sample-motion]\nv = 0.5\n[x.terms.bleaching]\ntau = 0.1\n[x.terms.detector-lag]\nf_c = 1e5\n"
    device = Device.from_toml(f"[x]\n[y]\n[y.terms.field-distortion]\nc3 = 2.0\n{terms}")
    time = np.arange(1000) / RATE
    angle = np.linspace(-0.1, 0.1, 1000)
    np.testing.assert_allclose(place(device, "x", angle, time), angle - 0.5 * time)
    np.testing.assert_allclose(place(device, "y", angle, time), angle + 2.0 * angle**3)
    np.testing.assert_allclose(gain(device, time), np.exp(-time / 0.1), rtol=1e-3)
    assert delay(device, 1 / RATE) == pytest.approx(1 / (2 * np.pi * 1e5), rel=0.02)


def test_the_beam_s_place_is_made_as_it_is_read() -> None:
    from estimation.estimate import estimate

    device = Device.from_toml("[x]\n[x.terms.sample-motion]\nv = 0.5\n[y]\n")
    recording = scan()
    motion = estimate(recording, device)
    track, mirror = placed(motion, device, 0.0).axes["x"].angle, motion.axes["x"].angle
    np.testing.assert_allclose(track.read(100, 200), mirror.read(100, 200) - 0.5 * np.arange(100, 200) / RATE)
    assert track.values.size == mirror.size
    assert placed(motion, device, 0.0).axes["y"] is motion.axes["y"]
