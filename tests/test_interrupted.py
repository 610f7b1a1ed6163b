"""Stopped at any moment, or with nowhere to write to: a command leaves nothing that looks finished, and says so.

``LISSAJOUS_FUZZ=20 pytest tests/test_interrupted.py`` stops each command at 20 moments instead of one, by each signal.
"""

from __future__ import annotations

import os
import resource
import signal
import time
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import h5py
import numpy as np
import pytest
from damage import tried
from study_worlds import small_study

from recon.cli import main
from recon.stopping import stoppable
from scanner import devices
from scanner.recording import Recording

MOMENTS = int(os.environ.get("LISSAJOUS_FUZZ", "1"))
SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGKILL)
LONG = 1.0 if MOMENTS == 1 else 4.0  # s of a diagnosis, which takes much longer
RECONSTRUCTED = {
    "image.tif", "coverage.tif", "motion.h5", "summary.json", "image.png", "report.html",
}  # fmt: skip


@dataclass(frozen=True)
class Case:
    """A command on small inputs.

    Attributes:
        arguments: without ``-o``.
        whole: names in the output that is finished; None where the output is a file.
        longest: seconds within which it is stopped.
    """

    arguments: tuple[str, ...]
    whole: frozenset[str] | None
    longest: float = 1.5


@pytest.fixture(scope="module")
def cases(tmp_path_factory: pytest.TempPathFactory) -> Mapping[str, Case]:
    folder = tmp_path_factory.mktemp("inputs")
    scan, decay, study = folder / "scan.h5", folder / "decay.h5", small_study(folder)
    small = ("--pixels", "60x60")
    assert main(["simulate", "-o", str(scan), "--duration", "0.006", "--rate", "2e6", "--angles"]) == 0
    assert main(["reconstruct", str(scan), "-o", str(folder / "warm"), *small]) == 0
    time_s = np.arange(40_000) / 5e5
    axis = devices.load("chen2019").axis("x")
    angle = 0.15 * np.exp(-60.0 * time_s) * np.cos(2 * np.pi * axis.resonance * time_s)
    noisy = angle + 1e-4 * np.random.default_rng(0).standard_normal(angle.size)
    bias = np.full(angle.size, 10.0)
    Recording.from_arrays(
        {"angle_x": (noisy, "rad", 5e5, 0.0), "bias_x": (bias, "V", 5e5, 0.0)}, devices.load("chen2019")
    ).write(decay)
    np.savez(folder / "a.npz", v=np.zeros(24_000_000, "f4"))
    return {
        "simulate": Case(("simulate", "--duration", "0.006", "--rate", "2e6"), None),
        "convert": Case(
            ("convert", f"{folder / 'a.npz'}", "--channel", "intensity=v", "--rate", "1e6", "--unit", "V"), None
        ),
        "reconstruct": Case(("reconstruct", f"{scan}", *small), frozenset(RECONSTRUCTED)),
        "many": Case(
            ("reconstruct", f"{scan}", f"{scan.parent}/../{folder.name}/scan.h5", "--workers", "1", *small),
            frozenset({"scan", "scan-2", "summary.json", "index.html"}), 8.0,
        ),
        "identify": Case(("identify", f"{decay}"), frozenset({"device.toml", "summary.json", "report.html"})),
        "predict": Case(("predict", f"{scan}"), frozenset({"predicted.h5", "summary.json"})),
        "diagnose": Case(("diagnose", f"{scan}"), frozenset({"diagnosis.json", "device.toml", "report.html"}), LONG),
        "design": Case(("design", "--pixels", "200x200"), frozenset({"summary.json", "report.html"})),
        "blur-study": Case(
            ("blur-study", f"{study}", "--workers", "1"),
            frozenset({"cells.jsonl", "table.csv", "summary.json", "report.html", "study.toml"}), 8.0,
        ),
    }  # fmt: skip


EVERY = SIGNALS if MOMENTS > 1 else ()
STOPPED = {
    "simulate": SIGNALS, "convert": SIGNALS, "reconstruct": SIGNALS, "many": EVERY or (signal.SIGTERM,),
    "identify": EVERY or (signal.SIGINT,), "predict": EVERY or (signal.SIGTERM,),
    "diagnose": EVERY or (signal.SIGINT,), "design": EVERY or (signal.SIGTERM,), "blur-study": EVERY,
}  # fmt: skip
FULL = [
    *((name, room) for name in ("simulate", "convert", "reconstruct") for room in (400, 60_000)),
    *((name, 400) for name in ("identify", "predict", "design", "blur-study") if EVERY),
]
"""Commands, and bytes that a file may have."""


def looks_finished(output: Path, case: Case) -> bool:
    """Whether somebody who finds ``output`` would take it for done; what stands there may be opened."""
    if case.whole is None:
        if output.exists():
            Recording.open(output).close()
        return output.exists()
    if not output.exists():
        return False
    for part in output.iterdir():
        if part.is_dir() and not part.name.startswith("."):
            assert {each.name for each in part.iterdir()} == RECONSTRUCTED
    names = {each.name for each in output.iterdir() if not each.name.startswith(".")}
    for each in output.rglob("*.h5"):
        h5py.File(each).close()
    return names >= case.whole


def left_behind(folder: Path) -> list[Path]:
    return [path for path in folder.rglob("*") if path.name.endswith(".part")]


@pytest.mark.parametrize(("name", "by"), [(name, by) for name, signals in STOPPED.items() for by in signals])
def test_a_command_that_is_stopped_leaves_nothing_that_looks_finished(
    cases: Mapping[str, Case], tmp_path: Path, name: str, by: signal.Signals
) -> None:
    case, rng = cases[name], np.random.default_rng([len(name), by])
    for number in range(MOMENTS):
        output = tmp_path / f"out{number}" if case.whole else tmp_path / f"out{number}.h5"
        begun = time.monotonic()

        def stop(pid: int, number: int = number, begun: float = begun) -> None:
            """When something is being written, at first; then at any time."""
            end = begun + (case.longest * rng.random() if number else case.longest)
            while time.monotonic() < end and (number or not left_behind(tmp_path)):
                time.sleep(0.002)
            time.sleep(0.01 * rng.random())
            os.kill(pid, by)

        given = [*case.arguments, "-o", str(output)]
        outcome = tried(lambda given=given: main(given), tmp_path / "log", stop, seconds=90)
        lines = [line for line in outcome.told.replace("\r", "\n").splitlines() if line.startswith("lissajous")]
        assert "Traceback" not in outcome.told, outcome
        assert looks_finished(output, case) == (outcome.code == 0), (number, outcome)
        if by != signal.SIGKILL and (outcome.code, outcome.told) != (-by, ""):  # which came before the command began
            assert not left_behind(tmp_path), outcome
            assert outcome.code in (0, 1), outcome
            assert len(lines) == outcome.code, outcome
            assert not lines or "interrupted" in lines[0]
        for path in left_behind(tmp_path):
            path.rename(path.with_suffix(".seen"))


@pytest.mark.parametrize(("name", "room"), FULL)
def test_a_full_disk_leaves_nothing(cases: Mapping[str, Case], tmp_path: Path, name: str, room: int) -> None:
    case, output = cases[name], tmp_path / "out"

    def little_room() -> int:
        signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
        resource.setrlimit(resource.RLIMIT_FSIZE, (room, room))
        return main([*case.arguments, "-o", str(output)])

    outcome = tried(little_room, tmp_path / "log", seconds=90)
    lines = [line for line in outcome.told.replace("\r", "\n").splitlines() if line.startswith("lissajous")]
    assert (outcome.code, len(lines)) == (1, 1), outcome
    assert "Traceback" not in outcome.told
    assert lines[0].startswith(f"lissajous {case.arguments[0]}: {output}")
    assert lines[0].endswith((": File too large", " written"))
    assert not looks_finished(output, case)
    assert not left_behind(tmp_path)


# --- an interrupt that compiled code loses ---------------------------------------------------------------------------


def test_an_interrupt_that_got_lost_comes_again(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("recon.stopping.AGAIN", 0.05)
    before = signal.getsignal(signal.SIGINT)
    with stoppable() as stop:
        assert not stop.came
        with suppress(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)
        assert stop.came
        try:
            time.sleep(5.0)
        except KeyboardInterrupt:
            time.sleep(0.2)  # whoever tidies up is left alone
        else:
            pytest.fail("it did not come again")
    assert signal.getsignal(signal.SIGINT) == before
    assert signal.getitimer(signal.ITIMER_REAL) == (0.0, 0.0)


@pytest.mark.parametrize("made_of_it", [TypeError, SystemError, RuntimeError])
def test_whatever_becomes_of_an_interrupt_is_one_line(
    made_of_it: type[Exception], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def work(args: object) -> None:
        try:
            signal.raise_signal(signal.SIGTERM)
        except KeyboardInterrupt:
            raise made_of_it("'sig'") from None

    monkeypatch.setattr("recon.commands.info.run", work)
    assert main(["info", "a.h5"]) == 1
    assert capsys.readouterr().err == "lissajous info: interrupted; nothing was written\n"


def test_an_error_of_its_own_is_not_taken_for_an_interrupt(monkeypatch: pytest.MonkeyPatch) -> None:
    def work(args: object) -> None:
        raise TypeError("a fault of ours")

    monkeypatch.setattr("recon.commands.info.run", work)
    with pytest.raises(TypeError, match="of ours"):
        main(["info", "a.h5"])
