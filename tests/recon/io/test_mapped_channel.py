"""A channel of a mapping: its clock from times, its unit, a row of a matrix, times of edges."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.io import savemat

from recon.io.convert import convert, convert_file
from scanner.errors import BadInput
from scanner.recording import Recording


def test_uniform_times_are_a_clock_and_times_with_a_jump_are_refused(tmp_path: Path) -> None:
    time = 0.5 + np.arange(1000) / 250.0
    plan = {"channels": {"sense_x": {"variable": "v", "unit": "mV", "time": "t"}}}
    savemat(tmp_path / "a.mat", {"v": np.arange(1000.0), "t": time})
    with convert(tmp_path / "a.mat", plan) as recording:
        sense = recording["sense_x"]
        assert (sense.sample_rate, sense.start) == (pytest.approx(250.0), 0.5)
        np.testing.assert_allclose(sense.read(998), [0.998, 0.999])
    for at in (1, 400, 998):  # one sample dropped
        savemat(tmp_path / "a.mat", {"v": np.arange(999.0), "t": np.delete(time, at)})
        with pytest.raises(BadInput, match=r"time = 't' is no clock: its times are not uniform"):
            convert(tmp_path / "a.mat", plan)
    savemat(tmp_path / "a.mat", {"v": np.arange(9.0), "t": np.zeros(9)})
    with pytest.raises(BadInput, match="its times do not rise"):
        convert(tmp_path / "a.mat", plan)


def test_times_since_1970_are_a_clock_where_the_mapping_states_the_start(tmp_path: Path) -> None:
    savemat(tmp_path / "a.mat", {"v": np.arange(20_000.0), "t": 1.7e9 + np.arange(20_000) / 1e5})
    channel = {"variable": "v", "unit": "mV", "time": "t"}
    with pytest.raises(BadInput, match=r"starts at 1.7e\+09 s, where times have steps of 2.4e-07 s"):
        convert(tmp_path / "a.mat", {"channels": {"sense_x": channel}})
    with convert(tmp_path / "a.mat", {"channels": {"sense_x": channel | {"start": 0.0}}}) as recording:
        sense = recording["sense_x"]
        assert (sense.sample_rate, sense.start) == (pytest.approx(1e5, rel=2e-6), 0.0)


def test_a_mapping_may_override_the_file_and_the_summary_reports_it(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text("x-axis,1\nsecond,Volt\n0.0,1.5\n1e-3,2.5\n2e-3,3.5\n")
    plan = {"channels": {"sense_x": {"variable": "1", "sample_rate": 2000.0}}}
    channel = convert_file(tmp_path / "a.csv", plan, tmp_path / "a.h5")["channels"]["sense_x"]
    assert (channel["sample_rate"], channel["overruled"]) == (2000.0, {"sample_rate": pytest.approx(1000.0)})
    assert channel["stated_by"] == {"unit": "file", "sample_rate": "mapping", "start": "file"}


def test_a_scaled_variable_needs_a_unit_in_the_mapping(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text("x-axis,1\nsecond,Volt\n0.0,1.5\n1e-3,2.5\n2e-3,3.5\n")
    plan = {"channels": {"angle_x": {"variable": "1", "scale": 0.1}}}
    with pytest.raises(BadInput, match="no unit is stated for variable '1'"):
        convert(tmp_path / "a.csv", plan)


def test_a_matrix_whose_rows_are_signals_is_no_channel(tmp_path: Path) -> None:
    np.savez(tmp_path / "a.npz", a=np.zeros((2, 50)))
    spec = {"variable": "a", "unit": "V", "sample_rate": 1e6}
    with pytest.raises(BadInput, match=r"'a' of shape \(2, 50\) has fewer samples than detectors; choose a row"):
        convert(tmp_path / "a.npz", {"channels": {"intensity": spec}})


def test_a_row_of_a_matrix_is_a_channel(tmp_path: Path) -> None:
    rows = np.arange(30.0).reshape(3, 10)
    np.savez(tmp_path / "a.npz", rows=rows)
    spec = {"variable": "rows", "unit": "V", "sample_rate": 10.0, "row": 1}
    with convert(tmp_path / "a.npz", {"channels": {"sense_x": spec}}) as made:
        assert np.array_equal(made["sense_x"].read(2, 5), rows[1, 2:5])
    for row in (3, -1, "first"):
        with pytest.raises(BadInput, match=f"no row {row!r} of 'rows'; count from 0"):
            convert(tmp_path / "a.npz", {"channels": {"sense_x": spec | {"row": row}}})


def test_a_matrix_of_one_column_is_a_list_of_edge_times_or_of_samples(tmp_path: Path) -> None:
    np.savez(tmp_path / "a.npz", volts=np.arange(8.0)[:, None], edges=np.arange(5.0)[:, None], one=np.float64(3.0))
    channels = {
        "sense_x": {"variable": "volts", "unit": "V", "sample_rate": 100.0},
        "sync_x": {"variable": "edges", "unit": "ms", "angle": 0.02},
    }
    with convert(tmp_path / "a.npz", {"channels": channels}) as made:
        np.testing.assert_array_equal(made["sense_x"].read(2, 5), [2.0, 3.0, 4.0])
        np.testing.assert_allclose(made.edges["sync_x"].times, 1e-3 * np.arange(5.0))
    channels["sync_x"]["variable"] = "one"
    with pytest.raises(BadInput, match=r"variable 'one' of shape \(\) is no list of numbers"):
        convert(tmp_path / "a.npz", {"channels": channels})


def test_edges_are_named_as_the_heading_with_its_unit(tmp_path: Path) -> None:
    lines = ["Time (s),Sync (V)", *(f"{k * 1e-6:.6f},{5 * (k // 50 % 2)}" for k in range(500))]
    (tmp_path / "scope.csv").write_text("\n".join(lines), encoding="utf-8")
    mapping = {"channels": {"sync_x": {"variable": "Sync (V)", "event": "both-edges"}}}
    assert convert(tmp_path / "scope.csv", mapping).edges["sync_x"].times.size == 9


def test_edge_times_become_a_sync_channel(tmp_path: Path) -> None:
    np.savez(tmp_path / "a.npz", light=np.ones(50), edges=np.arange(20.0))
    channels = {
        "intensity": {"variable": "light", "unit": "V", "sample_rate": 1e6},
        "sync_x": {"variable": "edges", "unit": "us", "angle": 0.02},
    }
    summary = convert_file(tmp_path / "a.npz", {"channels": channels}, tmp_path / "a.h5")
    assert summary["edges"] == {"sync_x": {"number": 20, "event": "both-edges"}}
    with Recording.open(tmp_path / "a.h5") as made:
        assert np.allclose(made.edges["sync_x"].times, 1e-6 * np.arange(20.0))
    unclocked, unknown = "no sample_rate is stated for variable 'edges'", "rate is not a known key of edges"
    for change, line in (({"unit": "V"}, unclocked), ({"rate": 1.0}, unknown)):
        wrong = channels | {"sync_x": channels["sync_x"] | change}
        with pytest.raises(BadInput, match=line):
            convert(tmp_path / "a.npz", {"channels": wrong})


@pytest.mark.parametrize("at", [0, 5, 99])
def test_a_missing_time_is_named(tmp_path: Path, at: int) -> None:
    times = np.arange(100) / 1e5
    times[at] = np.nan
    np.savez(tmp_path / "a.npz", v=np.zeros(100), t=times)
    mapping = {"channels": {"sense_x": {"variable": "v", "unit": "V", "time": "t"}}}
    with pytest.raises(BadInput, match=f"time = 't' is no clock: the time of sample {at} is missing"):
        convert(tmp_path / "a.npz", mapping)


def test_times_of_another_number_than_the_samples_are_refused(tmp_path: Path) -> None:
    values = {"v": np.zeros(1000), "w": np.zeros(1000), "rows": np.zeros((2, 1000))}
    np.savez(tmp_path / "a.npz", every=np.arange(1000.0), tenth=10.0 * np.arange(100), **values)
    specs = [
        ("sense_x", {"variable": "v", "unit": "V"}),
        ("sense_x", {"variable": "rows", "row": 1, "unit": "V"}),
        ("intensity", {"variable": ["v", "w"], "unit": "V"}),
    ]
    for name, spec in specs:
        made = convert(tmp_path / "a.npz", {"channels": {name: spec | {"time": "every"}}})
        assert made[name].sample_rate == 1.0
        with pytest.raises(BadInput, match=r"time = 'tenth' holds 100 times, and .* 1000 samples"):
            convert(tmp_path / "a.npz", {"channels": {name: spec | {"time": "tenth"}}})
    sync = {"variable": "v", "unit": "V", "time": "tenth", "event": "both-edges"}
    with pytest.raises(BadInput, match="holds 100 times"):
        convert(tmp_path / "a.npz", {"channels": {"sync_x": sync}})
