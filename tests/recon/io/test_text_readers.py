"""Readers of text files: oscilloscope CSV and LabVIEW measurement files, intact and damaged."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from recon.io.convert import convert
from recon.io.readers import read
from scanner.errors import BadInput
from tests.support.instrument_files import TEKTRONIX, stated_metadata, write_text

TDS = """\
"Record Length",3,"Points",-0.002,1.5
"Sample Interval",0.001,s,-0.001,2.5
"Source",CH2,,0.000,3.5
"Vertical Units",V,,0.001,4.5
"Horizontal Units",s,,0.002,5.5
,,,0.003,6.5
"""
LVM = """\
LabVIEW Measurement
Separator	Tab
Decimal_Separator	,
X_Columns	One
Time_Pref	Relative
***End_of_Header***
Channels	2
Samples	2	1
Y_Unit_Label	Volts	Degree
X_Dimension	Time	Time
X0	0,0	0,5
Delta_X	0,25	0,5
***End_of_Header***
X_Value	V	slow	Comment
0,00	1,5	7	warm
0,25	2,5\t
0,50	3,5	8
0,75	4,5\t
"""


@pytest.mark.parametrize(
    ("name", "content", "expected"),
    [
        ("tek.csv", TEKTRONIX, {"CH2": ("V", 2.5e9, -4e-3, [3.34, 3.3]), "CH3": ("mV", 2.5e9, -4e-3, [1, 2])}),
        ("old.csv", TDS, {"CH2": ("V", 1000.0, -0.002, [1.5, 2.5])}),
        (
            "key.csv",
            "x-axis,1,2\nsecond,Volt,Ampere\n-1.0E-03,+1.5,2\n-995.0E-06,2.5,\n-990.0E-06,2.5,4\n",
            {"1": ("V", 2e5, -1e-3, [1.5, 2.5]), "2": ("A", 2e5, -1e-3, [2, np.nan])},
        ),
        (
            "plain.csv", "t;v\n0,0;1,5\n0,1;2,5\n",
            {"t": (None, None, None, [0, 0.1]), "v": (None, None, None, [1.5, 2.5])},
        ),
        ("a.lvm", LVM, {"V": ("V", 4.0, 0.0, [1.5, 2.5]), "slow": ("deg", 2.0, 0.5, [7, 8])}),
    ],
)  # fmt: skip
def test_text_files_of_instruments_are_read(tmp_path: Path, name: str, content: str, expected: dict) -> None:
    variables = stated_metadata(write_text(tmp_path / name, content))
    assert variables.keys() == expected.keys()
    for variable, (unit, rate, start, values) in expected.items():
        assert variables[variable][0] == unit
        assert variables[variable][1:3] == (pytest.approx(rate), pytest.approx(start))
        np.testing.assert_array_equal(variables[variable][3], values)


def test_the_clock_of_rohde_schwarz_files_is_read_from_the_second_file(tmp_path: Path) -> None:
    path = write_text(tmp_path / "pulse.Wfm.csv", "0.1\n0.2\n0.3\n")
    assert stated_metadata(path) == {"column 1": (None, None, None, [0.1, 0.2])}
    write_text(tmp_path / "pulse.csv", "RecordLength:3:\nHardwareXStart:-1.12e-8:\nSignalResolution:2e-11:\n")
    assert stated_metadata(path) == {"column 1": (None, 5e10, -1.12e-8, [0.1, 0.2])}


@pytest.mark.parametrize(("rows", "start"), [(3, -2e-6), (5, -2.5e-6), (4, None)])
def test_the_number_of_values_selects_the_start_of_rohde_schwarz_files(
    tmp_path: Path, rows: int, start: float | None
) -> None:
    properties = {
        "SignalResolution": "5e-07", "BaseUnit": "eRS_UNIT_LEVEL_V", "XStart": "-2e-06", "RecordLength": "3",
        "HardwareXStart": "-2.5e-06", "SignalHardwareRecordLength": "5",
    }  # fmt: skip
    lines = [
        f'<Prop Avail="0" Name="{key}" Version="2" Value="{value}" UserValue="7"/>' for key, value in properties.items()
    ]
    path = write_text(tmp_path / "pulse.Wfm.csv", rows * "0.1\n")
    write_text(tmp_path / "pulse.bin", "\n".join(["<Database>", *lines, "</Database>"]))
    assert stated_metadata(path) == {"column 1": ("V", 2e6, start, [0.1, 0.1])}


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (("1,3.3", "1,3.3"), None),
        (("-3.9999996e-03", "-3.9999986e-03"), "its times are not uniform: sample 1"),
        (("3.3,2", "3.3"), "line 11 ends after 2 of 3 columns"),
        (("3.3,2", "3.3,two"), "line 11: 'two' is no number"),
        (("3.3,2", "1_000,2"), "line 11: '1_000' is no number"),
        (("3.3,2", "3.3," + 70000 * "2"), "line 11 is no line of a table"),
        (("Sample Interval,4e-10", "Sample Interval,-1"), None),
    ],
)
def test_damaged_text_is_refused_with_its_line(tmp_path: Path, change: tuple[str, str], words: str | None) -> None:
    path = write_text(tmp_path / "tek.csv", TEKTRONIX.replace(*change))
    plan = {"channels": {"sense_x": {"variable": "CH2"}}}
    if words is None:
        with convert(path, plan) as recording:  # the rate follows from the times if not from the header
            assert recording["sense_x"].sample_rate == pytest.approx(2.5e9)
    else:
        with pytest.raises(BadInput, match=words):
            convert(path, plan)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (("Channels\t2", "Channels\t9"), "says Channels 9 over 4 columns"),
        (("0,25\t2,5", "***End_of_Header***\n0,25\t2,5"), "more than one segment"),
        (("Delta_X\t0,25\t0,5\n***End", "Delta_X\t0,25\t0,5\n**End"), "a header is not closed"),
        (("LabVIEW", "LabView"), "is not a LabVIEW Measurement file"),
    ],
)
def test_damaged_lvm_files_are_refused(tmp_path: Path, change: tuple[str, str], words: str) -> None:
    assert change[0] in LVM
    with pytest.raises(BadInput, match=words):
        read(write_text(tmp_path / "a.lvm", LVM.replace(*change)), "lvm")


def test_decimal_commas_between_columns_with_commas_are_named(tmp_path: Path) -> None:
    path = tmp_path / "export.csv"
    path.write_text("Time (s),CH1 (V)\n0,00,1,25\n0,01,1,50\n0,02,1,75\n")
    with pytest.raises(BadInput, match="4 numbers without a point, and its heading 2 names; if commas are decimal"):
        read(path)


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ("t,v\n0,0\n1e-5,0,0627\n2e-5,0,1253\n", "line 3 has 3 fields, and the table 2 columns; if commas are decimal"),
        ('t,v\n0,1\n1,"1,234.5"\n', "line 3: '1,234.5' is no number; write numbers with a decimal point"),
        ('t,v\n0,"1,234.5"\n1,999.5\n', "line 2: '1,234.5' is no number"),
        ("t;v\n0;999,5\n1;1.000,5\n", "line 3: '1.000,5' is no number"),
        ("t;v\n0;1,5\n1;2.5\n", "line 3: '2.5' is no number"),
    ],
)
def test_numbers_with_ambiguous_marks_are_refused(tmp_path: Path, content: str, words: str) -> None:
    with pytest.raises(BadInput, match=words):
        read(write_text(tmp_path / "export.csv", content))


@pytest.mark.parametrize(
    ("content", "expected"),
    [
        ('t,"CH1, signal (V)",CH2 (V)\n0,1,2\n1,3,4\n', {"t": [0, 1], "CH1, signal": [1, 3], "CH2": [2, 4]}),
        ("t;v\n0;0\n1;0,5\n", {"t": [0, 1], "v": [0, 0.5]}),
        ("t,v,w\n0,1,\n1,2,3\n", {"t": [0, 1], "v": [1, 2], "w": [np.nan, 3]}),
    ],
)
def test_quoted_headings_and_a_first_row_without_marks_are_read(
    tmp_path: Path, content: str, expected: dict[str, list[float]]
) -> None:
    variables = read(write_text(tmp_path / "export.csv", content)).variables
    assert list(variables) == list(expected)
    for name, values in expected.items():
        np.testing.assert_array_equal(variables[name].raw[0:2], values)


SAMPLES = "".join(f"{-45.27 + 0.25 * k:.2f}\n" for k in range(40))


@pytest.mark.parametrize(
    "rows",
    [
        "0,1,2\n1,2\n2,3,4\n3,4,5\n",
        "0,1,2\n1,2,a\n2,3,4\n3,4,5\n",
    ],
)
def test_a_damaged_second_row_is_not_taken_for_settings(rows: str, tmp_path: Path) -> None:
    path = write_text(tmp_path / "cut.csv", "time,ch1,ch2\n" + rows)
    with pytest.raises(BadInput, match="line 3"):
        read(path)


def test_a_first_row_with_an_empty_end_belongs_to_the_table(tmp_path: Path) -> None:
    path = write_text(tmp_path / "gap.csv", "time,ch1,ch2\n0,1,\n1,2,\n2,3,4\n3,4,5\n")
    assert np.asarray(read(path).variables["ch1"].raw).ravel().tolist() == [1.0, 2.0, 3.0, 4.0]


@pytest.mark.parametrize(
    ("text", "names"),
    [
        ("start_deg, rate, duration\n45, 1000, 5 \n" + SAMPLES, ["column 1"]),
        ("start_deg,rate\n45,1000\n\nangle\n" + SAMPLES, ["angle"]),
        ("start_deg,rate\n45,1000\nangle\ndeg\n" + SAMPLES, ["angle"]),
    ],
)
def test_settings_above_a_table_of_other_columns_are_no_samples(text: str, names: list[str], tmp_path: Path) -> None:
    path = tmp_path / "swing.txt"
    path.write_text(text)
    contents = read(path)
    assert list(contents.variables) == names
    np.testing.assert_allclose(
        np.asarray(contents.variables[names[0]].raw).ravel(), -45.27 + 0.25 * np.arange(40), atol=1e-9
    )
    assert contents.about["notes"].startswith("start_deg = 45, rate = 1000")


def test_a_table_that_ends_within_a_line_is_still_refused(tmp_path: Path) -> None:
    path = tmp_path / "cut.csv"
    path.write_text("time,ch1,ch2\n0,1,2\n1,2,3\n2")
    with pytest.raises(BadInput, match="line 4 ends after 1 of 3 columns"):
        read(path)


@pytest.mark.parametrize("sources", ["CH1,CH3", "CH1"])
def test_columns_of_a_siglent_file_have_the_names_of_their_sources(tmp_path: Path, sources: str) -> None:
    width = sources.count(",") + 1
    head = [
        "Record Length,Analog:40", "Sample Interval,0.000005", "Vertical Units,CH1:V,CH3:V", "Horizontal Units,S",
        "Model Number,SDS2104X", f"Source,{sources}", "Second" + ",Value" * width,
    ]  # fmt: skip
    rows = [f"{k * 5e-6:.10f}" + f",{0.1 * k:.4f}" * width for k in range(40)]
    (tmp_path / "a.csv").write_text("\n".join([*head, *rows]), encoding="utf-8")
    contents = read(tmp_path / "a.csv")
    assert list(contents.variables) == sources.split(",")
    assert contents.variables["CH1"].unit == "V"
    assert contents.variables["CH1"].sample_rate == 2e5
    assert contents.about["device"] == "SDS2104X"
