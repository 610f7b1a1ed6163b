"""Pictures of several recordings as one stack: planes by z, by a spacing, and repeats."""

import json
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pytest
import tifffile

from recon.cli import main
from recon.imaging.picture import Grid
from recon.io.output import write_json, write_tiff
from recon.sequences.recording_stack import read_planes, write_recording_stack
from scanner.errors import BadInput
from tests.support.stacks import lights, recording_of

GRID = Grid(40, 30, 0.1, 0.08, 1e-3)
KNOWN = {"x": "known: drive", "y": "known: drive"}


def scene(seed: int = 0) -> np.ndarray:
    values = np.random.default_rng(seed).normal(5.0, 1.0, (30, 40)).astype(np.float32)
    values[0, 3] = np.nan
    return values


def completed(
    folder: Path,
    image: np.ndarray,
    z: float | None,
    sign: Mapping[str, str] = KNOWN,
    grid: Grid = GRID,
    unit: str = "V",
) -> Path:
    """A folder as a reconstruction leaves it."""
    folder.mkdir()
    position = None if z is None else {"mean_m": z, "range_m": 0.0}
    write_json(folder / "summary.json", {
        "grid": vars(grid), "detectors": [], "intensity_unit": unit, "sign": sign, "position_z": position,
    })  # fmt: skip
    write_tiff(folder / "image.tif", image, grid)
    write_tiff(folder / "image_sd.tif", 0.1 * image, grid)
    write_tiff(folder / "coverage.tif", np.isfinite(image).astype(np.uint32), grid)
    return folder


def write(tmp_path: Path, planes: Mapping[str, Path], spacing: float | None = None, **files: object) -> dict:
    out = tmp_path / "out"
    out.mkdir()
    found = read_planes({Path(f"{name}.h5"): folder for name, folder in planes.items()})
    return write_recording_stack(out, found, spacing, **files)  # type: ignore[arg-type]


def test_planes_are_ordered_by_their_position(tmp_path: Path) -> None:
    planes = {name: completed(tmp_path / name, scene(k), z) for k, (name, z) in enumerate(
        {"a": 4e-6, "b": 2e-6, "c": 6e-6}.items()
    )}  # fmt: skip
    summary = write(tmp_path, planes)
    assert summary["recordings"] == ["b.h5", "a.h5", "c.h5"]
    assert summary["z_m"] == pytest.approx([2e-6, 4e-6, 6e-6])
    assert summary["notes"] == []
    with tifffile.TiffFile(tmp_path / "out" / "stack.ome.tif") as file:
        assert file.series[0].axes == "ZYX"
        np.testing.assert_array_equal(file.asarray(), np.stack([scene(1), scene(0), scene(2)]))
        assert 'PhysicalSizeZ="2.0' in file.ome_metadata or 'PhysicalSizeZ="1.99' in file.ome_metadata
    np.testing.assert_allclose(tifffile.imread(tmp_path / "out" / "stack_sd.ome.tif")[0], 0.1 * scene(1), rtol=1e-6)


def test_a_spacing_keeps_the_order_given(tmp_path: Path) -> None:
    planes = {name: completed(tmp_path / name, scene(k), None) for k, name in enumerate("abc")}
    summary = write(tmp_path, planes, 1e-6)
    assert summary["recordings"] == ["a.h5", "b.h5", "c.h5"]
    assert summary["z_m"] == pytest.approx([0.0, 1e-6, 2e-6])


def test_recordings_without_a_position_are_repeats(tmp_path: Path) -> None:
    planes = {name: completed(tmp_path / name, scene(k), None) for k, name in enumerate("ab")}
    summary = write(tmp_path, planes, movie="gif", zarr=True)
    assert summary["z_m"] is None
    with tifffile.TiffFile(tmp_path / "out" / "stack.ome.tif") as file:
        assert file.series[0].axes == "TYX"
        assert "TimeIncrement" not in file.ome_metadata
    written = json.loads((tmp_path / "out" / "stack.ome.zarr" / "zarr.json").read_text())
    assert written["attributes"]["ome"]["multiscales"][0]["axes"][0] == {"name": "t", "type": "time"}
    assert (tmp_path / "out" / "stack.gif").stat().st_size > 0


def test_ambiguous_signs_follow_the_plane_before(tmp_path: Path) -> None:
    signs = {"x": "ambiguous", "y": "ambiguous"}
    rng = np.random.default_rng(7)
    turns = {"a": (1, 1), "b": (1, -1), "c": (-1, 1), "d": (-1, -1)}
    planes = {
        name: completed(
            tmp_path / name,
            (scene() + rng.normal(0.0, 0.5, (30, 40)).astype(np.float32))[:: turn[0], :: turn[1]],
            1e-6 * k,
            signs,
        )
        for k, (name, turn) in enumerate(turns.items())
    }
    summary = write(tmp_path, planes)
    assert summary["mirrored"] == {"b.h5": ["x"], "c.h5": ["y"], "d.h5": ["x", "y"]}
    (note,) = summary["notes"]
    assert "b.h5 in x, c.h5 in y, d.h5 in x and y" in note
    images = tifffile.imread(tmp_path / "out" / "stack.ome.tif")
    for image in images:
        assert np.nanstd(image - scene()) < 0.6


def test_ambiguous_signs_of_first_planes_follow_the_plane_whose_signs_are_known(tmp_path: Path) -> None:
    signs = {"a": {"x": "ambiguous", "y": "ambiguous"}, "b": KNOWN | {"y": "ambiguous"}, "c": KNOWN, "d": KNOWN}
    turns = {"a": (-1, -1), "b": (-1, 1), "c": (1, 1), "d": (1, 1)}
    planes = {
        name: completed(tmp_path / name, scene()[:: turns[name][0], :: turns[name][1]], 1e-6 * k, sign)
        for k, (name, sign) in enumerate(signs.items())
    }
    assert write(tmp_path, planes)["mirrored"] == {"a.h5": ["x", "y"], "b.h5": ["y"]}
    for image in tifffile.imread(tmp_path / "out" / "stack.ome.tif"):
        np.testing.assert_array_equal(image, scene())


@pytest.mark.parametrize(
    ("changed", "line"),
    [
        ({"z": None}, "b.h5: position_z: is not in the recording; record it with every plane"),
        ({"z": 1e-6}, "b.h5: position_z: is 1e-06 m, as that of a.h5"),
        ({"unit": "mV"}, "b.h5: --stack: has an intensity in 'mV', and a.h5 in 'V': they are no stack"),
        ({"grid": Grid(40, 30, 0.11, 0.08, 1e-3)}, "has half angles of 110 x 80 mrad, and a.h5 of 100 x 80 mrad"),
    ],
)
def test_what_is_no_stack_is_refused_in_a_line(tmp_path: Path, changed: dict, line: str) -> None:
    planes = {
        "a": completed(tmp_path / "a", scene(), 1e-6),
        "b": completed(tmp_path / "b", scene(), **({"z": 2e-6} | changed)),
    }
    with pytest.raises(BadInput) as caught:
        write(tmp_path, planes)
    assert line in str(caught.value)
    assert "\n" not in str(caught.value)


def test_z_that_moves_within_a_recording_is_noted(tmp_path: Path) -> None:
    planes = {name: completed(tmp_path / name, scene(), z) for name, z in {"a": 1e-6, "b": 2e-6}.items()}
    path = planes["b"] / "summary.json"
    path.write_text(path.read_text().replace('"range_m": 0.0', '"range_m": 8e-07'))
    (note,) = write(tmp_path, planes)["notes"]
    assert note.startswith("b.h5: position_z moves by 0.8 µm, and planes are 1 µm apart")


@pytest.mark.slow
def test_the_command_stacks_a_folder_of_recordings(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder, out = tmp_path / "planes", tmp_path / "out"
    folder.mkdir()
    for k, light in enumerate(lights()):
        recording_of(light, np.full(100, 3e-6 - 1e-6 * k)).slice(0.0, 0.02).write(folder / f"{k}.h5")
    arguments = [str(folder), "-o", str(out), "--pixels", "60x60", "--workers", "2"]
    assert main(["reconstruct", *arguments, "--stack"]) == 0
    printed = capsys.readouterr().out
    assert "stack of 3 slices 1 µm apart, from z = 1.00 µm to 3.00 µm: " in printed
    images = tifffile.imread(out / "stack.ome.tif")
    summary = json.loads((out / "summary.json").read_text())
    assert summary["stack"]["recordings"] == ["2.h5", "1.h5", "0.h5"]
    np.testing.assert_array_equal(images[0], tifffile.imread(out / "2" / "image.tif"))
    assert "stack of 3 slices" in (out / "index.html").read_text(encoding="utf-8").replace("Stack", "stack")
    assert main(["reconstruct", *arguments, "--stack", "2e-6", "--movie", "gif"]) == 0  # nothing is computed again
    assert (out / "stack.gif").exists()
    assert "3 were kept" in capsys.readouterr().out


def test_a_stack_needs_several_recordings(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["reconstruct", "a.h5", "-o", str(tmp_path / "out"), "--stack"]) == 2
    assert "--stack: needs several recordings" in capsys.readouterr().err
    assert main(["reconstruct", "a.h5", "b.h5", "-o", str(tmp_path / "out"), "--stack", "--frames"]) == 2
    assert "each recording is a plane" in capsys.readouterr().err
