"""Terms of a user's file are available in all commands, and in the worker processes of a study."""

import argparse
import json
from dataclasses import replace
from pathlib import Path

import pytest

from recon.cli import COMMANDS, add_command, main
from recon.runtime.executors import open_executor, picklable_task
from recon.study.plan import plan_jobs, read_study
from scanner import devices, terms
from tests.support.user_term import USER_TERM

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
    """Folder with a device that states a user's term and the term's file; the catalogue has no user terms."""
    monkeypatch.setattr(terms, "_REGISTERED", {})
    device = devices.load("imaging")
    k7 = {"k7": 0.01 * device.axis("x").mechanics.k / 0.18**6}
    axes = dict(device.axes) | {"x": replace(device.axis("x"), terms={"septic-stiffness": k7})}
    (tmp_path / "device.toml").write_text(replace(device, axes=axes).to_toml())
    (tmp_path / "mine.py").write_text(USER_TERM)
    return tmp_path


@pytest.mark.slow
def test_device_with_a_user_term_is_simulated_and_reconstructed(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    device, scan, option = str(folder / "device.toml"), str(folder / "scan.h5"), ["--terms", str(folder / "mine.py")]
    assert main(["simulate", "-o", scan, "--device", device, "--duration", "0.006", "--rate", "2e6", *option]) == 0
    given = ["reconstruct", scan, "-o", str(folder / "out"), "--pixels", "60x60"]
    assert main([*given, *option]) == 0
    summary = json.loads((folder / "out" / "summary.json").read_text())
    assert summary["x"]["phase_rmse_deg"] < 0.1
    assert any("septic-stiffness" in note for note in summary["notes"])
    terms._REGISTERED.clear()
    capsys.readouterr()
    assert main([*given[:3], str(folder / "none"), "--pixels", "60x60"]) == 2
    message = capsys.readouterr().err
    assert "septic-stiffness" in message
    assert "--terms" in message
    assert not (folder / "none").exists()


def effects() -> list[str]:
    return list(terms.catalogue())


@pytest.mark.slow
def test_workers_have_the_terms_of_their_parent(folder: Path) -> None:
    terms.register(folder / "mine.py")
    with open_executor(workers=1) as executor:
        assert "septic-stiffness" in executor.submit(picklable_task(effects)).result()


def test_changed_term_file_changes_the_digest_of_a_study(folder: Path) -> None:
    (folder / "study.toml").write_text(STUDY)

    def digest() -> str:
        terms.register(folder / "mine.py")
        return next(iter(plan_jobs(read_study(folder / "study.toml")))).digest

    before = digest()
    assert digest() == before
    (folder / "mine.py").write_text(USER_TERM.replace("-p[0]", "-2.0 * p[0]"))
    assert digest() != before


@pytest.mark.parametrize("name", sorted(set(COMMANDS) - {"completion"}))
def test_missing_term_file_is_refused_in_one_line(
    name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:

    parser = argparse.ArgumentParser()
    add_command(name, parser)
    given = ["nothing.h5" for action in parser._actions if not action.option_strings]
    output = ["-o", str(tmp_path / "out")] if any("-o" in action.option_strings for action in parser._actions) else []
    assert main([name, *given, *output, "--terms", str(tmp_path / "none.py")]) == 2
    message = capsys.readouterr().err
    assert message.startswith(f"lissajous {name}: {tmp_path / 'none.py'}: no such file")
    assert message.count("\n") == 1
