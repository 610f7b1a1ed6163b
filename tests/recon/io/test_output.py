"""Files for other programs: TIFF with pixel sizes, and the frames of a scan as OME-TIFF."""

import logging
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
import tifffile

from recon.cli import main
from recon.imaging.frame_axis import FrameAxis
from recon.imaging.gridding import map_samples
from recon.imaging.picture import Grid, Picture
from recon.io.output import check_folder, replacing_folder, write_frames, write_tiff
from recon.io.tiff_size import needs_bigtiff
from recon.pipeline import reconstruct
from recon.sequences.frames import write_scan_frames
from recon.steps.reconstruction import Options, Reconstruction
from scanner import devices
from scanner.device import Device
from scanner.errors import BadInput, line_of
from scanner.files import check_place
from tests.support.simulated import imaging

GRID = Grid(80, 60, 0.18, 0.15)
SAMPLE = replace(GRID, metres_per_radian=250e-6 / 0.36)
OME = "{http://www.openmicroscopy.org/Schemas/OME/2016-06}"


@pytest.fixture(autouse=True)
def no_warnings(caplog: pytest.LogCaptureFixture):
    """tifffile reports irregularities of a file through its logger; there must be none."""
    yield
    assert not [record for record in caplog.records if record.levelno >= logging.WARNING]


@pytest.fixture(scope="module")
def result() -> Reconstruction:
    recording, _ = imaging()
    return reconstruct(recording, Options(estimator="constant", pixels=(80, 60)), quiet=True)


def size_of(path: Path) -> tuple[float, float, str]:
    """Pixel width, height and unit, as ImageJ takes them from a file."""
    with tifffile.TiffFile(path) as file:
        assert file.is_imagej
        tags = file.pages[0].tags
        assert tags["ResolutionUnit"].value == 1  # none: the description names it
        width, height = (tags[f"{axis}Resolution"].value for axis in "XY")
        return width[1] / width[0], height[1] / height[0], file.imagej_metadata["unit"]


@pytest.mark.parametrize("dtype", [np.float32, np.uint32, np.uint8])
@pytest.mark.parametrize(("grid", "unit", "metres"), [(GRID, "rad", 1.0), (SAMPLE, "um", 1e6 * 250e-6 / 0.36)])
def test_tiff_files_state_the_pixel_size(dtype: type, grid: Grid, unit: str, metres: float, tmp_path: Path) -> None:
    image = np.arange(4800).reshape(60, 80).astype(dtype)
    if dtype is np.float32:
        image[3, 4] = np.nan
    path = tmp_path / "image.tif"
    write_tiff(path, image, grid)
    stored = tifffile.imread(path)
    assert stored.dtype == dtype
    assert np.array_equal(stored, image, equal_nan=dtype is np.float32)
    width, height, named = size_of(path)
    assert named == unit
    assert (width, height) == pytest.approx((metres * 0.36 / 80, metres * 0.3 / 60), rel=1e-6)


def test_detectors_are_channels(tmp_path: Path) -> None:
    image = np.random.default_rng(0).random((60, 80, 3)).astype(np.float32)
    write_tiff(tmp_path / "image.tif", image, GRID)
    with tifffile.TiffFile(tmp_path / "image.tif") as file:
        assert file.series[0].axes == "CYX"
        assert np.array_equal(file.asarray(), np.moveaxis(image, -1, 0))


def pixels_of(path: Path) -> dict[str, str]:
    """Attributes of the one Pixels element of an OME-TIFF."""
    with tifffile.TiffFile(path) as file:
        (pixels,) = ElementTree.fromstring(file.ome_metadata).iter(f"{OME}Pixels")
    return pixels.attrib


@pytest.mark.parametrize(("options", "times"), [
    (Options(frames=4), [0.0, 0.005, 0.010, 0.015, 0.020]),
    (Options(frame_time=0.008), [0.0, 0.008, 0.016, 0.020]),
])  # fmt: skip
def test_a_frame_is_the_picture_of_its_time_interval(
    options: Options, times: list[float], result: Reconstruction, tmp_path: Path
) -> None:
    intensity = imaging()[0]["intensity"]
    path = tmp_path / "frames.ome.tif"
    write_scan_frames(tmp_path, result, options)
    frames = tifffile.imread(path)
    assert frames.shape == (len(times) - 1, 60, 80)
    assert frames.dtype == np.float32
    x, y = (result.motion.axes[axis].angle.read() for axis in "xy")
    for frame, begin, stop in zip(frames, times, times[1:], strict=False):
        part = slice(round(5e6 * begin), round(5e6 * stop))
        expected = map_samples(x[part], y[part], intensity.read()[part], result.picture.grid).image
        assert np.array_equal(frame, expected, equal_nan=True)
    assert np.array_equal(np.isnan(frames).all(0), np.isnan(result.picture.image))
    attributes = pixels_of(path)
    sizes = {"SizeT": str(len(times) - 1), "SizeX": "80", "SizeY": "60", "SizeC": "1"}
    assert {key: attributes[key] for key in sizes} == sizes
    assert float(attributes["TimeIncrement"]) == pytest.approx(times[1])
    assert attributes["TimeIncrementUnit"] == "s"
    assert "PhysicalSizeX" not in attributes  # OME has no unit for an angle


def test_frames_of_a_known_sample_and_several_detectors(tmp_path: Path) -> None:
    images = np.random.default_rng(1).random((3, 60, 80, 2)).astype(np.float32)
    path = tmp_path / "frames.ome.tif"
    write_frames(
        path,
        (Picture(each, np.ones((60, 80), np.uint32), SAMPLE) for each in images),
        FrameAxis("t", [0.0, 0.01, 0.02], 0.01),
    )
    with tifffile.TiffFile(path) as file:
        assert file.series[0].axes == "TCYX"
        assert np.array_equal(file.asarray(), images.transpose(0, 3, 1, 2))
    attributes = pixels_of(path)
    assert float(attributes["PhysicalSizeX"]) == pytest.approx(250 / 80)
    assert float(attributes["PhysicalSizeY"]) == pytest.approx(250 * 0.15 / 0.18 / 60)
    assert attributes["PhysicalSizeXUnit"] == attributes["PhysicalSizeYUnit"] == "µm"


def test_frames_beyond_4_gb_are_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert not needs_bigtiff((1000, 1000, 1000), np.float32)
    assert needs_bigtiff((1100, 1000, 1000), np.float32)
    images = np.random.default_rng(1).random((3, 60, 80)).astype(np.float32)
    for limit, is_big in ((images.nbytes, False), (images.nbytes - 1, True)):
        monkeypatch.setattr("recon.io.tiff_size.MAX_CLASSIC_TIFF_BYTES", limit)
        pictures = (Picture(each, np.ones((60, 80), np.uint32), SAMPLE) for each in images)
        write_frames(tmp_path / "frames.ome.tif", pictures, FrameAxis("t", [0.0, 0.01, 0.02], 0.01))
        with tifffile.TiffFile(tmp_path / "frames.ome.tif") as file:
            assert file.is_bigtiff == is_big
            assert file.is_ome
            np.testing.assert_array_equal(file.asarray(), images)


def test_frames_shorter_than_a_sample_are_refused(result: Reconstruction, tmp_path: Path) -> None:
    with pytest.raises(BadInput, match="fewer frames"):
        write_scan_frames(tmp_path / "frames.ome.tif", result, Options(frame_time=1e-7))
    assert not list(tmp_path.iterdir())


def test_the_command_writes_pixel_sizes_and_frames(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    recording, _ = imaging()
    text = devices.load("imaging").to_toml().replace("[scan]", "[scan]\nmetres_per_radian = 6.9e-4")
    assert Device.from_toml(text).require_scan().metres_per_radian == 6.9e-4
    assert "metres_per_radian = 0.00069" in Device.from_toml(text).to_toml()
    (tmp_path / "device.toml").write_text(text)
    recording.write(tmp_path / "scan.h5")
    command = ["reconstruct", str(tmp_path / "scan.h5"), "-o", str(tmp_path / "out"), "--estimator", "constant"]
    assert main([*command, "--device", str(tmp_path / "device.toml"), "--frames", "2"]) == 0
    assert float(pixels_of(tmp_path / "out" / "frames.ome.tif")["PhysicalSizeX"]) == pytest.approx(690 * 0.36 / 400)
    width, height, unit = size_of(tmp_path / "out" / "image.tif")
    assert unit == "um"
    assert width == height == pytest.approx(690 * 0.36 / 400, rel=1e-6)


def test_no_new_file_replaces_an_input(tmp_path: Path) -> None:
    device, other = tmp_path / "device.toml", tmp_path / "scan.h5"
    for path in (device, other):
        path.write_text("recorded", encoding="utf-8")
    with (
        pytest.raises(BadInput, match=r"device\.toml: is read by this command and would be overwritten"),
        replacing_folder(tmp_path, "chen2020", device, other) as folder,
    ):
        (folder / "device.toml").write_text("found", encoding="utf-8")
    assert {path.name: path.read_text(encoding="utf-8") for path in tmp_path.iterdir()} == {
        "device.toml": "recorded",
        "scan.h5": "recorded",
    }
    with replacing_folder(tmp_path, device, other) as folder:
        (folder / "report.html").write_text("found", encoding="utf-8")
    assert (tmp_path / "report.html").read_text(encoding="utf-8") == "found"


def test_a_disk_that_fills_during_a_write_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """NumPy states how much it wrote, in an error without a number."""
    usage = shutil.disk_usage(tmp_path)
    monkeypatch.setattr(shutil, "disk_usage", lambda path: usage._replace(free=0))
    with pytest.raises(OSError, match="No space left on device") as caught, replacing_folder(tmp_path / "out"):
        raise OSError("160000 requested and 102312 written")
    assert line_of(caught.value, "output") == f"{tmp_path / 'out'}: No space left on device"


def test_files_of_other_options_do_not_stay_beside_new_ones(tmp_path: Path) -> None:
    for name in ("image.tif", "filled.tif", "notes.txt"):
        (tmp_path / name).write_text("old", encoding="utf-8")
    (tmp_path / "frames.ome.zarr").mkdir()
    with replacing_folder(tmp_path, optional=["filled.tif", "frames.ome.zarr"]) as folder:
        (folder / "image.tif").write_text("new", encoding="utf-8")
    left = {path.name: path.read_text(encoding="utf-8") for path in tmp_path.iterdir()}
    assert left == {"image.tif": "new", "notes.txt": "old"}


@pytest.mark.parametrize("check", [check_folder, check_place])
def test_an_output_below_a_file_is_refused_as_such(check: Callable[[Path], None], tmp_path: Path) -> None:
    (tmp_path / "scan.h5").touch()
    with pytest.raises(BadInput, match=r"scan\.h5 is a file where a folder should be; name another with -o$"):
        check(tmp_path / "scan.h5" / "out")
