"""``lissajous point-cloud``: rays of a mirror, points of a wall, files, bad input in one line."""

import base64
import json
import re
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from phantoms.lidar import add_ranges, measure_wall
from recon.cli import main
from recon.io.point_files import write_points
from recon.point_cloud import PointCloud, make_point_cloud
from recon.report.conclusions import conclude_point_cloud
from recon.report.point_cloud import draw_view
from recon.steps.reconstruction import Options
from scanner import devices
from scanner.device import Device
from scanner.errors import BadInput
from scanner.geometry import Geometry, locate_points, trace_rays
from scanner.recording import Recording
from tests.support.simulated import imaging

NORMAL = np.array([0.0, 0.0, 1.0])
GEOMETRIES = (
    Geometry(),
    Geometry(incidence=0.5, axis_offset=0.003, distortion=(-0.1,), magnification=1.3),
    Geometry(incidence=-0.4, incidence_plane="x", order="yx"),
    Geometry(kind="two-mirror", axis_offset=0.02),
    Geometry(kind="two-mirror", order="yx", axis_offset=0.02),
)


@pytest.mark.parametrize("geometry", GEOMETRIES)
def test_the_beam_at_rest_leaves_along_z_and_follows_small_angles(geometry: Geometry) -> None:
    zero, small = np.zeros(1), np.full(1, 1e-4)
    origin, direction, path = trace_rays(geometry, zero, zero)
    assert np.allclose(origin, 0.0)
    assert np.allclose(direction, [[0.0, 0.0, 1.0]])
    assert np.allclose(path, 0.0)
    _, by_x, _ = trace_rays(geometry, small, zero)
    _, by_y, _ = trace_rays(geometry, zero, small)
    cosine = np.cos(geometry.incidence)
    tilted = {"x": cosine, "y": 1.0} if geometry.incidence_plane == "y" else {"x": 1.0, "y": cosine}
    assert by_x[0, 0] > 0.0
    assert by_y[0, 1] > 0.0
    # an axis in the plane of incidence deflects by less than twice its angle
    assert by_x[0, 0] == pytest.approx(2e-4 * tilted["x"] * geometry.magnification, rel=1e-3)
    assert by_y[0, 1] == pytest.approx(2e-4 * tilted["y"] * geometry.magnification, rel=1e-3)


def test_rays_of_two_mirrors_equal_those_drawn_by_hand() -> None:
    """Two galvanometers 20 mm apart: the second turns the beam from where the first one has moved it to."""
    theta = np.array([0.1])
    origin, direction, path = trace_rays(Geometry(kind="two-mirror", axis_offset=0.02), theta, np.zeros(1))
    assert np.allclose(direction, [[np.sin(0.2), 0.0, np.cos(0.2)]])
    assert np.allclose(origin, [[0.02 * np.tan(0.2), 0.0, 0.0]])
    assert np.allclose(path, 0.02 / np.cos(0.2) - 0.02)


def test_a_lens_is_applied_to_the_field_angle() -> None:
    geometry = Geometry(magnification=2.0, distortion=(-0.5,))
    _, direction, _ = trace_rays(geometry, np.array([0.1]), np.zeros(1))
    assert np.arctan2(direction[0, 0], direction[0, 2]) == pytest.approx(2.0 * 0.2 * (1.0 - 0.5 * 0.2**2))


def lidar(geometry: Geometry, every: int = 20) -> tuple[Recording, np.ndarray]:
    """A wall 5 m away with 10 mm of noise, and the true points without it."""
    recording, truth = imaging()
    device = replace(devices.load("imaging"), geometry=geometry)
    theta = [np.asarray(truth[f"angle_{axis}"][0]) for axis in "xy"]
    exact = measure_wall(geometry, *theta, NORMAL, 5.0)
    noise = np.random.default_rng(0).normal(0.0, 0.01, exact.size)
    noisy = exact + noise
    noisy[::50] = np.nan
    points = locate_points(geometry, *theta, exact)
    return add_ranges(recording, device, noisy, every), points[::every]


@pytest.mark.slow
def test_points_of_a_wall_lie_on_it(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    recording, points = lidar(Geometry(incidence=0.5, axis_offset=0.003, range_sd=0.01), every=21)
    recording.write(tmp_path / "lidar.h5")
    assert main(["point-cloud", str(tmp_path / "lidar.h5"), "-o", str(tmp_path / "out"), "--json"]) == 0
    summary = json.loads(capsys.readouterr().out)
    assert {path.name for path in (tmp_path / "out").iterdir()} == {"points.pcd", "summary.json", "report.html"}
    assert summary["without_return"] > 0
    assert summary["points"] + summary["without_return"] + summary["unlocated"] == summary["shots"]
    from pypcd4 import PointCloud

    cloud = PointCloud.from_path(tmp_path / "out" / "points.pcd")
    z, time = (np.asarray(cloud.pc_data[name]) for name in ("z", "time"))
    assert len(z) == summary["points"]
    assert time.dtype == np.float64
    cosine = np.abs(points[:, 2] / np.linalg.norm(points, axis=1)).mean()
    assert np.std(z - 5.0) < 1.05 * 0.01
    assert np.std(z - 5.0) > 0.9 * 0.01 * cosine
    sd = np.sqrt(cloud.pc_data["cov_zz"])
    assert np.mean(np.abs(z - 5.0) < 1.96 * sd) == pytest.approx(0.95, abs=0.02)


def test_a_range_without_return_that_las_cannot_hold_is_refused(tmp_path: Path) -> None:
    far = SimpleNamespace(position=np.array([[0.0, 0.0, 5.0], [0.0, 0.0, 2.0**32 / 1000.0]]))
    with pytest.raises(BadInput, match=r"4.295e\+06 m away.*remove ranges without a return"):
        write_points(tmp_path / "points.las", far, "las")  # type: ignore[arg-type]
    assert not (tmp_path / "points.las").exists()


@pytest.mark.slow
def test_las_holds_time_and_intensity(tmp_path: Path) -> None:
    import laspy

    recording, _ = lidar(Geometry(), every=40)
    recording.write(tmp_path / "lidar.h5")
    assert main(["point-cloud", str(tmp_path / "lidar.h5"), "-o", str(tmp_path / "out"), "--format", "las"]) == 0
    las = laspy.read(tmp_path / "out" / "points.las")
    assert np.std(las.z - 5.0) < 1.1 * 0.01
    assert (np.diff(las.gps_time) > 0).all()
    assert np.asarray(las["value"]).std() > 0.0
    assert np.asarray(las.intensity).max() == 65535


@pytest.mark.slow
def test_recordings_without_intensity_are_used() -> None:
    recording, _ = lidar(Geometry(), every=5)
    channels = {name: c for name, c in recording.channels.items() if name != "intensity"}
    cloud = make_point_cloud(replace(recording, channels=channels), Options(), quiet=True)
    assert np.isnan(cloud.intensity).all()
    assert np.std(cloud.position[:, 2] - 5.0) < 1.1 * 0.01
    late = {**channels, "range": replace(channels["range"], start=5.0)}
    with pytest.raises(BadInput, match=r"no return at a known angle of the mirror from 5 to 5\.0"):
        make_point_cloud(replace(recording, channels=late), Options(), quiet=True)


def test_bad_input_ends_in_one_line(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    recording, _ = imaging()
    recording.write(tmp_path / "plain.h5")
    assert main(["point-cloud", str(tmp_path / "plain.h5"), "-o", str(tmp_path / "out")]) == 2
    assert "range: is not in the recording" in capsys.readouterr().err
    channels = {name: (c.read(), c.unit, c.sample_rate, c.start) for name, c in recording.channels.items()}
    for values, unit, message in (
        (np.full(1000, np.nan), "m", "no usable return"),
        (np.ones((1000, 2)), "m", "(1000, 2)"),
        (np.ones(1000), "V", "unit"),
    ):
        ranges = {"range": (values, unit, 5e4)}
        with pytest.raises(BadInput, match=re.escape(message)):
            make_point_cloud(Recording.from_arrays(channels | ranges, devices.load("imaging")), Options(), True)
    assert not (tmp_path / "out").exists()


def test_a_library_that_is_missing_is_named(
    tmp_path: Path, capsys: pytest.CaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "pypcd4", None)
    monkeypatch.setattr("recon.io.point_files.find_spec", lambda name: None)
    assert main(["point-cloud", str(tmp_path / "any.h5"), "-o", str(tmp_path / "out")]) == 2
    assert "lissajous[points]" in capsys.readouterr().err


def test_geometry_is_read_and_written_with_the_device() -> None:
    geometry = Geometry(incidence=0.3, order="yx", distortion=(0.1, -0.02), range_sd=0.02)
    device = replace(devices.load("imaging"), geometry=geometry)
    assert Device.from_toml(device.to_toml()).geometry == geometry
    for wrong in ('kind = "prism"', 'order = "xz"', "incidence = 45", "range_sd = -1"):
        with pytest.raises(BadInput, match="geometry"):
            Device.from_toml(f"[x.mechanics]\nJ = 1\nb = 1\nk = 1\n[geometry]\n{wrong}")


def test_the_conclusion_states_the_distance_of_the_farthest_point() -> None:
    """It lies at the edge of a wall 4 m away, not in its middle."""
    position, rows = np.array([[0.0, 0.0, 4.0], [3.0, 0.0, 4.0], [0.0, -1.0, 4.0]]), np.ones(3)
    cloud = PointCloud(rows, position, rows, 1e-6 * np.ones((3, 6)), 3, 0, 0, Geometry(), "tracker", [], [])
    assert "up to 5 m away" in conclude_point_cloud(cloud.summary(), "points.pcd")


def test_a_colour_bar_of_equal_distances_does_not_show_the_rounding_of_the_arithmetic() -> None:
    across, distance = np.linspace(-1.0, 1.0, 50), np.linspace(1.0, 1.0 + 1e-14, 50) * 2.0
    picture = draw_view(across, across, distance, "y [m]", "distance [m]")
    labels = re.findall("<!-- (.*?) -->", base64.b64decode(picture.partition(",")[2]).decode())
    assert "2.00" in labels
    assert max(map(len, labels)) == len("distance [m]")


def test_the_covariance_has_the_noise_of_sensed_angles() -> None:
    """Two angle sensors with white noise and an exact range: as many points as expected lie within two deviations."""
    rate, samples, noise_sd = 5e4, 20_000, 1e-3
    t = np.arange(samples) / rate
    true = {"x": 0.2 * np.sin(2 * np.pi * 600.0 * t + 0.3), "y": 0.2 * np.sin(2 * np.pi * 94.0 * t + 0.1)}
    distance = 10.0 + 0.5 * np.sin(20.0 * true["x"]) * np.cos(15.0 * true["y"])
    rng = np.random.default_rng(0)
    channels = {
        f"angle_{axis}": (angle + noise_sd * rng.standard_normal(samples), "rad", rate) for axis, angle in true.items()
    }
    recording = Recording.from_arrays(channels | {"range": (distance, "m", rate)}, devices.find("imaging"))
    cloud = make_point_cloud(recording, Options(estimator="sensor"), quiet=True)
    at = np.round(cloud.time * rate).astype(int)
    error = cloud.position - locate_points(cloud.geometry, true["x"][at], true["y"][at], distance[at])
    ratio = error[:, :2] / np.sqrt(cloud.covariance[:, [0, 3]])
    assert 0.93 < float(np.mean(np.abs(ratio) < 1.96)) < 0.97


def test_the_points_of_an_earlier_run_do_not_stay_beside_those_in_another_format(tmp_path: Path) -> None:
    time = np.arange(40_000) / 1e6
    x, y = (0.1 * np.sin(2.0 * np.pi * frequency * time) for frequency in (5010.0, 3030.0))
    channels = {"angle_x": (x, "rad", 1e6), "angle_y": (y, "rad", 1e6), "range": (2.0 + np.sin(60.0 * x), "m", 1e6)}
    device = Device.from_toml('[scan]\nhalf_angle_x = 0.1001\nhalf_angle_y = 0.1001\nangle = "mechanical"\n[x]\n[y]\n')
    Recording.from_arrays(channels, device).write(tmp_path / "lidar.h5")
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "points.las").write_bytes(b"of an earlier run")
    assert main(["point-cloud", str(tmp_path / "lidar.h5"), "-o", str(tmp_path / "out")]) == 0
    assert {path.name for path in (tmp_path / "out").iterdir()} == {"points.pcd", "summary.json", "report.html"}
