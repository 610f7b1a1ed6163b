"""The plan of work on many recordings: whose results are kept, and whose are done anew."""

import json
from collections.abc import Callable
from pathlib import Path

import pytest

from recon.cli.diagnose_each import diagnose_each
from recon.cli.reconstruct_many import reconstruct_files
from recon.runtime import fleet
from recon.runtime.fleet import find_recordings, plan_fleet, run_fleet, state_inputs
from recon.steps.reconstruction import Options
from scanner import devices
from scanner.errors import BadInput

MAPPING = '[channels.intensity]\nvariable = "light"\nunit = "V"\nsample_rate = {rate}\n'


def reconstruct(recording: Path, output: Path, device: Path, mapping: Path) -> None:
    reconstruct_files([recording], output, Options(device=device), mapping, workers=1)


def diagnose(recording: Path, output: Path, device: Path, mapping: Path) -> None:
    diagnose_each([recording], output, device, mapping, workers=1)


@pytest.mark.parametrize("command", [reconstruct, diagnose])
@pytest.mark.parametrize("edited", ["device", "mapping"])
def test_results_of_a_file_that_was_edited_since_are_not_mixed_in(
    tmp_path: Path, command: Callable[[Path, Path, Path, Path], None], edited: str
) -> None:
    files = {"device": tmp_path / "device.toml", "mapping": tmp_path / "mapping.toml"}
    files["device"].write_text(devices.load("imaging").to_toml(), encoding="utf-8")
    files["mapping"].write_text(MAPPING.format(rate=1e6), encoding="utf-8")
    recording = tmp_path / "a.npz"
    recording.write_bytes(b"no recording")  # which the summary lists as failed
    command(recording, tmp_path / "out", **files)
    command(recording, tmp_path / "out", **files)
    text = files[edited].read_text(encoding="utf-8")
    files[edited].write_text(text.replace("sample_rate = 1", "sample_rate = 2").replace("k = 9", "k = 8"))
    assert files[edited].read_text(encoding="utf-8") != text
    with pytest.raises(BadInput, match="other options"):
        command(recording, tmp_path / "out", **files)


def test_the_same_contents_elsewhere_are_the_same_options(tmp_path: Path) -> None:
    (tmp_path / "a.toml").write_text(MAPPING.format(rate=1e6), encoding="utf-8")
    (tmp_path / "b.toml").write_text("# a comment\n" + MAPPING.format(rate=1e6), encoding="utf-8")
    (tmp_path / "imaging.toml").write_text(devices.load("imaging").to_toml(), encoding="utf-8")
    stated = state_inputs("imaging", tmp_path / "a.toml")
    assert stated == state_inputs(tmp_path / "imaging.toml", tmp_path / "b.toml")
    assert stated != state_inputs(None, tmp_path / "a.toml") != state_inputs(None, None)


@pytest.mark.parametrize("options", ["first", "second"])
def test_old_results_are_not_done_after_an_overwrite_that_was_killed(tmp_path: Path, options: str) -> None:
    recordings = [tmp_path / "a.h5", tmp_path / "b.h5"]
    for path in recordings:
        path.write_bytes(b"as it was")
    for folder in plan_fleet(recordings, tmp_path / "out", "first", "summary.json", False).folders.values():
        folder.mkdir()
        for name in ("summary.json", "image.tif"):
            (folder / name).write_text("old", encoding="utf-8")
    recordings[0].write_bytes(b"changed since")
    plan_fleet(recordings[:1], tmp_path / "out", options, "summary.json", True)  # killed before the work
    assert plan_fleet(recordings[:1], tmp_path / "out", options, "summary.json", False).done == frozenset()
    assert sorted(path.name for path in (tmp_path / "out" / "a").iterdir()) == ["image.tif"]
    assert (tmp_path / "out" / "b" / "summary.json").read_text(encoding="utf-8") == "old"


@pytest.mark.parametrize(
    "content",
    [
        [],
        {"recordings": {}},
        {"options": "first"},
        {"options": "first", "recordings": []},
        *({"options": "first", "recordings": {"a.h5": entry}} for entry in (3, {}, {"folder": "a"})),
        *(
            {"options": "first", "recordings": {"a.h5": {"folder": folder, "file": None}}}
            for folder in (3, ["a"], "", "..", "../a")
        ),
    ],
)
def test_a_damaged_list_of_folders_is_named_and_left(tmp_path: Path, content: object) -> None:
    (tmp_path / "out").mkdir()
    job = tmp_path / "out" / fleet.JOB_FILE
    job.write_text(json.dumps(content).replace("a.h5", str(tmp_path / "a.h5")), encoding="utf-8")
    before = job.read_bytes()
    (tmp_path / "a.h5").write_bytes(b"a recording")
    with pytest.raises(BadInput, match=r"job\.json: does not state .*; delete it"):
        plan_fleet([tmp_path / "a.h5"], tmp_path / "out", "first", "summary.json", False)
    assert job.read_bytes() == before


@pytest.mark.parametrize("content", ["", '{"fill": 0.', "[]", "3", '{"fill": 0.5}'])
def test_a_recording_whose_result_is_damaged_is_done_anew(tmp_path: Path, content: str) -> None:
    recording = tmp_path / "a.h5"
    recording.write_bytes(b"a recording")

    def plan() -> fleet.Fleet:
        return plan_fleet([recording], tmp_path / "out", "first", "summary.json", False, ("fill", "samples"))

    folder = plan().folders[recording]
    folder.mkdir()
    (folder / "summary.json").write_text('{"fill": 0.5, "samples": 3}', encoding="utf-8")
    assert plan().done == {recording}
    (folder / "summary.json").write_text(content, encoding="utf-8")
    assert plan().done == frozenset()


def test_registered_files_are_part_of_what_results_were_made_with(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path, stated = tmp_path / "terms.py", [state_inputs(None, None)]
    monkeypatch.setattr(fleet, "registered_files", lambda: (path,))
    for text in ("first", "second"):
        path.write_text(text, encoding="utf-8")
        stated.append(state_inputs(None, None))
    assert len(set(stated)) == 3


def work_with_errors(path: Path, folder: Path) -> None:
    if path.stem == "report":
        raise ValueError("All-NaN slice\nencountered")
    if path.stem == "light":
        raise BadInput("is constant", channel="intensity")
    folder.mkdir()


def test_an_error_of_one_recording_is_stated_with_its_name_and_stops_no_other(tmp_path: Path) -> None:
    recordings = [tmp_path / f"{name}.h5" for name in ("report", "light", "good")]
    for path in recordings:
        path.write_bytes(b"")
    plan = plan_fleet(recordings, tmp_path / "out", "options", "summary.json", False)
    failures = run_fleet(plan, work_with_errors, "reconstruct", workers=1)
    assert plan.folders[recordings[2]].is_dir()
    assert {path: failure.exit for path, failure in failures.items()} == {recordings[0]: 1, recordings[1]: 2}
    assert failures[recordings[0]].reason.startswith(f"{recordings[0]}: ended with ValueError: All-NaN slice encounter")
    assert failures[recordings[1]].reason == f"{recordings[1]}: intensity: is constant"


def test_each_visible_recording_is_found_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("b.h5", "a.h5", "._a.h5", "notes.txt"):
        (tmp_path / name).write_bytes(b"")
    monkeypatch.chdir(tmp_path)
    assert find_recordings([tmp_path, Path("a.h5")]) == [tmp_path / "a.h5", tmp_path / "b.h5"]
