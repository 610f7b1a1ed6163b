"""Several detectors: one motion, one pass, named channels in every file."""

import json
from pathlib import Path

import numpy as np
import pytest
import tifffile

from recon.cli import main
from scanner.errors import BadInput
from scanner.recording import Recording
from tests.support.simulated import imaging

NAMES = ("green", "red", "infrared")


@pytest.fixture(scope="module")
def three() -> Recording:
    recording, _ = imaging()
    channels = {name: (c.read(), c.unit, c.sample_rate, c.start) for name, c in recording.channels.items()}
    light, *clock = channels["intensity"]
    channels["intensity"] = (np.stack([light, 2.0 * light, 1.0 - light], axis=1), *clock)
    return Recording.from_arrays(channels, recording.device, detectors=NAMES)


def test_names_are_kept_in_the_file(three: Recording, tmp_path: Path) -> None:
    three.write(tmp_path / "three.h5")
    with Recording.open(tmp_path / "three.h5") as again:
        assert again["intensity"].detectors == NAMES
        assert again.slice(0.001, 0.002)["intensity"].detectors == NAMES


@pytest.mark.slow
def test_pictures_and_films_have_named_channels(three: Recording, tmp_path: Path) -> None:
    three.write(tmp_path / "three.h5")
    out = tmp_path / "out"
    arguments = ["reconstruct", str(tmp_path / "three.h5"), "-o", str(out), "--pixels", "50x40", "--frames", "2"]
    assert main(arguments) == 0
    assert json.loads((out / "summary.json").read_text(encoding="utf-8"))["detectors"] == list(NAMES)
    with tifffile.TiffFile(out / "image.tif") as file:
        assert file.imagej_metadata is not None
        assert tuple(file.imagej_metadata["Labels"]) == NAMES
        image = file.asarray()
    assert image.shape == (3, 40, 50)
    visited = np.isfinite(image[0])
    assert np.allclose(image[1][visited], 2.0 * image[0][visited], rtol=1e-5)
    assert np.allclose(image[2][visited], 1.0 - image[0][visited], atol=1e-5)
    with tifffile.TiffFile(out / "frames.ome.tif") as file:
        assert file.series[0].shape == (2, 3, 40, 50)
        assert file.ome_metadata is not None
        assert all(f'Name="{name}"' in file.ome_metadata for name in NAMES)


@pytest.mark.parametrize("names", [("green",), ("a", "a", "b"), ("a", "b", "")])
def test_names_that_do_not_fit_are_refused(names: tuple[str, ...]) -> None:
    with pytest.raises(BadInput, match="intensity: names the detectors"):
        Recording.from_arrays({"intensity": (np.ones((9, 3)), "V", 1e6)}, detectors=names)
