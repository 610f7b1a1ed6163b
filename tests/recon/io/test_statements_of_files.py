"""What foreign files state of unit, rate and scale, and what the command says of what they do not state."""

from pathlib import Path

import h5py
import numpy as np
import pytest
from scipy.io import savemat

from recon.cli import main
from recon.io.convert import convert
from recon.io.readers import read
from scanner.errors import BadInput, UnitUnknown
from scanner.recording import Recording

COUNTS = np.round(2048 + 1500 * np.sin(np.arange(400) / 7.0)).astype(np.uint16)


def converted(folder: Path, capsys: pytest.CaptureFixture, *options: str) -> tuple[int, str, str]:
    source = folder / "counts.npz"
    np.savez(source, x=COUNTS, square=np.where(COUNTS > 2048, 5.0, -5.0), volts=COUNTS / 1000.0)
    code = main(["convert", str(source), "--rate", "1e6", *options, "-o", str(folder / "out.h5")])
    printed = capsys.readouterr()
    return code, printed.out, printed.err


def test_hdf5_attributes_state_unit_and_rate(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "lab.h5", "w") as file:
        for name, unit in (("a", "Volts"), ("b", b"mV"), ("c", np.array(["counts"], dtype=object))):
            file[f"daq/{name}"] = np.arange(20.0)
            file[f"daq/{name}"].attrs["units" if name != "b" else "unit"] = unit
            file[f"daq/{name}"].attrs["sampling_rate" if name == "a" else "rate"] = 2e5
        file["daq/scaled"] = np.arange(20, dtype=np.int16)
        file["daq/scaled"].attrs.update({"units": "V", "scale_factor": 0.001})
        file["daq/strange"] = np.arange(20.0)
        file["daq/strange"].attrs.update({"units": 3, "sample_rate": "fast"})
    variables = read(tmp_path / "lab.h5").variables
    assert [variables[f"daq.{name}"].unit for name in ("a", "b", "c", "scaled", "strange")] == [
        "V", "mV", "counts", None, None,
    ]  # fmt: skip
    assert [variables[f"daq.{name}"].sample_rate for name in "ab"] == [2e5, None]
    assert variables["daq.scaled"].note == "stored with scale_factor = 0.001, unit V"
    plan = {"channels": {"sense_x": {"variable": "daq.b", "sample_rate": 1e6}}}
    with convert(tmp_path / "lab.h5", plan) as recording:
        assert recording["sense_x"].read()[-1] == pytest.approx(0.019)
    plan["channels"]["sense_x"]["variable"] = "daq.scaled"
    with pytest.raises(BadInput, match=r"the file states none \(stored with scale_factor = 0\.001, unit V\)"):
        convert(tmp_path / "lab.h5", plan)


def test_fields_of_matlab_structures_are_variables(tmp_path: Path) -> None:
    inner = {"pmt": COUNTS, "text": "note"}
    savemat(tmp_path / "s.mat", {"data": {"x": np.arange(400.0), "daq": inner}, "fs": 1e6})
    variables = read(tmp_path / "s.mat").variables
    assert set(variables) == {"data.x", "data.daq.pmt", "data.daq.text", "fs"}
    np.testing.assert_array_equal(variables["data.daq.pmt"].raw[10:20], COUNTS[10:20])
    assert variables["data.daq.pmt"].raw.dtype == np.uint16
    assert not variables["data.daq.text"].is_signal


def test_one_numpy_array_is_read_by_columns_or_fields(tmp_path: Path) -> None:
    np.save(tmp_path / "table.npy", np.stack([COUNTS, COUNTS + 1], axis=1))
    np.save(tmp_path / "line.npy", COUNTS)
    np.save(tmp_path / "named.npy", np.array([(1, 2.0), (3, 4.0)], dtype=[("x", "i4"), ("y", "f8")]))
    found = {name: read(tmp_path / f"{name}.npy").variables for name in ("table", "line", "named")}
    assert [list(variables) for variables in found.values()] == [["column 1", "column 2"], ["line"], ["x", "y"]]
    np.testing.assert_array_equal(found["table"]["column 2"].raw[5:9], COUNTS[5:9] + 1)
    np.save(tmp_path / "objects.npy", np.array([{}]), allow_pickle=True)
    with pytest.raises(BadInput, match=r"objects\.npy: is not a whole NumPy array: .*save it again"):
        read(tmp_path / "objects.npy")


@pytest.mark.parametrize(
    ("variable", "options", "warned"),
    [
        ("x", (), True),
        ("x", ("--scale", "sense_x=0.001", "--offset", "sense_x=-2.048"), False),
        ("square", (), False),
        ("volts", (), False),
    ],
)
def test_whole_numbers_taken_as_volts_are_named(
    variable: str, options: tuple[str, ...], warned: bool, tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    code, out, _ = converted(tmp_path, capsys, "--channel", f"sense_x={variable}", "--unit", "V", *options)
    assert code == 0
    assert ("sense_x: integer values from 548 to 3548 are interpreted as V" in out) == warned
    if options:
        with Recording.open(tmp_path / "out.h5") as recording:
            assert recording["sense_x"].read() == pytest.approx((COUNTS - 2048.0) / 1000.0)


def test_times_without_a_unit_are_named_once(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    np.savez(tmp_path / "a.npz", x=COUNTS / 1000.0, y=COUNTS / 1000.0, time_us=np.arange(COUNTS.size))
    channels = ["--channel", "sense_x=x", "--channel", "sense_y=y", "--unit", "V"]
    given = ["convert", str(tmp_path / "a.npz"), *channels, "-o", str(tmp_path / "a.h5")]
    assert main([*given, "--time", "time_us"]) == 0
    assert (
        capsys.readouterr().out.count("time_us: no unit is stated for these times, and they are interpreted as sec")
        == 1
    )
    assert main([*given, "--rate", "1e6"]) == 0
    assert "interpreted as seconds" not in capsys.readouterr().out


def test_messages_name_the_options_that_are_missing(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    _, _, error = converted(tmp_path, capsys, "--channel", "sense_x=x")
    assert "counts.npz: sense_x: no unit is stated for variable 'x', and the file states none" in error
    assert "; add --unit sense_x=UNIT; counts.npz holds x" in error
    _, _, error = converted(tmp_path, capsys, "--channel", "sense_x=x", "--unit", "counts")
    assert "state the unit after scaling and its size per count: --scale sense_x=0.0005 --unit sense_x=V" in error
    assert error.count("\n") == 1
    assert not (tmp_path / "out.h5").exists()


def test_messages_name_the_keys_of_a_mapping_that_are_missing(tmp_path: Path) -> None:
    np.savez(tmp_path / "counts.npz", x=COUNTS)
    plan = {"channels": {"sense_x": {"variable": "x", "sample_rate": 1e6, "unit": "counts"}}}
    with pytest.raises(UnitUnknown, match=r'its size per count: scale = 0\.0005, unit = "V"'):
        convert(tmp_path / "counts.npz", plan)


@pytest.mark.parametrize(("kept", "rate"), [(1, 2.5e6), (10, 2.5e5)])
def test_the_times_of_a_table_of_which_rows_were_removed_are_its_clock(tmp_path: Path, kept: int, rate: float) -> None:
    head = ["Model,MDO", "Horizontal Units,s", "Sample Interval,4e-07", "Vertical Units,V", "TIME,CH1"]
    rows = [f"{4e-7 * k - 0.02:.6e},{k % 7}" for k in range(0, 5000, kept)]
    (tmp_path / "scope.csv").write_text("\n".join([*head, *rows]), encoding="utf-8")
    variable = read(tmp_path / "scope.csv").variables["CH1"]
    assert variable.sample_rate == pytest.approx(rate, rel=1e-9)
    assert variable.start == pytest.approx(-0.02)
    assert ("the header states 2.5e+06 Hz" in variable.note) == (kept > 1)


@pytest.mark.parametrize("step", ["", "Delta_X\t0.001\t\n"])
def test_the_times_of_a_labview_table_are_its_clock(tmp_path: Path, step: str) -> None:
    lines = ["LabVIEW Measurement", "Separator\tTab", "X_Columns\tOne", "***End_of_Header***", "Channels\t1"]
    lines += [f"{step}Y_Unit_Label\tVolts", "***End_of_Header***", "X_Value\tCH1"]
    lines += [f"{1e-4 * k:.6f}\t{k % 7}" for k in range(200)]
    (tmp_path / "decay.lvm").write_text("\n".join(lines), encoding="utf-8")
    assert read(tmp_path / "decay.lvm").variables["CH1"].sample_rate == pytest.approx(1e4, rel=1e-9)


def test_a_table_below_a_record_length_is_no_table_beside_it(tmp_path: Path) -> None:
    head = ["Record Length,Analog:30", "Sample Interval,Analog:1e-06", "Vertical Units,CH1:V", "Horizontal Units,s"]
    rows = [f"{1e-6 * k - 1e-5:.7f},{k % 5}" for k in range(30)]
    (tmp_path / "scope.csv").write_text("\n".join([*head, "Second,Volt", *rows]), encoding="utf-8")
    variable = read(tmp_path / "scope.csv").variables["Volt"]
    assert (variable.unit, variable.sample_rate) == ("V", pytest.approx(1e6))
    assert variable.start == pytest.approx(-1e-5)
