"""A user's own term file is taken wherever a device is: in this process, and in the workers that jobs go to."""

import argparse
import json
from dataclasses import replace
from pathlib import Path

import pytest
from test_terms import USER_TERM

from recon.cli import COMMANDS, add_command, main
from recon.executors import executor_of, task
from recon.study.plan import jobs, read_study
from scanner import devices, terms

STUDY = """
name = "own"
phantoms = ["usaf_bars"]
estimators = ["tracker"]
[[designs]]
name = "a"
device = "device.toml"
drive_x = [27680.0, 30.0, 30.0]
drive_y = [6540.0, 30.0, 30.0]
"""


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A device that states a user's term, the term's file, and a catalogue that does not know it yet."""
    monkeypatch.setattr(terms, "_REGISTERED", {})
    device = devices.load("imaging")
    k7 = {"k7": 0.01 * device.axis("x").mechanics.k / 0.18**6}
    axes = dict(device.axes) | {"x": replace(device.axis("x"), terms={"septic-stiffness": k7})}
    (tmp_path / "device.toml").write_text(replace(device, axes=axes).to_toml())
    (tmp_path / "mine.py").write_text(USER_TERM)
    return tmp_path


def test_a_device_with_a_term_of_ones_own_is_simulated_and_reconstructed(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    device, scan, own = str(folder / "device.toml"), str(folder / "scan.h5"), ["--terms", str(folder / "mine.py")]
    assert main(["simulate", "-o", scan, "--device", device, "--duration", "0.006", "--rate", "2e6", *own]) == 0
    given = ["reconstruct", scan, "-o", str(folder / "out"), "--pixels", "60x60"]
    assert main([*given, *own]) == 0
    summary = json.loads((folder / "out" / "summary.json").read_text())
    assert summary["x"]["phase_rmse_deg"] < 0.1
    assert any("septic-stiffness" in note for note in summary["notes"])
    terms._REGISTERED.clear()
    capsys.readouterr()
    assert main([*given[:3], str(folder / "none"), "--pixels", "60x60"]) == 2
    told = capsys.readouterr().err
    assert "septic-stiffness" in told
    assert "--terms" in told
    assert not (folder / "none").exists()


def effects() -> list[str]:
    return list(terms.catalogue())


def test_workers_know_the_terms_of_their_parent(folder: Path) -> None:
    terms.register(folder / "mine.py")
    with executor_of(workers=1) as executor:
        assert "septic-stiffness" in executor.submit(task(effects)).result()


def test_a_changed_term_file_is_another_study(folder: Path) -> None:
    (folder / "study.toml").write_text(STUDY)

    def digest() -> str:
        terms.register(folder / "mine.py")
        return next(iter(jobs(read_study(folder / "study.toml")))).of

    before = digest()
    assert digest() == before
    (folder / "mine.py").write_text(USER_TERM.replace("-p[0]", "-2.0 * p[0]"))
    assert digest() != before


@pytest.mark.parametrize("name", sorted(set(COMMANDS) - {"completion"}))
def test_a_term_file_that_is_not_there_is_one_line(
    name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:

    parser = argparse.ArgumentParser()
    add_command(name, parser)
    given = ["nothing.h5" for each in parser._actions if not each.option_strings]
    output = ["-o", str(tmp_path / "out")] if any("-o" in each.option_strings for each in parser._actions) else []
    assert main([name, *given, *output, "--terms", str(tmp_path / "none.py")]) == 2
    told = capsys.readouterr().err
    assert told.startswith(f"lissajous {name}: {tmp_path / 'none.py'}: no such file")
    assert told.count("\n") == 1
