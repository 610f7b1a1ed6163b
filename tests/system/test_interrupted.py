"""A command that is stopped, or that cannot write, leaves no output that looks finished and reports it.

``LISSAJOUS_FUZZ=20 pytest tests/system/test_interrupted.py`` stops each command 20 times with each signal.
"""

from __future__ import annotations

import os
import resource
import signal
import time
from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager, suppress
from dataclasses import dataclass
from pathlib import Path

import h5py
import numpy as np
import pytest

from recon.cli import main
from recon.io.output import replacing_folder
from recon.runtime.interrupts import handle_interrupts
from scanner import devices
from scanner.files import replacing
from scanner.recording import Recording
from tests.support.fuzzing import run_in_child
from tests.support.study import small_study

STOPS_PER_COMMAND = int(os.environ.get("LISSAJOUS_FUZZ", "1"))
SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGKILL)
DIAGNOSIS_STOP_TIME_S = 1.0 if STOPS_PER_COMMAND == 1 else 4.0  # a diagnosis takes much longer
RECONSTRUCTED = {
    "image.tif", "image_sd.tif", "coverage.tif", "motion.h5", "summary.json", "image.png", "report.html",
}  # fmt: skip


@dataclass(frozen=True)
class Case:
    """A command on small inputs.

    Attributes:
        arguments: without ``-o``.
        finished_names: names in a finished output folder; None if the output is a file.
        stop_time_s: time within which the command is stopped [s].
    """

    arguments: tuple[str, ...]
    finished_names: frozenset[str] | None
    stop_time_s: float = 1.5


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
        "diagnose": Case(
            ("diagnose", f"{scan}"), frozenset({"diagnosis.json", "device.toml", "report.html"}), DIAGNOSIS_STOP_TIME_S
        ),
        "design": Case(("design", "--pixels", "200x200"), frozenset({"summary.json", "report.html"})),
        "blur-study": Case(
            ("blur-study", f"{study}", "--workers", "1"),
            frozenset({"cells.jsonl", "table.csv", "summary.json", "report.html", "study.toml"}), 8.0,
        ),
    }  # fmt: skip


ALL_SIGNALS = SIGNALS if STOPS_PER_COMMAND > 1 else ()
SIGNALS_OF_COMMAND = {
    "simulate": SIGNALS, "convert": SIGNALS, "reconstruct": SIGNALS, "many": ALL_SIGNALS or (signal.SIGTERM,),
    "identify": ALL_SIGNALS or (signal.SIGINT,), "predict": ALL_SIGNALS or (signal.SIGTERM,),
    "diagnose": ALL_SIGNALS or (signal.SIGINT,), "design": ALL_SIGNALS or (signal.SIGTERM,), "blur-study": ALL_SIGNALS,
}  # fmt: skip
FULL_DISK_CASES = [
    *((name, max_bytes) for name in ("simulate", "convert", "reconstruct") for max_bytes in (400, 60_000)),
    *((name, 400) for name in ("identify", "predict", "design", "blur-study") if ALL_SIGNALS),
]
"""Commands, and the largest size of a file [bytes]."""


def looks_finished(output: Path, case: Case) -> bool:
    """Whether ``output`` looks finished. Files in it must be readable."""
    if case.finished_names is None:
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
    return names >= case.finished_names


def partial_files(folder: Path) -> list[Path]:
    return [path for path in folder.rglob("*") if path.name.endswith(".part")]


@pytest.mark.slow
@pytest.mark.parametrize(("name", "by"), [(name, by) for name, signals in SIGNALS_OF_COMMAND.items() for by in signals])
def test_a_command_that_is_stopped_leaves_nothing_that_looks_finished(
    cases: Mapping[str, Case], tmp_path: Path, name: str, by: signal.Signals
) -> None:
    case, rng = cases[name], np.random.default_rng([len(name), by])
    for number in range(STOPS_PER_COMMAND):
        output = tmp_path / f"out{number}" if case.finished_names else tmp_path / f"out{number}.h5"
        start_s = time.monotonic()

        def stop(pid: int, number: int = number, start_s: float = start_s) -> None:
            """The first stop is during writing, the others are at random times."""
            end = start_s + (case.stop_time_s * rng.random() if number else case.stop_time_s)
            while time.monotonic() < end and (number or not partial_files(tmp_path)):
                time.sleep(0.002)
            time.sleep(0.01 * rng.random())
            os.kill(pid, by)

        arguments = [*case.arguments, "-o", str(output)]
        outcome = run_in_child(lambda arguments=arguments: main(arguments), tmp_path / "log", stop, seconds=90)
        lines = [line for line in outcome.stderr.replace("\r", "\n").splitlines() if line.startswith("lissajous")]
        assert "Traceback" not in outcome.stderr, outcome
        assert looks_finished(output, case) == (outcome.code == 0), (number, outcome)
        if by != signal.SIGKILL and (outcome.code, outcome.stderr) != (-by, ""):  # stopped before the command began
            assert not partial_files(tmp_path), outcome
            assert outcome.code in (0, 1), outcome
            assert len(lines) == outcome.code, outcome
            assert not lines or "interrupted" in lines[0]
        for path in partial_files(tmp_path):
            path.rename(path.with_suffix(".old"))


@pytest.mark.parametrize(("name", "max_bytes"), FULL_DISK_CASES)
def test_a_full_disk_leaves_nothing(cases: Mapping[str, Case], tmp_path: Path, name: str, max_bytes: int) -> None:
    case, output = cases[name], tmp_path / "out"

    def run_with_size_limit() -> int:
        signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
        resource.setrlimit(resource.RLIMIT_FSIZE, (max_bytes, max_bytes))
        return main([*case.arguments, "-o", str(output)])

    outcome = run_in_child(run_with_size_limit, tmp_path / "log", seconds=90)
    lines = [line for line in outcome.stderr.replace("\r", "\n").splitlines() if line.startswith("lissajous")]
    assert (outcome.code, len(lines)) == (1, 1), outcome
    assert "Traceback" not in outcome.stderr
    assert lines[0].startswith(f"lissajous {case.arguments[0]}: {output}")
    assert lines[0].endswith((": File too large", " written"))
    assert not looks_finished(output, case)
    assert not partial_files(tmp_path)


@pytest.mark.parametrize("by", [signal.SIGINT, signal.SIGTERM])
def test_a_stop_after_the_work_is_no_interruption(
    by: signal.Signals, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def stop_then_print(summary: object) -> str:
        signal.raise_signal(by)
        return "done"

    monkeypatch.setattr("recon.cli.new_device.format_summary", stop_then_print)
    output = tmp_path / "device.toml"
    assert main(["new-device", "-o", str(output)]) == 0
    assert output.exists()
    assert capsys.readouterr() == ("done\n", "")


# --- an interrupt that compiled code suppresses ---------------------------------------------------------------------


def test_a_suppressed_interrupt_is_repeated(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("recon.runtime.interrupts.REPEAT_INTERVAL_S", 0.05)
    before = signal.getsignal(signal.SIGINT)
    with handle_interrupts() as stop:
        assert not stop.came
        with suppress(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)
        assert stop.came
        try:
            time.sleep(5.0)
        except KeyboardInterrupt:
            time.sleep(0.2)  # no further interrupt during cleaning up
        else:
            pytest.fail("the interrupt was not repeated")
    assert signal.getsignal(signal.SIGINT) == before
    assert signal.getitimer(signal.ITIMER_REAL) == (0.0, 0.0)


@pytest.mark.parametrize("replacement", [TypeError, SystemError, RuntimeError])
def test_an_interrupt_that_became_another_exception_is_reported_in_one_line(
    replacement: type[Exception], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def work(args: object) -> None:
        try:
            signal.raise_signal(signal.SIGTERM)
        except KeyboardInterrupt:
            raise replacement("'sig'") from None

    monkeypatch.setattr("recon.cli.info.run", work)
    assert main(["info", "a.h5"]) == 1
    assert capsys.readouterr().err == "lissajous info: interrupted; nothing was written\n"


def test_an_error_without_an_interrupt_is_raised(monkeypatch: pytest.MonkeyPatch) -> None:
    def work(args: object) -> None:
        raise TypeError("a fault of ours")

    monkeypatch.setattr("recon.cli.info.run", work)
    with pytest.raises(TypeError, match="of ours"):
        main(["info", "a.h5"])


@pytest.mark.parametrize("replaced", [replacing, replacing_folder])
def test_an_interrupt_waits_while_finished_output_takes_its_place(
    replaced: Callable[[Path], AbstractContextManager[Path]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The output is there then, so that the command has done its work."""
    place = Path.replace

    def interrupted(self: Path, target: Path) -> Path:
        os.kill(os.getpid(), signal.SIGINT)
        return place(self, target)

    with handle_interrupts() as stop:
        monkeypatch.setattr(Path, "replace", interrupted)
        with replaced(tmp_path / "out") as beside:
            done = beside / "done.txt" if beside.is_dir() else beside
            done.write_text("done")
        stop.ended = True
        monkeypatch.undo()
    (written,) = [path for path in tmp_path.rglob("*") if path.is_file()]
    assert written.read_text() == "done"
    assert not stop.came
    with pytest.raises(KeyboardInterrupt), handle_interrupts(), replaced(tmp_path / "other"):
        os.kill(os.getpid(), signal.SIGINT)
    assert not (tmp_path / "other").exists()


@pytest.mark.parametrize("work_goes_on", [False, True])
def test_an_interrupt_after_finished_output_took_its_place_waits_once(
    work_goes_on: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A command that only returns then is not interrupted, one with several outputs is."""
    monkeypatch.setattr("recon.runtime.interrupts.REPEAT_INTERVAL_S", 0.05)
    with handle_interrupts() as stop:
        with replacing(tmp_path / "out") as beside:
            beside.write_text("done")
        signal.raise_signal(signal.SIGINT)
        if work_goes_on:
            with pytest.raises(KeyboardInterrupt):
                time.sleep(5.0)
        stop.ended = True
    assert stop.came == work_goes_on


def test_an_interrupt_as_soon_as_the_temporary_folder_exists_leaves_none(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    make = os.mkdir

    def interrupted(*args: object, **options: object) -> None:
        make(*args, **options)  # type: ignore[arg-type]
        signal.raise_signal(signal.SIGINT)

    monkeypatch.setattr(os, "mkdir", interrupted)
    with pytest.raises(KeyboardInterrupt), handle_interrupts(), replacing_folder(tmp_path / "out"):
        pytest.fail("the interrupt did not come")
    monkeypatch.undo()
    assert not list(tmp_path.iterdir())
