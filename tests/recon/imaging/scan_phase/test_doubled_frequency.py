"""Edges of both directions that are stated as those of one: the picture shows it where nothing else does."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from estimation.sync.checks import check_one_direction
from phantoms.optics import sample_scene
from phantoms.sync import SyncDetector, sync_edges
from phantoms.targets import make_target
from recon.cli import main
from scanner.arrays import Array
from scanner.device import Device
from scanner.edges import make_edges
from scanner.errors import BadInput
from scanner.recording import Recording

RATE_HZ, SAMPLES = 1e6, 60_000
FREQUENCY_HZ = {"x": 3127.0, "y": 911.0}
FIELD = Device.from_toml("[x]\n[y]\n[scan]\nhalf_angle_x = 0.1\nhalf_angle_y = 0.1\n")
TIME = np.arange(SAMPLES) / RATE_HZ


def crossings(angle: Array, both: bool, seed: int) -> Array:
    """Edge times of a detector exactly in the centre: of both directions, or upward."""
    times = sync_edges(angle, RATE_HZ, SyncDetector(jitter=2e-8), np.random.default_rng(seed))
    return times if both else times[np.interp(times, TIME, np.gradient(angle)) > 0.0]


def report(tmp_path: Path, target: str, both: str, seed: int, capsys: pytest.CaptureFixture) -> str:
    """Output of the command for edges of both axes, of which those of ``both`` have both directions."""
    rng = np.random.default_rng(seed)
    angle = {axis: 0.1 * np.sin(rng.uniform(0, 6.0) + 2 * np.pi * f * TIME) for axis, f in FREQUENCY_HZ.items()}
    scene = make_target(target, (256, 256))
    light = sample_scene(scene / scene.max(), angle["x"] / 0.1, angle["y"] / 0.1, 1.0, 1.0)
    channels: dict[str, tuple[Any, ...]] = {
        "intensity": (rng.poisson(50.0 * np.maximum(light, 0.0)).astype(float), "V", RATE_HZ)
    }
    for axis in "xy":
        times = crossings(angle[axis], axis == both, seed)
        channels[f"sync_{axis}"] = (times, "s", {"event": "zero-crossing-up"})
    Recording.from_arrays(channels, FIELD).write(tmp_path / "scan.h5")
    assert main(["reconstruct", str(tmp_path / "scan.h5"), "-o", str(tmp_path / "out"), "--pixels", "60x60"]) == 0
    return capsys.readouterr().out


@pytest.mark.slow
@pytest.mark.parametrize("axis", ["x", "y"])
def test_both_directions_stated_as_one_are_named_from_the_picture(
    axis: str, tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    text = report(tmp_path, "usaf_bars", axis, 1, capsys)
    f = FREQUENCY_HZ[axis]
    assert text.startswith(f"{axis}: samples of one place agree in every second period only")
    assert f"as if {axis} moved at {f:.0f}" in text
    assert f"sync_{axis} states zero-crossing-up" in text


@pytest.mark.slow
@pytest.mark.parametrize("target", ["retina", "cell", "siemens_star"])
def test_right_edges_of_one_direction_pass(target: str, tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    text = report(tmp_path, target, "", 2, capsys)
    assert "every second period" not in text
    assert "both-edges" not in text


@pytest.mark.parametrize("step", [0.0, 1e-6])
def test_one_direction_does_not_alternate_even_where_a_clock_rounds_it(step: float) -> None:
    """A period of 100.5 clock steps alternates between 100 and 101."""
    times = 1e-4 * np.arange(400.0) if not step else np.floor(100.5 * np.arange(400.0)) * step
    check_one_direction(make_edges("sync_x", times, {"unit": "s", "event": "zero-crossing-up"}))
    late = np.where(np.arange(400) % 2, 3e-6, 0.0)
    both = make_edges("sync_x", times + late, {"unit": "s", "event": "zero-crossing-down"})
    with pytest.raises(BadInput, match="alternate between"):
        check_one_direction(both)
