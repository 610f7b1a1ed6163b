"""Files that cannot be used as recordings are refused in one line with file, channel and hint."""

from __future__ import annotations

from collections.abc import Callable
from math import inf, nan
from pathlib import Path

import h5py
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from scanner.device import Device
from scanner.errors import BadInput, DeviceInvalid, UnitUnknown
from scanner.recording import Recording
from scanner.truth import read_truth

STAGE = 'name = "stage"\n[x.readout]\nkind = "position"\ngain = 2.0\nnoise_sd = 0.1\n'


@pytest.fixture
def stored(tmp_path: Path) -> Path:
    """A valid recording on disk."""
    path = tmp_path / "rec.h5"
    channels = {"sense_x": (np.arange(50.0), "V", 1000.0, 0.0), "intensity": (np.ones((40, 2)), "count", 500.0, 0.01)}
    Recording.from_arrays(channels, Device.from_toml(STAGE)).write(path)
    return path


def change(path: Path, edit: Callable[[h5py.File], object]) -> None:
    with h5py.File(path, "r+") as file:
        edit(file)


def replaced(name: str, data: object, **attrs: object) -> Callable[[h5py.File], None]:
    """An edit that replaces the dataset of a channel."""

    def edit(file: h5py.File) -> None:
        file["channels"].pop(name, None)
        file["channels"].create_dataset(name, data=data).attrs.update({"unit": "V", "sample_rate": 1.0} | attrs)

    return edit


def without(name: str, key: str) -> Callable[[h5py.File], None]:
    return lambda file: file[name].attrs.pop(key)


def virtual(file: h5py.File) -> None:
    layout = h5py.VirtualLayout((50,), float)
    layout[:] = h5py.VirtualSource("other.h5", "data", (50,))
    file["channels"].create_virtual_dataset("sense_y", layout).attrs.update({"unit": "V", "sample_rate": 1.0})


def linked(name: str, link: object) -> Callable[[h5py.File], None]:
    def edit(file: h5py.File) -> None:
        if name in file:
            del file[name]
        file[name] = link

    return edit


BAD_FILES = {
    "unit unknown": (
        replaced("sense_x", [1.0], unit="furlong"),
        "sense_x: unit 'furlong' is unknown; accepted units: V, mV, uV",
    ),
    "unit unknown angle": (
        replaced("angle_x", [1.0], unit="V"),
        "angle_x: unit 'V' is unknown; accepted units: rad, mrad, urad, deg",
    ),
    "unit missing": (without("channels/sense_x", "unit"), "sense_x: unit is missing; accepted units: V, mV, uV"),
    "rate missing": (
        without("channels/sense_x", "sample_rate"),
        "sense_x: sample_rate is missing; state sample_rate as a number",
    ),
    "rate zero": (
        replaced("sense_x", [1.0], sample_rate=0.0),
        "sense_x: sample_rate is 0 Hz; state a rate from 1e-06 to 1e+15 Hz",
    ),
    "rate nan": (
        replaced("sense_x", [1.0], sample_rate=nan),
        "sense_x: sample_rate is nan, not a finite number; state sample_rate as a number",
    ),
    "rate text": (
        replaced("sense_x", [1.0], sample_rate="5 MHz"),
        "sense_x: sample_rate is '5 MHz', not a finite number; state sample_rate as a number",
    ),
    "start infinite": (
        replaced("sense_x", [1.0], start=inf),
        "sense_x: start is inf, not a finite number; state start as a number",
    ),
    "gain zero": (
        replaced("sense_x", [1], gain=0.0),
        "sense_x: gain is 0, which leaves nothing of the samples; state value = gain * raw + offset",
    ),
    "empty channel": (
        replaced("sense_x", np.zeros(0)),
        "sense_x: holds no samples; record it again or leave the channel out",
    ),
    "text": (replaced("sense_x", ["a", "b"]), "sense_x: holds object, not real numbers; store integers or floats"),
    "complex": (replaced("sense_x", [1j]), "sense_x: holds complex128, not real numbers; store integers or floats"),
    "truth values": (replaced("sense_x", [True]), "sense_x: holds bool, not real numbers; store integers or floats"),
    "number": (replaced("sense_x", 1.0), "sense_x: has shape (); store it as (n,)"),
    "two columns": (replaced("sense_x", np.ones((3, 2))), "sense_x: has shape (3, 2); store it as (n,)"),
    "cube": (
        replaced("intensity", np.ones((3, 2, 2))),
        "intensity: has shape (3, 2, 2); store it as (n,) or (n, detectors)",
    ),
    "folder": (
        lambda file: file.create_group("channels/sense_y"),
        "/channels/sense_y: is a group, not a dataset; see docs/reference/recording.md",
    ),
    "no channels": (lambda file: file.pop("channels"), "holds no channels; store signals under /channels"),
    "empty channels": (
        lambda file: (file.pop("channels"), file.create_group("channels")),
        "holds no channels; store signals under /channels",
    ),
    "other format": (
        lambda file: file.attrs.update(format="nexus"),
        "is of format 'nexus'; a recording has the attribute format = 'lissajous-recording'; "
        "make one with `lissajous convert`",
    ),
    "no format": (
        without("/", "format"),
        "states no format; a recording has the attribute format = 'lissajous-recording'; "
        "make one with `lissajous convert`",
    ),
    "other version": (
        lambda file: file.attrs.update(version=2),
        "is a recording of version 2; versions read here: 1",
    ),
    "no version": (without("/", "version"), "states no version; versions read here: 1"),
    "names": (
        lambda file: file.attrs.update(name=["a", "b"]),
        "attribute name is ndarray, not text; store name as one text, or remove it",
    ),
    "device no text": (
        lambda file: file["device"].attrs.update(toml=3),
        "/device: attribute toml is not text; store the device as TOML text",
    ),
    "external link": (
        linked("channels/sense_y", h5py.ExternalLink("other.h5", "/data")),
        "/channels/sense_y: is a link; store the data itself in the file",
    ),
    "soft link": (
        linked("channels/sense_y", h5py.SoftLink("/channels/sense_x")),
        "/channels/sense_y: is a link; store the data itself in the file",
    ),
    "linked channels": (
        linked("channels", h5py.ExternalLink("other.h5", "/channels")),
        "/channels: is a link; store the data itself in the file",
    ),
    "virtual": (virtual, "/channels/sense_y: keeps its samples outside this file; store the data itself in the file"),
    "external storage": (
        lambda file: file["channels"].create_dataset("sense_y", (4,), float, external="other.raw"),
        "/channels/sense_y: keeps its samples outside this file; store the data itself in the file",
    ),
}


@pytest.mark.parametrize("case", BAD_FILES)
def test_a_bad_recording_is_refused_in_one_line(stored: Path, case: str) -> None:
    edit, line = BAD_FILES[case]
    change(stored, edit)
    with pytest.raises(BadInput) as caught:
        Recording.open(stored)
    assert str(caught.value) == f"{stored}: {line}"
    assert isinstance(caught.value, UnitUnknown) == case.startswith("unit")


def test_truth_that_links_to_another_file_is_refused(stored: Path) -> None:
    change(stored, linked("truth", h5py.ExternalLink("other.h5", "/")))
    with pytest.raises(BadInput, match="/truth: is a link"):
        read_truth(stored)


def test_bad_device_is_reported_when_it_is_used(stored: Path) -> None:
    change(stored, lambda file: file["device"].attrs.update(toml="[x.mechanics]\nk = 1\n"))
    with Recording.open(stored) as recording, pytest.raises(DeviceInvalid) as caught:
        assert recording.device
    assert str(caught.value) == f"{stored}: x.mechanics.J: is missing; [x.mechanics] needs J, b, k"


@pytest.mark.parametrize(
    ("content", "what"),
    [
        (None, "no such file; name a recording (HDF5)"),
        (b"", "the file is empty; copy it again"),
        (b"t,V\n0,1\n", "is not an HDF5 file; name a recording, or make one with `lissajous convert`"),
    ],
)
def test_file_that_is_no_recording_is_refused(tmp_path: Path, content: bytes | None, what: str) -> None:
    path = tmp_path / "odd.h5"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(BadInput) as caught:
        Recording.open(path)
    assert str(caught.value) == f"{path}: {what}"
    with pytest.raises(BadInput, match="is a folder"):
        Recording.open(tmp_path)


@settings(deadline=None)
@given(keep=st.floats(0.02, 0.99))
def test_truncated_file_is_reported_as_truncated(tmp_path_factory: pytest.TempPathFactory, keep: float) -> None:
    path = tmp_path_factory.mktemp("cut") / "rec.h5"
    Recording.from_arrays({"sense": (np.arange(500.0), "V", 1.0, 0.0)}).write(path)
    whole = path.read_bytes()
    path.write_bytes(whole[: int(keep * len(whole))])
    with pytest.raises(BadInput, match=r"rec\.h5: the file is truncated; copy it again"):
        Recording.open(path)


def test_damaged_samples_are_reported_when_they_are_read(tmp_path: Path) -> None:
    path = tmp_path / "rec.h5"
    values = np.random.default_rng(0).normal(size=4000)
    with h5py.File(path, "w") as file:
        file.attrs.update({"format": "lissajous-recording", "version": 1})
        dataset = file.create_dataset("channels/sense", data=values, chunks=(4000,), fletcher32=True)
        dataset.attrs.update({"unit": "V", "sample_rate": 1.0})
        place = dataset.id.get_chunk_info(0).byte_offset
    content = bytearray(path.read_bytes())
    content[place + 100] ^= 0xFF
    path.write_bytes(content)
    with Recording.open(path) as recording, pytest.raises(BadInput, match=r"sense: samples cannot be read"):
        recording["sense"].read()


def test_recording_without_channels_is_refused() -> None:
    with pytest.raises(BadInput, match="holds no channels"):
        Recording.from_arrays({})
