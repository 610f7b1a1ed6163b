"""Every reader returns the written samples and exactly the units and clocks that the file states."""

from __future__ import annotations

import sys
import wave
from pathlib import Path

import h5py
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from scipy.io import savemat, wavfile

from recon.cli import main
from recon.io.convert import convert, convert_file, open_any
from recon.io.info import info
from recon.io.readers import detect_format, read, readers
from scanner.errors import BadInput
from scanner.files import parse_toml
from scanner.recording import Recording
from tests.support.instrument_files import TEKTRONIX, stated_metadata, write_text

VALUES = np.array([0.25, -1.5, 3.0, 0.125, 7.0, -0.5])


# --- real files ---------------------------------------------------------------------------------------------------


def test_files_of_instruments_are_read_with_units_and_clocks(measured_data: Path) -> None:
    folder = measured_data / "instruments"
    assert stated_metadata(folder / "DS1054Z-A.csv") == {
        "CH1": ("V", 2e9, -3e-7, [3.28, 3.28]), "CH2": ("V", 2e9, -3e-7, [0.96, 0.96]),
        "CH3": ("V", 2e9, -3e-7, [-0.16, -0.16]), "CH4": ("V", 2e9, -3e-7, [0.0, 0.0]),
    }  # fmt: skip
    assert stated_metadata(folder / "DS2072A-1.csv")["CH2"] == ("V", 2e5, -3.5e-3, [0.008, -0.016])
    assert stated_metadata(folder / "rs_rtp_01.Wfm.csv") == {"column 1": ("V", 8e5, -2.5e-3, [-0.031620555, 0.0])}
    assert stated_metadata(folder / "DS1054Z-A.wfm")["CH1"][:2] == ("V", 2.5e8)
    assert stated_metadata(folder / "agilent_1.bin")["CH1"][:2] == ("V", 2e6)
    unit, rate, start, _ = stated_metadata(folder / "lecroy_3.trc")["CH2"]
    assert (unit, rate, start) == (None, pytest.approx(1e9), pytest.approx(-3.6458e-7, abs=1e-11))
    assert stated_metadata(folder / "raw1.tdms")["Layer Data/First  Channel"][:3] == ("V", 5e4, 0.0)
    assert stated_metadata(folder / "big_endian.tdms")["Measured Data/Phase sweep"][:3] == (None, 1000.0, 0.0)
    digital = read(folder / "Digital_Input.tdms").variables
    assert [v.raw.shape[0] for v in digital.values()] == [20000, 400, 8]


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("lecroy_1.trc", "may be truncated"),
        ("rs_rtp_01.bin", "Companion Rohde & Schwarz payload file not found"),
        ("agilent_1.txt", "holds no table of numbers"),
        ("agilent_1.sr", "with nothing in it"),
    ],
)
def test_files_without_samples_are_refused(measured_data: Path, name: str, words: str) -> None:
    with pytest.raises(BadInput, match=words):
        read(measured_data / "instruments" / name)


def test_the_measured_decay_is_read_and_converted(measured_data: Path, tmp_path: Path) -> None:
    path = next((measured_data / "beam_decay").glob("*.lvm"))
    variables = read(path).variables
    assert variables["Strain_0"].raw.shape == (29000,)
    assert (variables["Strain_0"].unit, variables["Strain_0"].sample_rate) == ("Strain", 1000.0)
    # 11:16:09.2433572999 against the earliest channel's 11:16:09.0022864341
    assert variables["Strain_0"].start == pytest.approx(0.2410708658)
    assert variables["Untitled 1"].raw[:].tolist() == [42.05] * 29
    assert variables["Untitled 1"].sample_rate == 1.0
    plan = {"channels": {"angle_x": {"variable": "Strain_0", "unit": "mrad", "scale": 10.0}}}
    convert_file(path, plan, tmp_path / "decay.h5")
    with Recording.open(tmp_path / "decay.h5") as recording:
        assert recording.attrs["acquired"] == "2023-08-29T11:15:09.002286"
        np.testing.assert_allclose(recording["angle_x"].read(0, 2), [2.11e-6, 2.19e-6])


def test_the_measured_spiral_and_oscillator_are_read(measured_data: Path, tmp_path: Path) -> None:
    spiral = read(measured_data / "afm_spiral/spiral_20hz.mat")
    assert spiral.variables["x"].raw.shape == (64000,)
    assert spiral.variables["x"].sample_rate is None
    plan = {"channels": {"drive_x": {"variable": "V1", "unit": "V", "sample_rate": 610.35}}}
    source = measured_data / "silverbox/multisine.npz"
    with convert(source, plan) as recording, np.load(source) as direct:
        np.testing.assert_array_equal(recording["drive_x"].read(), direct["V1"])


# --- files written by the tests -------------------------------------------------------------------------------------


@pytest.mark.parametrize("compressed", [False, True])
@given(
    values=hnp.arrays(st.sampled_from(["i2", "f4", "f8", ">f8"]), hnp.array_shapes(min_dims=1, max_dims=2, max_side=9)),
    columns_first=st.booleans(),
)
def test_numpy_archives_are_read_unchanged(
    tmp_path_factory: pytest.TempPathFactory, values: np.ndarray, columns_first: bool, compressed: bool
) -> None:
    path = tmp_path_factory.mktemp("npz") / "a.npz"
    save = np.savez_compressed if compressed else np.savez
    save(path, v=np.asfortranarray(values) if columns_first else values)
    raw = read(path).variables["v"].raw
    assert raw.shape == values.shape
    np.testing.assert_array_equal(raw[:], values)
    np.testing.assert_array_equal(raw[1:3], values[1:3])


def test_pickles_are_not_loaded(tmp_path: Path) -> None:
    np.savez(tmp_path / "a.npz", o=np.array([{}, print], dtype=object), v=VALUES)
    assert not read(tmp_path / "a.npz").variables["o"].is_signal
    plan = {"channels": {"intensity": {"variable": "o", "unit": "V", "sample_rate": 1.0}}}
    with pytest.raises(BadInput, match="holds object, not real numbers"):
        convert(tmp_path / "a.npz", plan)


@pytest.mark.parametrize("kind", ["<f8", "<f4", "<i2", "u1"])
@pytest.mark.parametrize("version", ["5", "4"])
def test_matlab_files_before_7_3_are_read(tmp_path: Path, kind: str, version: str) -> None:
    values = (10 * VALUES).astype(kind)
    savemat(
        tmp_path / "a.mat",
        {"row": values[None], "column": values[:, None], "two": values.reshape(3, 2)},
        format=version,
    )
    variables = read(tmp_path / "a.mat").variables
    for name in ("row", "column"):
        np.testing.assert_array_equal(variables[name].raw[:], values)
        np.testing.assert_array_equal(variables[name].raw[2:4], values[2:4])
    np.testing.assert_array_equal(variables["two"].raw[1:], values.reshape(3, 2)[1:])


def test_a_complex_field_leaves_the_real_ones_of_its_structure(tmp_path: Path) -> None:
    path = tmp_path / "a.mat"
    savemat(path, {"d": {"x": np.arange(8.0), "z": np.arange(8.0) * 1j}, "z": np.arange(8.0) * 1j})
    variables = read(path).variables
    assert [variables[name].is_signal for name in ("d.x", "d.z")] == [True, False]
    np.testing.assert_array_equal(variables["d.x"].raw[2:5], [2.0, 3.0, 4.0])
    with pytest.raises(BadInput, match=r"a\.mat: z: holds complex values; save real and imaginary part"):
        variables["z"].raw[0:8]


def test_complex_matlab_variables_are_refused(tmp_path: Path) -> None:
    savemat(tmp_path / "a.mat", {"v": VALUES + 1j})
    plan = {"channels": {"intensity": {"variable": "v", "unit": "V", "sample_rate": 1.0}}}
    with pytest.raises(BadInput, match="complex values"):
        convert_file(tmp_path / "a.mat", plan, tmp_path / "a.h5")
    assert not (tmp_path / "a.h5").exists()


def matlab_73(path: Path, **variables: np.ndarray) -> Path:
    """A file as MATLAB's -v7.3 writes it: HDF5 behind 512 bytes, dimensions reversed, structures as groups."""
    with h5py.File(path, "w", userblock_size=512) as file:
        for name, values in variables.items():
            dataset = file.create_dataset(name.replace("__", "/"), data=values.T, chunks=values.T.shape, compression=1)
            dataset.attrs["MATLAB_class"] = np.bytes_("double")
        file.create_dataset("#refs#/a", data=VALUES)
        label = file.create_dataset("label", data=np.array([[104, 105]], "u2"))
        label.attrs["MATLAB_class"] = np.bytes_("char")
    data = path.read_bytes()
    path.write_bytes(b"MATLAB 7.3 MAT-file".ljust(124) + b"\x00\x02IM" + data[128:])
    return path


def test_matlab_7_3_files_are_read(tmp_path: Path) -> None:
    path = matlab_73(
        tmp_path / "a.mat", row=VALUES[None], column=VALUES[:, None], two=VALUES.reshape(3, 2), s__v=VALUES[None]
    )
    contents = read(path)
    assert contents.kind == "MATLAB 7.3"
    assert set(contents.variables) == {"row", "column", "two", "s.v", "label"}
    assert not contents.variables["label"].is_signal
    for name in ("row", "column", "s.v"):
        np.testing.assert_array_equal(contents.variables[name].raw[1:4], VALUES[1:4])
    np.testing.assert_array_equal(contents.variables["two"].raw[1:], VALUES.reshape(3, 2)[1:])


def test_hdf5_files_keep_dimensions_and_external_links_are_refused(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["run/two"] = VALUES.reshape(3, 2)
    np.testing.assert_array_equal(read(tmp_path / "a.h5").variables["run.two"].raw[1:], VALUES.reshape(3, 2)[1:])
    with h5py.File(tmp_path / "b.h5", "w") as file:
        file["run"] = h5py.ExternalLink("a.h5", "/run")
    with pytest.raises(BadInput, match="is a link"):
        read(tmp_path / "b.h5")


def test_a_single_row_is_read_as_a_channel(tmp_path: Path) -> None:
    rows = np.arange(7.0)[None, :]
    np.savez(tmp_path / "a.npz", row=rows)
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["row"] = rows
    for name in ("a.npz", "a.h5"):
        plan = {"channels": {"sense_x": {"variable": "row", "unit": "V", "time": "row"}}}
        with convert(tmp_path / name, plan) as recording:
            assert recording["sense_x"].read().tolist() == list(range(7))
            assert recording["sense_x"].read(2, 5).tolist() == [2.0, 3.0, 4.0]
            assert recording["sense_x"].sample_rate == 1.0


@pytest.mark.parametrize("kind", ["u1", "<i2", "<i4", "<f4"])
@pytest.mark.parametrize("channels", [1, 2])
def test_wav_files_are_read(tmp_path: Path, kind: str, channels: int) -> None:
    values = np.arange(12).astype(kind).reshape(-1, channels)
    wavfile.write(tmp_path / "a.wav", 48000, values)
    variables = read(tmp_path / "a.wav").variables
    assert [(v.unit, v.sample_rate) for v in variables.values()] == [(None, 48000.0)] * channels
    np.testing.assert_array_equal(variables[f"CH{channels}"].raw[:], values[:, -1])


@pytest.mark.parametrize(("size", "words"), [(44, "holds no samples"), (5044, "is not a whole WAV file: Reached EOF")])
def test_wav_files_that_end_early_are_refused(size: int, words: str, tmp_path: Path) -> None:
    wavfile.write(tmp_path / "whole.wav", 48000, np.zeros(0 if size == 44 else 5000, np.int16))
    (tmp_path / "a.wav").write_bytes((tmp_path / "whole.wav").read_bytes()[:size])
    with pytest.raises(BadInput, match=f"a.wav: {words}"):
        read(tmp_path / "a.wav")


def test_wav_files_of_24_bits_are_read(tmp_path: Path) -> None:
    with wave.open(str(tmp_path / "a.wav"), "wb") as file:
        file.setparams((1, 3, 8000, 0, "NONE", ""))
        file.writeframes(b"".join(int(v).to_bytes(3, "little", signed=True) for v in (1, -2, 3)))
    np.testing.assert_array_equal(read(tmp_path / "a.wav").variables["CH1"].raw[:], [256, -512, 768])


def test_tdms_channels_start_relative_to_the_earliest_one(tmp_path: Path) -> None:
    import nptdms

    zero = np.datetime64("2024-05-01T10:00:00", "us")
    channels = [
        nptdms.ChannelObject("g", name, values, {"wf_increment": 1e-3, "wf_start_time": begun, "unit_string": unit})
        for name, values, begun, unit in (
            ("late", VALUES, zero + np.timedelta64(250, "ms"), "Volts"),
            ("early", np.arange(5, dtype="i2"), zero, "mV"),
        )
    ]
    with nptdms.TdmsWriter(tmp_path / "a.tdms") as writer:
        writer.write_segment(channels)
    plan = {"channels": {"sense_x": {"variable": "g/late"}, "sense_y": {"variable": "g/early"}}}
    with open_any(tmp_path / "a.tdms", plan) as recording:
        assert (recording["sense_x"].start, recording["sense_y"].start) == (0.25, 0.0)
        np.testing.assert_array_equal(recording["sense_x"].read(2, 5), VALUES[2:5])
        np.testing.assert_allclose(recording["sense_y"].read(), 1e-3 * np.arange(5))
        assert recording.attrs["acquired"] == "2024-05-01T10:00:00.000000Z"


@pytest.mark.parametrize(
    ("name", "package", "extra"), [("a.tdms", "nptdms", "tdms"), ("a.wfm", "RigolWFM.wfm", "scope")]
)
def test_a_missing_extra_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str, package: str, extra: str
) -> None:
    monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(BadInput, match=rf"pip install 'lissajous\[{extra}\]'"):
        read(write_text(tmp_path / name, "x"))


# --- format detection and contents ------------------------------------------------------------------------------------


def test_the_format_is_detected_from_the_content_before_the_name(tmp_path: Path) -> None:
    np.savez(tmp_path / "a.npz", v=VALUES)
    (tmp_path / "a.npz").rename(tmp_path / "a.csv")
    assert detect_format(tmp_path / "a.csv") == "npz"
    assert detect_format(write_text(tmp_path / "b.CSV", "1\n")) == "csv"
    with pytest.raises(BadInput, match="is of no format that is known"):
        detect_format(write_text(tmp_path / "c.dat", "1\n"))
    assert read(tmp_path / "c.dat", "csv").variables["column 1"].raw[:].tolist() == [1.0]


@pytest.mark.parametrize("name", readers())
def test_missing_and_empty_files_are_refused(tmp_path: Path, name: str) -> None:
    for path in (tmp_path / "gone", tmp_path, write_text(tmp_path / "empty", "")):
        with pytest.raises(BadInput) as caught:
            read(path, name)
        assert str(path) in str(caught.value)


def test_the_suggested_mapping_is_complete_if_the_file_states_everything(tmp_path: Path) -> None:
    path = write_text(tmp_path / "a.csv", TEKTRONIX)
    description = info(path)
    assert description["about"] == {"device": "MDO4014B-3"}
    assert description["variables"]["CH3"] == {
        "shape": (3,), "dtype": "float64", "unit": "mV", "sample_rate": 2.5e9, "start": -4e-3, "note": "",
    }  # fmt: skip
    with convert(path, parse_toml(description["suggestion"], "suggestion")) as recording:
        assert set(recording.channels) == {"CH2", "CH3"}
    bare = info(write_text(tmp_path / "b.csv", 't,"a]b"\n0,1\n1,2\n'))["suggestion"]
    with pytest.raises(BadInput, match="no sample_rate is stated"):  # the file does not state it
        convert(tmp_path / "b.csv", parse_toml(bare, "suggestion"))


def test_the_suggested_channels_have_different_names(tmp_path: Path) -> None:
    rows = "".join(f"{k},1,2,3,4\n" for k in range(9))
    path = write_text(tmp_path / "a.csv", f"Time (s),电压,电流,CH 1,CH_1\n{rows}")
    channels = parse_toml(info(path)["suggestion"], "suggestion")["channels"]
    assert [spec["variable"] for spec in channels.values()] == ["电压", "电流", "CH 1", "CH_1"]


def test_info_lists_the_channels_of_a_recording(tmp_path: Path) -> None:
    Recording.from_arrays({"sense_x": (VALUES, "mV", 10.0, 0.5)}, name="n").write(tmp_path / "a.h5")
    description = info(tmp_path / "a.h5")
    assert (description["format"], description["suggestion"], description["about"]) == (
        "lissajous-recording",
        None,
        {"name": "n"},
    )
    assert description["variables"]["sense_x"]["sample_rate"] == 10.0


# --- larger than memory -----------------------------------------------------------------------------------------------


def test_conversion_uses_little_memory(tmp_path: Path) -> None:
    """A conversion holds some blocks of samples in memory, not the 64 MB of the file."""
    import tracemalloc

    values = np.arange(8 << 20, dtype="f8")
    np.savez(tmp_path / "a.npz", v=values)
    with h5py.File(tmp_path / "b.h5", "w") as file:
        file.create_dataset("v", data=values, chunks=(1 << 16,))
    wavfile.write(tmp_path / "c.wav", 1000, values.astype("f4"))
    del values
    for name, variable in (("a.npz", "v"), ("b.h5", "v"), ("c.wav", "CH1")):
        plan = {"channels": {"intensity": {"variable": variable, "unit": "V", "sample_rate": 1000.0}}}
        tracemalloc.start()
        convert_file(tmp_path / name, plan, tmp_path / "out.h5")
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        assert peak < 30e6, name


# --- a reader of the user ------------------------------------------------------------------------------------------

USER_READER = """
from pathlib import Path

import numpy as np

from recon.io.readers import Contents, Reader
from recon.io.readers.contents import Variable


def read_float32(path: Path) -> Contents:
    return Contents("raw float32", {"CH1": Variable(np.fromfile(path, "<f4", offset=4), "V", 1000.0, 0.0)})


READER = Reader("float32", read_float32, beginnings=(b"F32!",), suffixes=(".f32",))
"""


def test_a_user_adds_a_format_with_one_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    from recon.io import readers as package

    monkeypatch.setattr(package, "_REGISTERED", {})
    (tmp_path / "mine.py").write_text(USER_READER)
    (tmp_path / "scan.dat").write_bytes(b"F32!" + VALUES.astype("<f4").tobytes())
    convert_it = ["convert", str(tmp_path / "scan.dat"), "--channel", "sense_x=CH1", "-o", str(tmp_path / "scan.h5")]
    assert main(convert_it) == 2
    assert "is of no format" in capsys.readouterr().err
    assert main([*convert_it, "--readers", str(tmp_path / "mine.py")]) == 0
    with Recording.open(tmp_path / "scan.h5") as recording:
        np.testing.assert_array_equal(recording["sense_x"].read(), VALUES)
    assert detect_format(tmp_path / "scan.dat") == "float32"
    (tmp_path / "none.py").write_text("x = 1")
    assert main([*convert_it, "--readers", str(tmp_path / "none.py")]) == 2
    assert "none.py: holds no reader" in capsys.readouterr().err
