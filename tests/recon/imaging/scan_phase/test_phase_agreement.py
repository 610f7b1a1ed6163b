"""Motions that the picture contradicts are named; right ones pass, whatever the scene, the noise and the waveform."""

from __future__ import annotations

import numpy as np
import pytest

from phantoms.optics import sample_scene
from phantoms.targets import make_target
from recon.imaging.scan_phase.phase_agreement import describe_contradictions, find_contradictions
from recon.pipeline import reconstruct
from recon.steps.reconstruction import Options
from scanner.angle_tracks import SampledAngle
from scanner.arrays import Array
from scanner.channel import Channel
from scanner.motion import AxisMotion, Motion
from tests.support.simulated import imaging, with_sense

RATE = 1e6
FREQUENCY = {"x": 4137.0, "y": 911.0}
TIME = np.arange(60_000) / RATE


def motion(x: Array, y: Array, frequency_x: float = FREQUENCY["x"]) -> Motion:
    axes = {}
    for name, theta, frequency in (("x", x, frequency_x), ("y", y, FREQUENCY["y"])):
        knots, zero = np.array([0.0, TIME[-1]]), np.zeros(2)
        angle = SampledAngle(theta, RATE)
        axes[name] = AxisMotion(knots, zero, np.full(2, np.abs(theta).max()), np.full(2, frequency), zero, angle)
    return Motion(axes, "sensor")


def phases() -> tuple[Array, Array]:
    return 2 * np.pi * FREQUENCY["x"] * TIME + 0.4, 2 * np.pi * FREQUENCY["y"] * TIME + 1.1


def light(x: Array, y: Array, target: str = "immunohistochemistry", photons: float = 100.0, seed: int = 0) -> Array:
    scene = make_target(target, (256, 256))
    values = sample_scene(scene / scene.max(), x, y, 1.0, 1.0)
    return np.random.default_rng(seed).poisson(photons * np.maximum(values, 0.0)).astype(float)


def channel(values: Array) -> Channel:
    return Channel("intensity", "V", RATE, 0.0, values, 0, len(values))


@pytest.mark.parametrize(
    "target", ["immunohistochemistry", "retina", "cell", "usaf_bars", "siemens_star", "point_grid"]
)
@pytest.mark.parametrize("photons", [1.0, 100.0])
def test_a_right_motion_is_not_contradicted(target: str, photons: float) -> None:
    x, y = (np.sin(phase) for phase in phases())
    assert describe_contradictions(motion(x, y), channel(light(x, y, target, photons, seed=1))) == []


def test_right_scans_that_are_no_figure_of_sines_are_not_contradicted() -> None:
    a, b = phases()
    triangle = 2 / np.pi * np.arcsin(np.sin(a)), 2 / np.pi * np.arcsin(np.sin(b))
    spiral = (TIME / TIME[-1]) * np.sin(a), (TIME / TIME[-1]) * np.cos(a)
    moving = np.sin(a), np.sin(b)
    shift = 0.08 * (TIME / TIME[-1] - 0.5)
    for x, y, moved in ((*triangle, 0.0), (*spiral, 0.0), (*moving, shift)):
        assert describe_contradictions(motion(x, y), channel(light(x + moved, y))) == []


def test_a_velocity_in_place_of_a_position_is_named_on_its_axis() -> None:
    a, b = phases()
    (line,) = describe_contradictions(motion(np.cos(a), np.sin(b)), channel(light(np.sin(a), np.sin(b))))
    assert line.startswith("x: forward and backward half-periods disagree")
    assert "check kind in [x.readout]" in line


def test_the_sign_of_an_inverted_capacitive_signal_is_named() -> None:
    inverted = with_sense(imaging()[0], np.negative)
    limits = reconstruct(inverted, Options(pixels=(100, 100)), quiet=True).limits
    assert any("the sign of a capacitive signal" in line for line in limits)


def test_half_of_the_frequency_is_named() -> None:
    a, b = phases()
    halved = motion(np.sin(a / 2), np.sin(b), FREQUENCY["x"] / 2)
    (line,) = describe_contradictions(halved, channel(light(np.sin(a), np.sin(b))))
    assert "as if x moved at 4137 Hz in place of 2068.5 Hz" in line
    assert "missing edges of sync_x" in line


def test_a_delay_is_measured_and_clocks_that_run_apart_are_named() -> None:
    a, b = phases()
    found, _ = find_contradictions(motion(np.sin(a - 0.7), np.sin(b)), channel(light(np.sin(a), np.sin(b))))
    assert [each.axis for each in found] == ["x"]
    np.testing.assert_allclose(found[0].phases, 0.7, atol=0.05)
    slow = 0.7 + 2 * np.pi * 3.0 * TIME
    (line,) = describe_contradictions(motion(np.sin(a + slow), np.sin(b)), channel(light(np.sin(a), np.sin(b))))
    assert "different during the scan" in line


def test_an_intensity_that_does_not_follow_the_place_is_named() -> None:
    x, y = (np.sin(phase) for phase in phases())
    slow = np.cumsum(np.random.default_rng(2).normal(0.0, 1.0, TIME.size))
    (line,) = describe_contradictions(motion(x, y), channel(light(x, y) + 50.0 * slow))
    assert "not mostly drift" in line


def test_noise_and_short_scans_give_no_line() -> None:
    x, y = (np.sin(phase) for phase in phases())
    noise = np.random.default_rng(3).normal(0.0, 1.0, TIME.size)
    assert describe_contradictions(motion(x, y), channel(noise)) == []
    short = slice(0, 2500)
    assert describe_contradictions(motion(x[short], y[short]), channel(light(x, y)[short])) == []
