"""The measured AFM spiral through converter, sensors and grid; a synthetic one of known pitch beside it."""

from __future__ import annotations

import sys
import warnings
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.io import savemat

from recon.mapping import Grid, map_samples
from scanner.recording import Recording

ROOT = Path(__file__).parents[1]
MEASURED = ROOT / "../shared/data/afm_spiral"
V_PER_UM = 0.04 / 3
PITCH = 2.886  # um by the sensors' nominal scale, as in the measured scan

sys.path.insert(0, str(ROOT / "examples"))


@pytest.fixture(scope="module")
def example() -> ModuleType:
    import afm_spiral

    return afm_spiral


def height(x: np.ndarray, y: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """A tilted grating with a grain of dust, in volts, under noise; x and y in um."""
    lines = np.cos(2 * np.pi / PITCH * (np.cos(0.07) * x + np.sin(0.07) * y) + 0.4) > 0.1
    dust = np.hypot(x + 1.1, y + 0.8) < 0.3
    return 1e-4 * (20 * lines + 50 * dust + 3 * x - 2 * y + rng.normal(0, 5, x.shape))


def synthetic(folder: Path) -> Path:
    """Files like the measured ones: a clockwise spiral whose centre creeps, and a raster scan."""
    rng = np.random.default_rng(3)
    time = np.arange(64000) / 20e3
    angle = -2 * np.pi * 20 * time - 0.9
    x = 1.6 * time * np.cos(angle) - 0.1 + 0.03 * time**2
    y = 1.6 * time * np.sin(angle) - 0.5 + 0.08 * time**2
    volts = {"x": 0.0625 + V_PER_UM * x, "y": -0.0085 + V_PER_UM * y}
    savemat(folder / "spiral_20hz.mat", {**volts, "z": height(x, y, rng)})
    x, y = (each.ravel() for each in np.meshgrid(np.linspace(-5, 5, 510), np.linspace(-6, 6, 128)))
    savemat(folder / "raster_20hz.mat", {"x": V_PER_UM * x, "y": V_PER_UM * y, "z": height(x, y, rng)})
    return folder


@pytest.fixture(params=["synthetic", "measured"])
def scans(request: pytest.FixtureRequest, tmp_path: Path) -> Path:
    if request.param == "measured":
        if MEASURED.is_dir():
            return MEASURED
        warnings.warn("the measured AFM scans are not beside this checkout; synthetic ones stand in", stacklevel=1)
    return synthetic(tmp_path)


def test_sensors_show_straight_lines_and_the_commanded_spiral_bends_them(
    example: ModuleType, scans: Path, tmp_path: Path
) -> None:
    out = tmp_path / "out"
    example.convert_file(scans / "spiral_20hz.mat", example.MAPPING, out.with_suffix(".h5"))
    with Recording.open(out.with_suffix(".h5")) as measured:
        without = example.commanded(measured)
        sensors, path = example.spiral_picture(measured, measured.device)
        scan = measured.device.require_scan()
    blind, told = example.spiral_picture(without, without.device)
    for xy in (path, told):
        assert np.all(np.abs(xy).max(axis=1) < (scan.half_angle_x, scan.half_angle_y))
    seen, unseen = example.fit_grating(sensors), example.fit_grating(blind)
    raster = example.fit_grating(example.raster_picture(scans / "raster_20hz.mat"))

    assert seen.pitch == pytest.approx(PITCH, rel=0.004)
    assert seen.pitch_sd < 0.005 * PITCH
    assert abs(raster.pitch - seen.pitch) < 2 * np.hypot(raster.pitch_sd, seen.pitch_sd)
    assert seen.bend < 0.025
    assert unseen.bend > 2 * seen.bend
    assert unseen.pitch_sd > 2 * seen.pitch_sd


def test_the_example_runs_as_its_header_says(
    example: ModuleType, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    example.main(synthetic(tmp_path), tmp_path / "out")
    printed = capsys.readouterr().out
    assert all(f"\n{name} " in printed for name in ("sensors", "commanded", "raster"))
    made = sorted(path.name for path in (tmp_path / "out").iterdir())
    assert made == ["afm_spiral.h5", "afm_spiral.png", "afm_spiral_commanded.h5"]
    with Recording.open(tmp_path / "out" / "afm_spiral_commanded.h5") as recording:
        assert recording.name == "afm-spiral-20hz-commanded"
        assert recording.device is not None


@settings(deadline=None, max_examples=30)
@given(
    st.floats(-1, 1), st.floats(-1, 1), st.floats(0.1, 10), st.floats(-3.1, 3.1), st.sampled_from([-7.0, 7.0])
)  # fmt: skip
def test_a_spiral_is_found_again(
    example: ModuleType, cx: float, cy: float, growth: float, phase: float, rate: float
) -> None:
    time = np.arange(2000) / 1000
    spiral = example.Spiral(rate, np.array([cx, cy]), growth, phase)
    path = spiral.at(time)
    np.testing.assert_allclose(np.hypot(*(path - [[cx], [cy]])), growth * time, atol=1e-9)
    found = example.fit_spiral(time, path, 7.0)
    np.testing.assert_allclose(found.at(time), path, atol=1e-6)
    assert found.rate == rate


@pytest.mark.parametrize("pitch", [2.2, 2.9, 3.6])
@pytest.mark.parametrize("tilt", [-0.3, 0.0, 1.2])
def test_the_pitch_holds_within_what_is_stated(example: ModuleType, pitch: float, tilt: float) -> None:
    rng = np.random.default_rng(int(10 * pitch))
    x, y = rng.uniform(-5, 5, (2, 30000))
    across = np.cos(tilt) * x + np.sin(tilt) * y
    value = 10 * (np.cos(2 * np.pi * across / pitch) > 0.3) + 0.4 * x + rng.normal(0, 3, x.size)
    picture = map_samples(x, y, value, Grid(64, 64, 5.0, 5.0))
    grating = example.fit_grating(picture)
    assert abs(grating.pitch - pitch) < 2 * grating.pitch_sd
    assert grating.pitch_sd < 0.012 * pitch
    assert grating.bend < 0.02
    assert 1 / np.hypot(*example.fft_wave(picture)) == pytest.approx(pitch, rel=pitch / 10 / 2)
