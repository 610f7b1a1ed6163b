"""napari shows the output folder of a reconstruction, and replaces its picture while ``--follow`` runs."""

import sys
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest

import lissajous
from lissajous import napari_live
from lissajous.napari_live import FOLLOWED_KEY, display_limits, read_folder, show_picture, watch_pictures
from lissajous.napari_reader import get_reader
from recon.imaging.picture import Grid
from recon.io.output import write_tiff
from recon.live.follow import follow_recording
from recon.steps.reconstruction import Options
from scanner.files import replacing
from tests.support.simulated import imaging

GRID = Grid(40, 30, 0.1, 0.06)


def scene(value: float, detectors: tuple[int, ...] = ()) -> np.ndarray:
    image = np.full((30, 40, *detectors), value, np.float32)
    image[:5] = np.nan
    return image


def put(folder: Path, image: np.ndarray, grid: Grid = GRID) -> None:
    """Replace the pictures of a folder as ``--follow`` does."""
    folder.mkdir(exist_ok=True)
    for name in ("image.tif", "image_sd.tif"):
        with replacing(folder / name) as path:
            write_tiff(path, image, grid)
    (folder / "image.png").touch()


@pytest.fixture
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(napari_live, "POLL_INTERVAL_S", 0.001)


def next_picture(pictures: Iterator[np.ndarray | None]) -> np.ndarray:
    return next(image for image in pictures if image is not None)


def test_the_plugin_reads_an_output_folder_and_no_other(tmp_path: Path) -> None:
    import npe2

    put(tmp_path / "out", scene(3.0))
    (tmp_path / "other").mkdir()
    manager = npe2.PluginManager.instance()
    manager.register(npe2.PluginManifest.from_file(Path(lissajous.__file__).parent / "napari.yaml"))
    try:
        ((picture, arguments, kind),) = npe2.read([str(tmp_path / "out")], stack=False)
        with pytest.raises(ValueError, match="No readers returned data"):
            npe2.read([str(tmp_path / "other")], stack=False)
    finally:
        manager.unregister("lissajous")
    np.testing.assert_array_equal(picture, scene(3.0))
    assert (arguments["name"], kind, arguments["units"]) == ("out", "image", ("mrad", "mrad"))
    assert arguments["scale"] == pytest.approx((4.0, 5.0))  # 120 mrad of 30 pixels, 200 of 40
    assert arguments["translate"] == pytest.approx((-58.0, -97.5))
    assert get_reader(str(tmp_path / "other")) is None


def test_detectors_are_layers_and_lengths_are_in_micrometres(tmp_path: Path) -> None:
    put(tmp_path / "out", scene(3.0, (2,)), Grid(40, 30, 0.1, 0.06, 1e-3))
    layers = read_folder(tmp_path / "out")
    assert [arguments["name"] for _, arguments, _ in layers] == ["out, detector 1", "out, detector 2"]
    assert layers[0][1]["units"] == ("um", "um")
    assert layers[0][1]["scale"] == pytest.approx((4.0, 5.0))  # 1 mm a rad


@pytest.mark.parametrize("unit", [1.0, 1e-12, 1e9])
def test_black_and_white_are_percentiles_in_any_unit_and_differ(unit: float) -> None:
    """Photocurrents are of picoamperes, and a picture of one value has to be shown too."""
    picture = np.linspace(1.0, 2.0, 1200, dtype=np.float32).reshape(30, 40) * np.float32(unit)
    assert display_limits(picture) == pytest.approx((1.005 * unit, 1.995 * unit))
    low, high = display_limits(np.full_like(picture, unit))
    assert low < high


def test_each_new_picture_is_shown_until_the_summary_appears(tmp_path: Path, quick: None) -> None:
    out = tmp_path / "out"
    put(out, scene(1.0))
    pictures = watch_pictures(out)
    assert np.nanmax(next_picture(pictures)) == 1.0
    assert next(pictures) is None  # nothing new
    put(out, scene(2.0))
    assert np.nanmax(next_picture(pictures)) == 2.0
    put(out, scene(3.0))
    (out / "summary.json").touch()
    assert [np.nanmax(image) for image in pictures if image is not None] == [3.0]  # and it ends


def test_a_removed_folder_ends_the_refreshing(tmp_path: Path, quick: None) -> None:
    put(tmp_path / "out", scene(1.0))
    pictures = watch_pictures(tmp_path / "out")
    next_picture(pictures)
    for path in (tmp_path / "out").iterdir():
        path.unlink()
    (tmp_path / "out").rmdir()
    assert list(pictures) == []


def test_a_picture_goes_into_the_layers_of_its_folder_alone(tmp_path: Path) -> None:
    ours, other, plain = (
        SimpleNamespace(data=None, metadata=metadata)
        for metadata in ({FOLLOWED_KEY: (str(tmp_path), 1)}, {FOLLOWED_KEY: ("elsewhere", 0)}, {})
    )
    viewer = SimpleNamespace(layers=[other, ours, plain])
    image = np.arange(24.0, dtype=np.float32).reshape(2, 3, 4)
    show_picture(viewer, tmp_path, image)
    show_picture(viewer, tmp_path, None)
    np.testing.assert_array_equal(ours.data, image[1])
    assert other.data is None
    assert plain.data is None


@pytest.mark.parametrize("finished", [True, False])
def test_the_viewer_is_refreshed_only_while_the_folder_is_followed(
    finished: bool, tmp_path: Path, quick: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    """napari's interface, as far as it is used: the open viewer, and a worker whose results come to the main thread."""
    viewer, started = SimpleNamespace(layers=[]), []

    def thread_worker(function: Callable, connect: dict) -> Callable:
        def start(*arguments: object) -> None:
            started.append((function(*arguments), connect["yielded"]))

        return start

    modules = {name: ModuleType(name) for name in ("napari", "napari.qt", "napari.qt.threading")}
    modules["napari"].current_viewer = lambda: viewer  # type: ignore[attr-defined]
    modules["napari.qt.threading"].thread_worker = thread_worker  # type: ignore[attr-defined]
    for name, module in modules.items():
        monkeypatch.setitem(sys.modules, name, module)
    out = tmp_path / "out"
    put(out, scene(1.0))
    if finished:
        (out / "summary.json").touch()
    ((data, arguments, _),) = read_folder(out)
    assert len(started) == (not finished)
    if not finished:
        viewer.layers.append(SimpleNamespace(data=data, metadata=arguments["metadata"]))
        pictures, show = started[0]
        put(out, scene(2.0))
        show(next_picture(pictures))
        assert np.nanmax(viewer.layers[0].data) == 2.0


@pytest.mark.slow
def test_frames_of_a_followed_recording_reach_the_viewer(tmp_path: Path, quick: None) -> None:
    imaging()[0].write(tmp_path / "scan.h5")
    out, shown = tmp_path / "out", []
    options = {"frame_time": 0.005, "quiet_time": 0.5, "quiet": True}
    follow = threading.Thread(
        target=follow_recording, args=(tmp_path / "scan.h5", out, Options(pixels=(50, 50))), kwargs=options
    )
    out.mkdir()
    follow.start()
    for image in watch_pictures(out):
        if image is not None:
            shown.append(image)
        if not follow.is_alive():
            break
    follow.join()
    assert shown
    assert shown[0].shape == (50, 50)
