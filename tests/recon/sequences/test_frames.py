"""Frames of a scan: films, OME-Zarr, movies, xarray, napari's reader."""

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import tifffile

import lissajous
from lissajous.napari_reader import get_reader
from recon.cli import main
from recon.imaging.frame_axis import FrameAxis
from recon.imaging.picture import Grid, Picture
from recon.io.ome_zarr import write_ome_zarr
from recon.pipeline import reconstruct
from recon.report.movie import draw_frame
from recon.sequences.frames import frames, write_scan_frames
from recon.steps.reconstruction import Options, Reconstruction
from scanner.device import Device
from scanner.errors import BadInput
from scanner.recording import Recording
from tests.support.simulated import imaging

OPTIONS = Options(pixels=(60, 50), frames=3, fill_radius=2, zarr=True, movie="gif")


@pytest.fixture(scope="module")
def result() -> Reconstruction:
    recording, _ = imaging()
    channels = {name: (c.read(), c.unit, c.sample_rate, c.start) for name, c in recording.channels.items()}
    light, *clock = channels["intensity"]
    channels["intensity"] = (np.stack([light, 2.0 * light], axis=1), *clock)
    both = Recording.from_arrays(channels, recording.device, detectors=("green", "red"))
    return reconstruct(both, OPTIONS, quiet=True)


def test_frames_are_written_in_every_format(result: Reconstruction, tmp_path: Path) -> None:
    write_scan_frames(tmp_path, result, OPTIONS)
    film = tifffile.imread(tmp_path / "frames.ome.tif")
    filled = tifffile.imread(tmp_path / "frames_filled.ome.tif")
    assert film.shape == filled.shape == (3, 2, 50, 60)
    assert np.isnan(filled).sum() < np.isnan(film).sum()
    visited = np.isfinite(film)
    assert np.array_equal(filled[visited], film[visited])
    import imageio.v3 as iio

    movie = iio.imread(tmp_path / "frames.gif")
    assert movie.shape[0] == 3
    assert movie.shape[2] >= 400
    import zarr

    group = zarr.open_group(tmp_path / "frames.ome.zarr", mode="r")
    stored = np.asarray(group["0"])
    assert np.array_equal(stored[:, :2], film, equal_nan=True)
    assert np.array_equal(stored[:, 2:], tifffile.imread(tmp_path / "frames_sd.ome.tif"), equal_nan=True)
    labels = [channel["label"] for channel in group.attrs["ome"]["omero"]["channels"]]
    assert labels == ["green", "red", "green, standard deviation", "red, standard deviation"]


@pytest.mark.parametrize("missing", [0.4, 0.6, 1.0])
def test_the_last_frame_holds_a_sample_wherever_the_frames_end(
    result: Reconstruction, tmp_path: Path, missing: float
) -> None:
    size, rate = result.intensity.size, result.intensity.sample_rate
    options = replace(OPTIONS, frames=None, frame_time=(size - missing) / 3.0 / rate, fill_radius=0, zarr=False)
    spans = write_scan_frames(tmp_path, result, options).spans
    assert len(spans) == (3 if missing < 0.5 else 4)
    assert spans[-1][1] == size
    assert all(begin < end for begin, end in spans)


@pytest.mark.parametrize("kind", ["mean", "kernel", "posterior"])
def test_a_frame_without_samples_is_empty(kind: str) -> None:
    rate, size = 1e6, 120_000
    time = np.arange(size) / rate
    x, y = (0.1 * np.sin(2.0 * np.pi * f * time) for f in (5010.0, 3030.0))
    light = 1.0 + 0.5 * np.sin(60.0 * x) * np.cos(45.0 * y) + 0.05 * np.random.default_rng(0).standard_normal(size)
    light[size // 3 : 2 * size // 3] = np.nan
    device = Device.from_toml('[scan]\nhalf_angle_x = 0.1001\nhalf_angle_y = 0.1001\nangle = "mechanical"\n[x]\n[y]\n')
    angles = {"angle_x": x, "angle_y": y, "intensity": light}
    whole = lissajous.reconstruct(angles, device, sample_rate=rate, pixels=(40, 40), picture=kind)
    shares = [float(np.isfinite(frame.image).mean()) for frame in lissajous.frames(whole, 3)]
    assert shares == pytest.approx([1.0, 0.0, 1.0], abs=0.1)


def test_the_ome_zarr_is_valid_by_its_schema(result: Reconstruction, tmp_path: Path) -> None:
    import zarr
    from ome_zarr_models import v05 as models

    write_scan_frames(tmp_path, result, OPTIONS)
    image = models.Image.from_zarr(zarr.open_group(tmp_path / "frames.ome.zarr", mode="r"))
    (scale,) = image.attributes.ome.multiscales[0].datasets[0].coordinateTransformations
    assert scale.scale[2] == pytest.approx(2 * result.picture.grid.half_angle_y / 50)


@pytest.mark.parametrize("filled", [(), (1,), (1, 2)])
def test_the_ome_zarr_is_json_if_frames_are_empty(filled: tuple[int, ...], tmp_path: Path) -> None:
    empty = Picture(np.full((4, 4), np.nan, np.float32), np.zeros((4, 4), np.uint32), Grid(4, 4, 0.1, 0.1))
    values = {k: np.linspace(0.0, k, 16, dtype=np.float32).reshape(4, 4) for k in filled}
    pictures = [replace(empty, image=values.get(k, empty.image)) for k in range(3)]
    axis = FrameAxis("t", [0.0, 1.0, 2.0], 1.0)
    write_ome_zarr(tmp_path / "f.zarr", [(each, each.image) for each in pictures], axis)

    def refuse(constant: str) -> None:
        pytest.fail(f"{constant} is no JSON")

    text = (tmp_path / "f.zarr" / "zarr.json").read_text(encoding="utf-8")
    channel = json.loads(text, parse_constant=refuse)["attributes"]["ome"]["omero"]["channels"][0]
    assert [channel["window"][key] for key in ("start", "end")] == pytest.approx([0.0, 1.0], abs=0.01)


def test_an_mp4_shows_every_frame(result: Reconstruction, tmp_path: Path) -> None:
    write_scan_frames(tmp_path, result, replace(OPTIONS, zarr=False, movie="mp4"))
    movie = cv2.VideoCapture(str(tmp_path / "frames.mp4"))
    shown = 0
    while movie.read()[0]:
        shown += 1
    assert shown == 3


def test_a_drawn_frame_has_a_bar_and_a_time(result: Reconstruction) -> None:
    picture = next(iter(frames(result, 3)))
    dark = replace(picture, image=np.zeros((50, 60), np.float32))
    rgb = draw_frame(dark, "12.3 ms", (0.0, 1.0))
    assert rgb.shape[0] % 2 == rgb.shape[1] % 2 == 0
    bar = (rgb[-16:-11] == 255).all(axis=2).any(axis=0)
    assert 0.1 * rgb.shape[1] <= bar.sum() <= 0.26 * rgb.shape[1]
    assert (rgb[:30, :120] > 200).any()  # the text is smoothed, so that no pixel has to be white


def test_xarray_has_coordinates_and_units(result: Reconstruction) -> None:
    film = lissajous.frames(result, frame_time=0.008).to_xarray()
    assert dict(film.sizes) == {"time": 3, "y": 50, "x": 60, "detector": 2}
    assert list(film["detector"].values) == ["green", "red"]
    assert film["time"].attrs["units"] == "s"
    assert film["image"].attrs["units"] == result.intensity.unit
    half, step = result.picture.grid.half_angle_x, 2 * result.picture.grid.half_angle_x / 60
    assert film["x"].values[0] == pytest.approx(-half + step / 2)
    assert int(film["coverage"].sum()) == int(result.picture.coverage.sum())
    motion = result.motion.to_xarray()
    assert motion["phase_x"].attrs["units"] == "rad"
    assert motion["frequency_y"].dims == ("time_y",)


def test_options_of_frames_need_frames(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    for option in (["--zarr"], ["--movie", "gif"]):
        assert main(["reconstruct", str(tmp_path / "any.h5"), "-o", str(tmp_path / "out"), *option]) == 2
        assert f"{option[0]}: needs frames" in capsys.readouterr().err


@pytest.mark.parametrize(
    "options",
    [
        [],
        ["--picture", "posterior"],
        ["--frames", "3"],
        ["--follow"],
        ["--picture", "kernel", "--frame-time", "0.01"],
        ["--picture", "posterior", "--frames"],
    ],
)
def test_independent_frames_are_refused_where_frames_are_always_independent(
    options: list[str], tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    recording = str(tmp_path / "none.h5")
    command = ["reconstruct", recording, "-o", str(tmp_path / "out"), "--independent-frames"]
    assert main([*command, *options]) == 2
    assert "--independent-frames: has no effect" in capsys.readouterr().err
    assert main([*command, "--picture", "posterior", "--frames", "3"]) == 2
    assert "no such file" in capsys.readouterr().err


@pytest.mark.slow
def test_frames_by_number_and_by_time_at_once_are_refused(result: Reconstruction) -> None:
    with pytest.raises(BadInput, match="frame_time: is given beside a count"):
        frames(result, 2, frame_time=0.001)


def test_a_folder_of_frames_is_replaced(tmp_path: Path) -> None:
    recording, _ = imaging()
    recording.write(tmp_path / "scan.h5")
    arguments = ["reconstruct", str(tmp_path / "scan.h5"), "-o", str(tmp_path / "out"), "--pixels", "40x40", "--zarr"]
    for count in ("3", "2"):
        assert main([*arguments, "--frames", count]) == 0
    import zarr

    assert zarr.open_group(tmp_path / "out" / "frames.ome.zarr", mode="r")["0"].shape[0] == 2


@pytest.mark.slow
def test_napari_reads_a_recording(tmp_path: Path) -> None:
    import npe2

    manifest = npe2.PluginManifest.from_file(Path(lissajous.__file__).parent / "napari.yaml")
    (reader,) = manifest.contributions.readers
    assert reader.filename_patterns == ["*.h5"]
    recording, _ = imaging()
    recording.write(tmp_path / "scan.h5")
    manager = npe2.PluginManager.instance()
    manager.register(manifest)
    path = str(tmp_path / "scan.h5")
    try:
        layers = npe2.read([path], stack=False)
    finally:
        manager.unregister(manifest.name)
    assert [(arguments["name"], kind) for _, arguments, kind in layers] == [
        (recording.name, "image"),
        ("coverage", "image"),
        ("beam", "shapes"),
    ]
    picture, arguments, _ = layers[0]
    scan = Device.from_toml(str(recording.device_toml)).require_scan()
    assert arguments["scale"][1] * picture.shape[1] == pytest.approx(2e3 * scan.half_angle_x)
    (tmp_path / "text.h5").write_text(json.dumps({}), encoding="utf-8")
    assert get_reader(str(tmp_path / "text.h5")) is None


def test_a_posterior_frame_uses_earlier_frames_unless_they_are_independent(result: Reconstruction) -> None:
    posterior = replace(result, picture_kind="posterior")
    with_earlier, independent = (list(frames(posterior, 3, independent=alone).estimates()) for alone in (False, True))
    assert np.array_equal(with_earlier[0].picture.image, independent[0].picture.image)
    assert np.median(with_earlier[2].sd) < 0.9 * np.median(independent[2].sd)
    whole = result.picture.image
    errors = [np.nanstd(each[2].picture.image - whole) for each in (with_earlier, independent)]
    assert errors[0] < 0.8 * errors[1]
    assert np.array_equal(with_earlier[2].picture.coverage, independent[2].picture.coverage)


def test_the_noise_of_a_frame_is_not_that_of_a_scene_that_changed_later() -> None:
    """The contrast is inverted in the second half, which pairs of passes of the whole scan show as noise."""
    recording, _ = imaging()
    light = recording["intensity"].read()
    changed = np.where(np.arange(light.size) < light.size // 2, light, light.max() - light)
    sd = []
    for values in (light, changed):
        own = recording.with_channel(replace(recording["intensity"], raw=values, gain=1.0, offset=0.0))
        film = frames(reconstruct(own, Options(pixels=(60, 50)), quiet=True), 2)
        sd.append(float(np.nanmedian(next(iter(film.estimates())).sd)))
    assert sd[1] == pytest.approx(sd[0], rel=0.1)


@pytest.mark.parametrize(("name", "value"), [("count", 2.5), ("count", "3"), ("frame_time", "0.1"), ("z_step", [1e-6])])
def test_numbers_of_frames_that_are_none_are_refused(result: Reconstruction, name: str, value: object) -> None:
    with pytest.raises(BadInput, match=f"^{name}: is "):
        frames(result, **{name: value})
