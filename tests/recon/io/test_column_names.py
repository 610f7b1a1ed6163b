"""Tables as people and oscilloscopes write them: names with units, a line of units, a column of times, detectors."""

from pathlib import Path

import numpy as np
import pytest

from recon.cli import main
from recon.io.convert import convert
from recon.io.info import DEVICE_PART, info
from recon.io.readers import read
from recon.io.readers.column_names import find_time_column, is_unit_line, name_columns, split_label
from scanner.device import Device
from scanner.errors import BadInput
from scanner.files import parse_toml
from scanner.recording import Recording


def table(path: Path, head: str, times: list[float], columns: int = 2, separator: str = ",") -> Path:
    rows = [separator.join([f"{t:.9g}", *(f"{k + 0.5 * c:g}" for c in range(columns))]) for k, t in enumerate(times)]
    path.write_text(head + "\n".join(rows) + "\n", encoding="utf-8")
    return path


@pytest.mark.parametrize(
    ("label", "parts"),
    [("CH1 (V)", ("CH1", "V")), ("Time [ms]", ("Time", "ms")), ("Channel A", ("Channel A", "")), ("(V)", ("(V)", ""))],
)
def test_a_heading_is_split_into_name_and_unit(label: str, parts: tuple[str, str]) -> None:
    assert split_label(label) == parts


def test_a_line_of_units_belongs_to_the_names_above_it() -> None:
    assert is_unit_line(["(ms)", "(V)", "(mV)"])
    assert not is_unit_line(["Time", "Volt"])
    assert not is_unit_line(["", ""])
    assert name_columns([["Time", "Channel A"], ["(ms)", "(V)"], [""]], 2) == (["Time", "Channel A"], ["ms", "V"])
    assert name_columns([["Second", "Volt"]], 2) == (["Second", "Volt"], ["Second", "Volt"])
    assert name_columns([], 2) == (["", ""], ["", ""])
    assert find_time_column(["Time", "t"], ["s", "s"]) is None


@pytest.mark.parametrize(
    ("head", "step", "names", "units"),
    [
        ("Time (s),CH1 (V),CH2 (mV)\n", 1e-6, ["CH1", "CH2"], ["V", "mV"]),
        ("Time,Channel A,Channel B\n(ms),(V),(V)\n\n", 1e-3, ["Channel A", "Channel B"], ["V", "V"]),
        ("time [us],sense_x [V],photodiode [a.u.]\n", 1.0, ["sense_x", "photodiode"], ["V", "a.u."]),
        ("Model,DS1\nDate,today\nTime,A,B\ns,Volt,Volt\n", 1e-6, ["A", "B"], ["V", "V"]),
        ("Second,Volt,Volt\n", 1e-6, ["Volt (1)", "Volt (2)"], ["V", "V"]),
    ],
)
def test_headers_state_names_units_and_clock(
    tmp_path: Path, head: str, step: float, names: list[str], units: list[str]
) -> None:
    path = table(tmp_path / "a.csv", head, [k * step for k in range(50)])
    contents = read(path)
    signals = dict(list(contents.variables.items())[1:])
    assert list(signals) == names
    assert [each.unit for each in signals.values()] == units
    assert all(each.sample_rate == pytest.approx(1e6, rel=1e-9) for each in signals.values())
    assert all(each.start == 0.0 for each in signals.values())


def test_a_heading_that_two_columns_share_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    path, out = (
        table(tmp_path / "a.csv", "Time (s),CH1 (V),CH1 (V)\n", [k * 1e-6 for k in range(50)]),
        tmp_path / "a.h5",
    )
    for name in ("CH1", "CH1 (V)"):
        assert main(["convert", str(path), "--channel", f"sense_x={name}", "-o", str(out)]) == 2
        assert f"a.csv names several variables '{name}'; choose one by its number" in capsys.readouterr().err
        assert not out.exists()
    assert main(["convert", str(path), "--channel", "sense_x=CH1 (2)", "-o", str(out)]) == 0


def test_uneven_times_are_no_clock(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    times = [k * 1e-6 + (2e-6 if k > 30 else 0.0) for k in range(50)]
    path = table(tmp_path / "a.csv", "Time (s),CH1 (V),CH2 (V)\n", times)
    out = tmp_path / "a.h5"
    for extra in ([], ["--time", "Time"]):
        assert main(["convert", str(path), "--channel", "sense_x=CH1", *extra, "-o", str(out)]) == 2
        line = capsys.readouterr().err
        assert "its times are not uniform: sample" in line
        assert line.count("\n") == 1
    assert not out.exists()


def test_a_named_column_gives_the_clock(tmp_path: Path) -> None:
    path = table(tmp_path / "a.csv", "Time,Volt,Light\n", [0.5 + k * 2e-6 for k in range(40)])
    assert read(path).variables["Volt"].sample_rate is None
    assert "--time Time" in read(path).variables["Time"].note
    out = tmp_path / "a.h5"
    given = ["--channel", "sense_x=Volt", "--unit", "V", "--time", "Time"]
    assert main(["convert", str(path), *given, "-o", str(out)]) == 0
    with Recording.open(out) as recording:
        assert recording["sense_x"].sample_rate == pytest.approx(5e5, rel=1e-6)
        assert recording["sense_x"].start == pytest.approx(0.5)


def test_columns_become_the_detectors_of_an_intensity(tmp_path: Path) -> None:
    path = table(tmp_path / "a.csv", "Time (s),CH1 (V),CH2 (V),CH3 (V)\n", [k * 1e-6 for k in range(40)], 3)
    out = tmp_path / "a.h5"
    given = ["--channel", "sense_x=CH1 (V)", "--channel", "intensity=CH2,CH3"]
    assert main(["convert", str(path), *given, "-o", str(out)]) == 0
    with Recording.open(out) as recording:
        assert recording["intensity"].shape == (40, 2)
        assert recording["intensity"].read(3, 5).tolist() == [[3.5, 4.0], [4.5, 5.0]]
        assert recording["intensity"].unit == "V"


def test_detectors_have_to_agree(tmp_path: Path) -> None:
    np.savez(tmp_path / "a.npz", a=np.arange(10.0), b=np.arange(9.0))
    spec = {"unit": "V", "sample_rate": 1e6}
    with pytest.raises(BadInput, match="detectors differ in length: a 10, b 9 samples"):
        convert(tmp_path / "a.npz", {"channels": {"intensity": {"variable": ["a", "b"], **spec}}})
    table(tmp_path / "b.csv", "Time (s),CH1 (V),CH2 (mV)\n", [k * 1e-6 for k in range(9)])
    with pytest.raises(BadInput, match="detectors differ in unit"):
        convert(tmp_path / "b.csv", {"channels": {"intensity": {"variable": ["CH1", "CH2"]}}})
    for wrong in ([], ["a", 1], 5):
        with pytest.raises(BadInput, match="must be text; put it in quotes, or a list of names"):
            convert(tmp_path / "a.npz", {"channels": {"intensity": {"variable": wrong, **spec}}})


def test_the_suggested_mapping_works_after_editing(tmp_path: Path) -> None:
    path = table(tmp_path / "a.csv", "Time (s),CH1 (V),CH2 (V)\n", [k * 1e-6 for k in range(40)])
    suggestion = info(path)["suggestion"]
    assert "channels.Time" not in suggestion
    device = "\n".join(line.removeprefix("# ") for line in DEVICE_PART.splitlines()[1:])
    edited = suggestion.replace(DEVICE_PART, device).replace("channels.CH1", "channels.sense_x")
    with convert(path, parse_toml(edited, "suggestion")) as recording:
        assert recording["sense_x"].sample_rate == pytest.approx(1e6)
        assert isinstance(recording.device, Device)
        assert recording.device.require_scan().half_angle_x == 0.1
        assert recording.device.extra == {}


def test_a_variable_whose_name_has_a_comma_is_named_in_quotes(tmp_path: Path) -> None:
    path, out = tmp_path / "scope.csv", tmp_path / "scan.h5"
    path.write_text('Time (s),"CH1, signal (V)",CH2 (V)\n0,1,2\n1e-5,3,4\n2e-5,5,6\n')
    assert main(["convert", str(path), "--channel", 'sense_x="CH1, signal"', "-o", str(out)]) == 0
    with Recording.open(out) as recording:
        np.testing.assert_array_equal(recording["sense_x"].read(), [1.0, 3.0, 5.0])
