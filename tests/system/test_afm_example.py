"""The AFM example with the measured spiral and with a synthetic one of known pitch."""

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

from recon.imaging.gridding import map_samples
from recon.imaging.picture import Grid
from scanner.recording import Recording

ROOT = Path(__file__).parents[2]
MEASURED = ROOT / "../shared/data/afm_spiral"
V_PER_UM = 0.04 / 3
PITCH_UM = 2.886  # by the nominal scale of the sensors, as in the measured scan

sys.path.insert(0, str(ROOT / "examples"))


@pytest.fixture(scope="module")
def example() -> ModuleType:
    import afm_spiral

    return afm_spiral


def height(x: np.ndarray, y: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Noisy height signal [V] of a tilted grating with a dust particle; x and y in um."""
    lines = np.cos(2 * np.pi / PITCH_UM * (np.cos(0.07) * x + np.sin(0.07) * y) + 0.4) > 0.1
    dust = np.hypot(x + 1.1, y + 0.8) < 0.3
    return 1e-4 * (20 * lines + 50 * dust + 3 * x - 2 * y + rng.normal(0, 5, x.shape))


def synthetic(folder: Path) -> Path:
    """Files like the measured ones: a clockwise spiral whose centre drifts, and a raster scan."""
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
        warnings.warn("the measured AFM scans are not available; synthetic ones are used", stacklevel=1)
    return synthetic(tmp_path)


@pytest.mark.slow
def test_lines_are_straight_with_sensors_and_curved_with_the_commanded_spiral(
    example: ModuleType, scans: Path, tmp_path: Path
) -> None:
    out = tmp_path / "out"
    example.convert_file(scans / "spiral_20hz.mat", example.MAPPING, out.with_suffix(".h5"))
    with Recording.open(out.with_suffix(".h5")) as measured:
        without = example.commanded(measured)
        sensors, path = example.spiral_picture(measured, measured.device)
        scan = measured.device.require_scan()
    commanded, commanded_path = example.spiral_picture(without, without.device)
    for xy in (path, commanded_path):
        assert np.all(np.abs(xy).max(axis=1) < (scan.half_angle_x, scan.half_angle_y))
    with_sensors, by_command = example.fit_grating(sensors), example.fit_grating(commanded)
    raster = example.fit_grating(example.raster_picture(scans / "raster_20hz.mat"))

    assert with_sensors.pitch == pytest.approx(PITCH_UM, rel=0.004)
    assert with_sensors.pitch_sd < 0.005 * PITCH_UM
    assert abs(raster.pitch - with_sensors.pitch) < 2 * np.hypot(raster.pitch_sd, with_sensors.pitch_sd)
    assert with_sensors.bend < 0.025
    assert by_command.bend > 2 * with_sensors.bend
    assert by_command.pitch_sd > 2 * with_sensors.pitch_sd


@pytest.mark.slow
def test_the_example_prints_its_table_and_writes_its_files(
    example: ModuleType, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    example.main(synthetic(tmp_path), tmp_path / "out")
    printed = capsys.readouterr().out
    assert all(f"\n{name} " in printed for name in ("sensors", "commanded", "raster"))
    written = sorted(path.name for path in (tmp_path / "out").iterdir())
    assert written == ["afm_spiral.h5", "afm_spiral.png", "afm_spiral_commanded.h5"]
    with Recording.open(tmp_path / "out" / "afm_spiral_commanded.h5") as recording:
        assert recording.name == "afm-spiral-20hz-commanded"
        assert recording.device is not None


@settings(deadline=None, max_examples=30)
@given(
    st.floats(-1, 1), st.floats(-1, 1), st.floats(0.1, 10), st.floats(-3.1, 3.1), st.sampled_from([-7.0, 7.0])
)  # fmt: skip
def test_the_parameters_of_a_spiral_are_recovered(
    example: ModuleType, cx: float, cy: float, growth: float, phase: float, rate: float
) -> None:
    time = np.arange(2000) / 1000
    spiral = example.Spiral(rate, np.array([cx, cy]), growth, phase)
    path = spiral.at(time)
    np.testing.assert_allclose(np.hypot(*(path - [[cx], [cy]])), growth * time, atol=1e-9)
    fitted = example.fit_spiral(time, path, 7.0)
    np.testing.assert_allclose(fitted.at(time), path, atol=1e-6)
    assert fitted.rate == rate


@pytest.mark.slow
@pytest.mark.parametrize("pitch", [2.2, 2.9, 3.6])
@pytest.mark.parametrize("tilt", [-0.3, 0.0, 1.2])
def test_the_pitch_error_is_within_the_stated_uncertainty(example: ModuleType, pitch: float, tilt: float) -> None:
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
