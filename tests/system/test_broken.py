"""Damaged files: a command ends with one line of message or with a complete output.

``LISSAJOUS_FUZZ=400 pytest tests/system/test_broken.py`` tries 400 kinds of damage per file instead of a few.
"""

from __future__ import annotations

import os
from pathlib import Path

import h5py
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from recon.cli import main
from recon.io.convert import open_any
from recon.io.readers import read
from scanner.device import Device
from scanner.devices import load
from scanner.errors import BadInput
from scanner.files import parse_toml
from scanner.recording import Recording
from scanner.signal_check import check_signal
from tests.support.fuzzing import damaged, run_in_child
from tests.support.measured_data import MEASURED_DATA
from tests.support.sample_files import MEASURED, make_sample_files, recording

SEEDS = int(os.environ.get("LISSAJOUS_FUZZ", "6"))


@pytest.fixture(scope="module")
def intact_files(tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    return make_sample_files(tmp_path_factory.mktemp("samples"), MEASURED_DATA)


def partial_files(folder: Path) -> list[str]:
    return [path.name for path in folder.iterdir() if path.name.endswith(".part")]


@pytest.mark.slow
@pytest.mark.parametrize("name", [
    "recording.h5", "five.mat", "packed.mat", "four.mat", "new.mat", "plain.npz", "packed.npz", "short.wav",
    "float.wav", "three.wav", "tektronix.csv", "keysight.csv", "rigol.csv", "labview.lvm", *MEASURED,
])  # fmt: skip
def test_info_and_convert_of_damaged_files_end_cleanly(
    intact_files: dict[str, bytes], tmp_path: Path, name: str
) -> None:
    if name not in intact_files:
        pytest.skip(f"no measured data at {MEASURED_DATA}")
    path, output = tmp_path / name, tmp_path / "out.h5"
    path.write_bytes(intact_files[name])
    contents = read(path)
    signals = [each for each, variable in contents.variables.items() if variable.is_signal][:3]
    contents.close()
    channels = [part for at, each in enumerate(signals) for part in ("--channel", f"intensity_{at}={each}")]
    stated = ["--rate", "1000", "--unit", "V"]

    def convert(more: list[str]) -> int:
        return main(["convert", str(path), *channels, *more, "-o", str(output)])

    assert convert(stated) == 0
    for seed in range(SEEDS):
        output.unlink(missing_ok=True)
        data, how = damaged(intact_files[name], seed)
        path.write_bytes(data)
        outcome = run_in_child(
            lambda at=seed: main(["info", str(path)]) or convert(stated if at % 2 else []), tmp_path / "log"
        )
        assert outcome.is_clean(), (seed, how, outcome)
        assert output.exists() == (outcome.code == 0), (seed, how, outcome)
        assert not partial_files(tmp_path)
        if output.exists():
            Recording.open(output).close()


@pytest.mark.slow
def test_a_file_on_which_hdf5_runs_endlessly_is_refused(
    intact_files: dict[str, bytes], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("scanner.hdf5.CHECK_CPU_TIME_S", 0.5)
    path = tmp_path / "endless.h5"
    path.write_bytes(damaged(intact_files["recording.h5"], 160)[0])  # a length of 0 in the heap of strings
    for arguments in (["info", str(path)], ["reconstruct", str(path), "-o", str(tmp_path / "out")]):
        outcome = run_in_child(lambda given=arguments: main(given), tmp_path / "log")
        assert outcome.is_clean(), outcome
        assert f"{path}: HDF5 runs without end on it" in outcome.stderr
        assert not (tmp_path / "out").exists()


def test_a_file_without_read_permission_is_refused(
    intact_files: dict[str, bytes], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def refuse(*args: object, **kwargs: object) -> None:  # as h5py does; simulated because root may read any file
        raise PermissionError(13, "Unable to open file (unable to open file, errno = 13, ...)")

    monkeypatch.setattr("h5py.is_hdf5", refuse)
    monkeypatch.setattr("h5py.File", refuse)
    path = tmp_path / "rec.h5"
    path.write_bytes(intact_files["recording.h5"])
    for arguments in (["info", str(path)], ["reconstruct", str(path), "-o", str(tmp_path / "out")]):
        assert main(arguments) == 2
        assert capsys.readouterr().err == f"lissajous {arguments[0]}: {path}: may not be read; check its permissions\n"


# --- valid HDF5 files with invalid recordings -----------------------------------------------------------------------


NUMBERS = st.one_of(
    st.sampled_from([np.nan, np.inf, -np.inf, -1.0, 0.0, -0.0, 1e300, 1e-320, 5e-324, -5e6, 2**63 - 1, 1e18, 1e-12]),
    st.floats(), st.integers(-(2**63), 2**63 - 1),
)  # fmt: skip
ATTRIBUTES = st.one_of(
    NUMBERS, st.text(st.characters(codec="utf-8", exclude_characters="\0"), max_size=9), st.booleans(),
    st.sampled_from([np.zeros((2, 2)), np.array([], "f8"), np.bytes_(b"\xff\xfe"), np.complex128(1j)]),
)  # fmt: skip


def no_change(file: h5py.File) -> None:
    """Do not change the recording."""


def swap(name: str, **how: object):
    """A change that replaces the dataset of channel ``name`` and keeps its attributes."""

    def change(file: h5py.File) -> None:
        attrs = dict(file[f"channels/{name}"].attrs)
        del file[f"channels/{name}"]
        file.create_dataset(f"channels/{name}", **how).attrs.update(attrs)

    return change


def put(name: str, rows: slice, value: float):
    def change(file: h5py.File) -> None:
        with np.errstate(over="ignore"):  # 1e300 is infinite in a float of 32 bits
            file[f"channels/{name}"][rows] = value

    return change


def attribute(name: str, key: str, value: object):
    return lambda file: file[f"channels/{name}"].attrs.__setitem__(key, value)


CHANNELS = ("sense_x", "sense_y", "intensity", "angle_x")
CHANGED_CHANNELS = CHANNELS if SEEDS > 50 else ("sense_x", "intensity")  # each run takes seconds
CHANGES = {
    "no change": no_change,
    **{
        f"{n}: 10^12 samples claimed": swap(n, shape=(10**12,), chunks=(1 << 16,), dtype="f8") for n in CHANGED_CHANNELS
    },
    **{f"{n}: {size} samples": swap(n, data=np.linspace(0, 1, size)) for n in CHANGED_CHANNELS for size in (1, 3, 40)},
    **{
        f"{n}: run of {v}": put(n, slice(300, 900), v)
        for n in CHANGED_CHANNELS
        for v in (np.nan, 1e300, 0.0)
        if n != "angle_x"
    },
    **{f"{n}: all {v}": put(n, slice(None), v) for n in CHANGED_CHANNELS for v in (1e308, 1e-320) if n != "angle_x"},
    **{f"{n}: rate {v}": attribute(n, "sample_rate", v) for n in CHANGED_CHANNELS for v in (-1e6, 1e-300, 1e15, 1.0)},
    **{f"{n}: clock at {v}": attribute(n, "start", v) for n in CHANGED_CHANNELS for v in (1e-3, 1e9, 1e300)},
    **{f"{n}: {t}": swap(n, data=np.zeros(900, t)) for n in CHANGED_CHANNELS for t in ("c16", "S5", "u8", "f2")},
    "one value": swap("sense_x", data=1.0),
    "nothing": swap("sense_x", data=h5py.Empty("f8")),
    "matrix": swap("sense_x", data=np.zeros((9, 9))),
    "10^9 detectors claimed": swap("intensity", shape=(20_000, 10**9), chunks=(1, 1 << 16), dtype="f4"),
    "60 detectors": swap("intensity", data=np.ones((20_000, 60), "f4")),
    "gain of 1e300": attribute("angle_x", "gain", 1e300),
    "outside": swap("sense_x", shape=(900,), dtype="f8", external=[("elsewhere.bin", 0, 7200)]),
}


@pytest.fixture(scope="module")
def intact_recording(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    """The bytes of an intact recording. One reconstruction loads the modules that the forked processes need."""
    folder = tmp_path_factory.mktemp("whole")
    data = recording(folder / "whole.h5")
    assert main(["reconstruct", str(folder / "whole.h5"), "-o", str(folder / "out"), "--pixels", "40x40"]) == 0
    return data


@pytest.mark.slow
@pytest.mark.parametrize("name", CHANGES)
def test_reconstruct_from_an_invalid_recording_ends_cleanly(intact_recording: bytes, tmp_path: Path, name: str) -> None:
    path, output = tmp_path / "rec.h5", tmp_path / "out"
    path.write_bytes(intact_recording)
    with h5py.File(path, "r+") as file:
        CHANGES[name](file)
    outcome = run_in_child(
        lambda: main(["reconstruct", str(path), "-o", str(output), "--pixels", "40x40"]), tmp_path / "log"
    )
    assert outcome.is_clean(), outcome
    assert output.exists() == (outcome.code == 0)
    assert not partial_files(tmp_path)


@pytest.mark.slow
@given(
    name=st.sampled_from(CHANNELS),
    attrs=st.dictionaries(st.sampled_from(["unit", "sample_rate", "start", "gain", "offset"]), ATTRIBUTES),
)
def test_recordings_with_any_attributes_are_used_or_refused(
    intact_recording: bytes, tmp_path_factory: pytest.TempPathFactory, name: str, attrs: dict
) -> None:
    path = tmp_path_factory.mktemp("attrs") / "rec.h5"
    path.write_bytes(intact_recording)
    with h5py.File(path, "r+") as file:
        file[f"channels/{name}"].attrs.update(attrs)
    try:
        with Recording.open(path) as opened, np.errstate(all="ignore"):
            for channel in opened.channels.values():
                check_signal(channel)
            assert main(["info", str(path)]) == 0
            opened.slice(opened.start, opened.end)
    except BadInput as error:
        line = str(error)
        assert line.isprintable()


# --- device and mapping ----------------------------------------------------------------------------------------------


VALUES = st.recursive(
    NUMBERS | st.booleans() | st.text(max_size=5) | st.datetimes() | st.just(10**400),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.sampled_from(["x", "kind", "k"]), inner, max_size=3),
    max_leaves=5,
)  # fmt: skip


@st.composite
def changed_tables(draw: st.DrawFn, table: dict) -> dict:
    """A table with some of its values, at any depth, replaced, removed or added."""
    out = dict(table)
    for key in draw(st.lists(st.sampled_from([*table, "extra", "terms"]), max_size=2, unique=True)):
        inner = out.get(key)
        if isinstance(inner, dict) and inner and draw(st.booleans()):
            out[key] = draw(changed_tables(inner))
        elif draw(st.booleans()):
            out[key] = draw(VALUES)
        else:
            out.pop(key, None)
    return out


NAMES = ("chen2019", "chen2020", "chen2020-driven", "imaging")


@given(st.sampled_from(NAMES).flatmap(lambda name: changed_tables(parse_toml(load(name).to_toml(), name))))
def test_any_device_is_used_or_refused(table: dict) -> None:
    try:
        device = Device.from_table(table, source="device.toml")
    except BadInput as error:
        line = str(error)
        assert line.isprintable()
    else:
        written = device.to_toml()
        assert Device.from_toml(written).to_toml() == written


@given(seed=st.integers(0, 10**6), name=st.sampled_from(NAMES))
def test_damaged_device_files_are_used_or_refused(
    tmp_path_factory: pytest.TempPathFactory, seed: int, name: str
) -> None:
    path = tmp_path_factory.mktemp("device") / "device.toml"
    path.write_bytes(damaged(load(name).to_toml().encode(), seed)[0])
    try:
        Device.load(path)
    except BadInput as error:
        line = str(error)
        assert str(path) in line


@pytest.mark.parametrize(
    "text", ["a = " + "9" * 5000, "a = " + "[" * 100_000, "a." * 5000 + "b = 1", "a = 1e999", "\0"]
)
def test_toml_with_extreme_values_is_refused(tmp_path: Path, text: str) -> None:
    path = tmp_path / "device.toml"
    path.write_text(text)
    with pytest.raises(BadInput, match=r"device\.toml"):
        Device.load(path)


PLAN = {
    "format": "npz", "name": "n",
    "channels": {
        "sense_x": {"variable": "v", "unit": "V", "sample_rate": 10.0, "start": 0.5, "scale": 2.0, "offset": 1.0},
        "sense_y": {"variable": "v", "unit": "V", "time": "t"},
    },
    "device": {"x": {"readout": {"kind": "position", "gain": 2.0, "noise_sd": 0.1}}},
}  # fmt: skip


@given(plan=changed_tables(PLAN))
def test_any_mapping_is_used_or_refused(tmp_path_factory: pytest.TempPathFactory, plan: dict) -> None:
    folder = tmp_path_factory.mktemp("plan")
    np.savez(folder / "a.npz", v=np.arange(9.0), t=np.arange(9.0) / 10)
    try:
        with open_any(folder / "a.npz", plan) as made:
            made.write(folder / "a.h5")
        Recording.open(folder / "a.h5").close()
    except BadInput as error:
        line = str(error)
        assert line.isprintable()
