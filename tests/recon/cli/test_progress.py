"""Progress on stderr does not run into what follows it."""

from pathlib import Path

import numpy as np
import pytest

from recon.cli import main
from recon.runtime import stage_progress
from scanner.recording import Recording


@pytest.mark.parametrize("option", [[], ["--plan"]])
def test_an_error_is_the_only_line_where_stderr_is_no_terminal(
    option: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    Recording.from_arrays({"sense_x": (np.arange(100.0), "V", 1e3)}).write(tmp_path / "scan.h5")
    arguments = [*option, str(tmp_path / "scan.h5"), "-o", str(tmp_path / "out")]
    assert main(["diagnose", *arguments]) == 2
    shown = capsys.readouterr().err
    assert shown.startswith("lissajous diagnose: ")
    assert shown.count("\n") == 1
    assert "\r" not in shown


def test_stages_of_long_work_are_lines_of_a_log_file(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    with stage_progress.stage_progress(quiet=False) as progress:
        progress("nominal device")
        monkeypatch.setattr(stage_progress, "SILENT_S", 0.0)
        progress("report")
    assert capsys.readouterr().err == "0 s  report\n"


def test_quiet_shows_no_stage(capsys: pytest.CaptureFixture[str]) -> None:
    with stage_progress.stage_progress(quiet=True) as progress:
        progress("report")
    assert not capsys.readouterr().err


def test_an_interrupt_states_the_stage_and_how_the_work_takes_less_time(capsys: pytest.CaptureFixture[str]) -> None:
    def work() -> None:
        with stage_progress.stage_progress(quiet=False) as progress:
            progress("fits with x cubic-stiffness")
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        work()
    shown = capsys.readouterr().err
    assert shown.startswith("stopped during: fits with x cubic-stiffness; a part of the recording takes less time")
    assert shown.count("\n") == 1
