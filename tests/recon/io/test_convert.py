"""Conversion of instruments' files by a mapping; missing rates and units are refused, not guessed."""

from __future__ import annotations

from functools import reduce
from pathlib import Path

import h5py
import numpy as np
import pytest
import tifffile
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from scipy.io import savemat

from recon.cli import main
from recon.io.convert import convert, convert_file, open_any
from scanner.device import Device
from scanner.errors import BadInput, DeviceInvalid
from scanner.recording import Recording
from tests.support import sample_files

ROOT = Path(__file__).parents[3]

MAPPING = """
format = "matlab"
name = "bench"
notes = "warm"
[channels.sense_x]
variable = "x"
unit = "V"
sample_rate = 1000.0
[channels.intensity]
variable = "z"
scale = 1e4
offset = -1.0
unit = "nm"
sample_rate = 500
start = 0.25
[device.x.readout]
kind = "position"
gain = 2.0
noise_sd = 0.1
"""


@pytest.fixture
def bench(tmp_path: Path) -> Path:
    """A folder with an instrument's file and its mapping."""
    content = {"x": np.arange(5.0), "z": np.array([[1, 2], [3, 4]], np.int16), "label": "run 7"}
    content["cell"] = np.array([np.ones(2), np.ones(3)], dtype=object)
    savemat(tmp_path / "run.mat", content)
    (tmp_path / "map.toml").write_text(MAPPING)
    return tmp_path


def test_a_mapping_converts_a_file_to_a_recording(bench: Path) -> None:
    summary = convert_file(bench / "run.mat", bench / "map.toml", bench / "run.h5")
    with Recording.open(bench / "run.h5") as recording:
        assert (recording.name, recording.notes) == ("bench", "warm")
        assert recording.device == Device.from_toml('[x.readout]\nkind = "position"\ngain = 2.0\nnoise_sd = 0.1\n')
        sense, height = recording["sense_x"], recording["intensity"]
        assert (sense.unit, sense.sample_rate, sense.start) == ("V", 1000.0, 0.0)
        assert (height.unit, height.sample_rate, height.start) == ("nm", 500.0, 0.25)
        np.testing.assert_array_equal(sense.read(), np.arange(5.0))
        np.testing.assert_array_equal(height.read(), [[9999, 19999], [29999, 39999]])
    assert summary == {
        "recording": str(bench / "run.h5"),
        "source": str(bench / "run.mat"),
        "format": "MATLAB 4 to 7.2",
        "duration": pytest.approx(0.254),
        "device": "unnamed",
        "channels": {
            "sense_x": {
                "unit": "V", "sample_rate": 1000.0, "start": 0.0, "shape": (5,), "variable": "x", "overruled": {},
                "stated_unit": "V",
                "stated_by": {"unit": "mapping", "sample_rate": "mapping", "start": "default: 0"},
            },
            "intensity": {
                "unit": "nm", "sample_rate": 500.0, "start": 0.25, "shape": (2, 2), "variable": "z", "overruled": {},
                "stated_unit": "nm",
                "stated_by": {"unit": "mapping", "sample_rate": "mapping", "start": "mapping"},
            },
        },
        "edges": {},
        "notes": [],
    }  # fmt: skip


@settings(deadline=None, max_examples=50)
@given(
    values=hnp.arrays(st.sampled_from([np.int16, np.float32, np.float64]), st.integers(2, 30)),
    rate=st.floats(1e-3, 1e8),
    start=st.floats(-1e3, 1e3),
    compressed=st.booleans(),
)
def test_samples_and_clock_are_converted_unchanged(
    tmp_path_factory: pytest.TempPathFactory, values: np.ndarray, rate: float, start: float, compressed: bool
) -> None:
    folder = tmp_path_factory.mktemp("mat")
    savemat(folder / "a.mat", {"v": values}, do_compression=compressed)
    channel = f'variable = "v"\nunit = "V"\nsample_rate = {rate!r}\nstart = {start!r}\n'
    (folder / "m.toml").write_text(f'format = "matlab"\n[channels.sense]\n{channel}')
    convert_file(folder / "a.mat", folder / "m.toml", folder / "a.h5")
    with Recording.open(folder / "a.h5") as recording:
        sense = recording["sense"]
        assert (recording.name, recording.device) == ("a", None)
        assert (sense.sample_rate, sense.start) == (rate, start)
        np.testing.assert_array_equal(sense.read(), values.astype(float))


CONTENTS = "run.mat holds x (5,), z (2, 2), label (1,), cell (2,)"


@pytest.mark.parametrize(
    ("swap", "line"),
    [
        (
            ("sample_rate = 1000.0", ""),
            "MAP: channels.sense_x: no sample_rate is stated for variable 'x', and the file states none; "
            f"add sample_rate = ...; {CONTENTS}",
        ),
        (
            ('unit = "nm"', ""),
            "MAP: channels.intensity: no unit is stated for variable 'z', and the file states none; "
            f"add unit = ...; {CONTENTS}",
        ),
        (('variable = "z"', ""), f"MAP: channels.intensity: says no variable; add variable = ...; {CONTENTS}"),
        (('variable = "x"', 'variable = "q"'), f"MAP: channels.sense_x: there is no variable 'q'; {CONTENTS}"),
        (('variable = "x"', "variable = 3"), "MAP: channels.sense_x: variable is 3 and must be text; put it in quotes"),
        (('unit = "nm"', "unit = 3"), "MAP: channels.intensity: unit is 3 and must be text; put it in quotes"),
        (
            ("start = 0.25", "delay = 0.25"),
            "MAP: channels.intensity: delay is not a known key; "
            "known: variable, unit, sample_rate, start, time, scale, offset",
        ),
        (
            ("scale = 1e4", "scale = 0"),
            "MAP: channels.intensity: scale must be a number other than 0, offset a number; "
            "channel = scale * variable + offset",
        ),
        (
            ("offset = -1.0", "offset = nan"),
            "MAP: channels.intensity: scale must be a number other than 0, offset a number; "
            "channel = scale * variable + offset",
        ),
        (('unit = "V"', 'unit = "kg"'), "BOTH: sense_x: unit 'kg' is unknown; accepted units: V, mV, uV"),
        (
            ("1000.0", '"1 kHz"'),
            "BOTH: sense_x: sample_rate is '1 kHz', not a finite number; state sample_rate as a number",
        ),
        (("1000.0", "-1"), "BOTH: sense_x: sample_rate is -1 Hz; state a rate from 1e-06 to 1e+15 Hz"),
        (('"x"', '"z"'), "BOTH: sense_x: has shape (2, 2); store it as (n,)"),
        (('"x"', '"cell"'), "BOTH: sense_x: holds object, not real numbers; store integers or floats"),
        (('"x"', '"label"'), "BOTH: sense_x: holds <U1, not real numbers; store integers or floats"),
        (
            ('"matlab"', '"labview"'),
            "SOURCE: format: format 'labview' is unknown; "
            "known formats: csv, hdf5, lvm, matlab, npy, npz, scope, tdms, wav",
        ),
        (('"matlab"', "7"), "MAP: format: is 7 and must be text; put it in quotes"),
        (("sense_x]", '"a/b"]'), "MAP: channels.a/b: is no name for a channel; name it without /"),
        (("sample_rate = 500", "sample_rate = 1" + "0" * 400), "BOTH: intensity: sample_rate is 1"),
        (
            ("start = 0.25", 'time = "x"'),
            "MAP: channels.intensity: says time and sample_rate; the times state the rate",
        ),
        (
            ('name = "bench"', "sample_rate = 5"),
            "MAP: sample_rate: is not a known key; known: format, name, notes, acquired, channels, device",
        ),
        (("gain = 2.0", ""), "MAP: x.readout.gain: is missing; [x.readout] needs gain, noise_sd"),
        (("name =", "name"), "MAP: is not TOML: Expected '=' after a key in a key/value pair (at line 3, column 6); "
         "correct the line 'name \"bench\"'"),
    ],
)  # fmt: skip
def test_an_incomplete_or_invalid_mapping_is_refused(bench: Path, swap: tuple[str, str], line: str) -> None:
    source, mapping = bench / "run.mat", bench / "map.toml"
    assert swap[0] in MAPPING
    mapping.write_text(MAPPING.replace(*swap, 1))
    with pytest.raises(BadInput) as caught:
        convert_file(source, mapping, bench / "run.h5")
    places = {"MAP": str(mapping), "BOTH": f"{source} by {mapping}", "SOURCE": str(source)}
    expected = reduce(lambda text, place: text.replace(*place), places.items(), line)
    assert str(caught.value).startswith(expected)
    assert not (bench / "run.h5").exists()


@pytest.mark.parametrize(
    ("text", "line"),
    [
        ("", "names no channels; add a table [channels.<name>] for each"),
        ("channels = 3", "names no channels; add a table [channels.<name>] for each"),
        (
            'format = "matlab"\nchannels.sense_x = "x"',
            "channels.sense_x: is 'x' and must be a table; write [channels.sense_x]",
        ),
        (
            "channels.sense.unit = 'V'\ndevice = 3",
            "device: must be a table; write [device.x.readout] and so on, or leave it out and give a device file "
            "with --device",
        ),
    ],
)
def test_a_mapping_without_channels_is_refused(bench: Path, text: str, line: str) -> None:
    (bench / "map.toml").write_text(text)
    with pytest.raises(BadInput) as caught:
        convert(bench / "run.mat", bench / "map.toml")
    assert str(caught.value) == f"{bench / 'map.toml'}: {line}"


def test_an_invalid_device_in_a_mapping_is_refused(bench: Path) -> None:
    (bench / "map.toml").write_text(MAPPING.replace("[device.x.readout]", "[device.z.readout]"))
    with pytest.raises(DeviceInvalid, match="holds no axis"):
        convert(bench / "run.mat", bench / "map.toml")


def test_a_file_that_is_not_a_complete_matlab_file_is_refused(bench: Path) -> None:
    whole = (bench / "run.mat").read_bytes()
    head = b"MATLAB 7.3 MAT-file".ljust(124) + b"\x00\x02IM"
    files = {
        "gone.mat": (None, "no such file; name the instrument's file"),
        "csv.mat": (b"t,V\n0,1\n", "is not a whole MATLAB file"),
        "empty.mat": (b"", "is not a whole MATLAB file"),
        "cut.mat": (whole[: len(whole) // 2], "is not a whole MATLAB file"),
        "new.mat": (
            head + bytes(400),
            "is not a whole MATLAB file: Please use HDF reader",
        ),
    }
    for name, (content, what) in files.items():
        if content is not None:
            (bench / name).write_bytes(content)
        with pytest.raises(BadInput) as caught:
            convert_file(bench / name, bench / "map.toml", bench / "run.h5")
        assert not (bench / "run.h5").exists()
        assert str(caught.value).startswith(f"{bench / name}: {what}")


def test_the_mapping_of_the_afm_example_converts_volts_to_micrometres(tmp_path: Path) -> None:
    savemat(tmp_path / "s.mat", {"x": np.array([0.0625, 0.1025]), "y": np.array([-0.0085, 0.0]), "z": np.ones(2)})
    recording = convert(tmp_path / "s.mat", ROOT / "examples/afm_spiral.toml")
    assert recording.device is not None
    readout = recording.device.axis("x").require_readout()
    microns = (recording["sense_x"].read() - readout.offset) / readout.gain  # type: ignore[union-attr]
    np.testing.assert_allclose(microns, [0.0, 3.0], atol=1e-12)
    np.testing.assert_allclose(recording["intensity"].read(), 1e4)


def test_open_any_opens_recordings_and_instruments_files(tmp_path: Path) -> None:
    np.savez(tmp_path / "a.npz", v=np.arange(5, dtype=np.int16))
    plan = {"channels": {"sense_x": {"variable": "v", "unit": "V", "sample_rate": 10.0, "scale": 0.5}}}
    with open_any(tmp_path / "a.npz", plan) as made:
        made.write(tmp_path / "a.h5")
    with open_any(tmp_path / "a.h5") as recording:
        assert recording["sense_x"].raw.dtype == np.int16  # stored with gain and offset
        np.testing.assert_array_equal(recording["sense_x"].read(), [0, 0.5, 1, 1.5, 2])
        assert recording.attrs["source_format"] == "NumPy archive"


def test_the_stated_unit_is_named_beside_the_one_it_is_converted_to(
    tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    np.savez(tmp_path / "a.npz", a=np.arange(5.0))
    given = [
        "convert",
        str(tmp_path / "a.npz"),
        "--channel",
        "sense_x=a",
        "--rate",
        "5e6",
        "-o",
        str(tmp_path / "a.h5"),
    ]
    assert main([*given, "--unit", "mV"]) == 0
    assert "sense_x: a, mV (option) converted to V, 5000000 Hz" in capsys.readouterr().out
    with Recording.open(tmp_path / "a.h5") as recording:
        np.testing.assert_allclose(recording["sense_x"].read(), 1e-3 * np.arange(5.0))


def test_arguments_replace_a_mapping(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    (tmp_path / "a.csv").write_text("t,a,b\n0,1,4\n1,2,5\n2,3,6\n")
    out = tmp_path / "a.h5"
    given = ["convert", str(tmp_path / "a.csv"), "--channel", "sense_x=a", "--channel", "intensity=b", "-o", str(out)]
    assert main([*given, "--unit", "V", "--unit", "intensity=counts", "--rate", "5e6", "--start", "sense_x=0.5"]) == 0
    assert "sense_x: a, V (option), 5000000 Hz (option), from 0.5 s (option), 3 samples" in capsys.readouterr().out
    with Recording.open(out) as recording:
        assert recording["intensity"].unit == "counts"
        assert (recording["sense_x"].start, recording["intensity"].start) == (0.5, 0.0)
    out.unlink()
    for wrong, words in {
        ("--unit", "V"): "no sample_rate is stated for variable 'a'",
        ("--rate", "fast"): "--rate: 'fast' is no number",
        ("--unit", "drive_x=V"): "--unit: 'drive_x' is no channel named by --channel",
        ("--channel", "sense_x=b"): "--channel: 'sense_x=b' is not NAME=VARIABLE, or repeats a channel",
        ("--mapping", "m.toml"): "--mapping: is given together with --channel",
    }.items():
        assert main([*given, *wrong]) == 2
        message = capsys.readouterr().err
        assert words in message
        assert message.count("\n") == 1
    assert main(["convert", str(tmp_path / "a.csv"), "-o", str(out)]) == 2
    assert "no option assigns variables to channels" in capsys.readouterr().err
    assert not out.exists()


@pytest.mark.slow
def test_an_instruments_file_gives_the_same_picture_as_the_recording(tmp_path: Path) -> None:
    sample_files.recording(tmp_path / "whole.h5")
    with h5py.File(tmp_path / "whole.h5") as file:
        columns = {name: file[f"channels/{name}"][:] for name in ("sense_y", "angle_x", "intensity")}
        device = str(file["device"].attrs["toml"])
    np.savez(tmp_path / "a.npz", **columns)
    units = {"angle_x": 'unit = "rad"\nscale = 1e-5\n'}
    lines = [
        f'[channels.{name}]\nvariable = "{name}"\nsample_rate = 1e6\n' + units.get(name, 'unit = "V"\n')
        for name in columns
    ]
    (tmp_path / "m.toml").write_text("".join(lines) + device.replace("[", "[device."))
    common = ["--pixels", "50x50", "-o"]
    assert main(["reconstruct", str(tmp_path / "whole.h5"), *common, str(tmp_path / "ours")]) == 0
    mapped = ["reconstruct", str(tmp_path / "a.npz"), "--mapping", str(tmp_path / "m.toml")]
    assert main([*mapped, *common, str(tmp_path / "theirs")]) == 0
    from_recording, from_mapping = (tifffile.imread(tmp_path / name / "image.tif") for name in ("ours", "theirs"))
    np.testing.assert_array_equal(from_recording, from_mapping)
