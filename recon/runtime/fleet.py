"""The same work on many recordings: a folder each, continued after an interruption, on this machine or a cluster."""

from __future__ import annotations

import errno
import hashlib
import json
import os
import shutil
import sys
import time
from collections.abc import Callable, Collection, Mapping, Sequence
from concurrent.futures import BrokenExecutor, CancelledError, Executor, Future, as_completed
from dataclasses import dataclass
from glob import escape
from pathlib import Path
from typing import Any

from estimation import estimators
from recon.io.output import check_folder, write_json
from recon.io.readers import register, registered
from recon.runtime.executors import open_executor, picklable_task
from scanner import devices, terms
from scanner.device import Device
from scanner.errors import BadInput, line_of
from scanner.files import read_toml, replacing

JOB_FILE = "job.json"
"""File of the output folder that states which recordings and options its folders were made with."""

SHARED_ROUNDS = 2
"""Rounds in which all recordings share the workers. What a killed worker then still left undone gets a worker alone, so
that a recording that kills its worker (by its size) stops no other."""

Work = Callable[[Path, Path], object]
"""Work on one recording: its path, and the folder to write into."""


@dataclass(frozen=True)
class Fleet:
    """Recordings, their folders, and what is already done.

    Attributes:
        folders: by recording.
        done: recordings whose folders an earlier run has completed.
        made: the output folder, if there was none before; None else.
    """

    folders: Mapping[Path, Path]
    done: frozenset[Path]
    made: Path | None = None


@dataclass(frozen=True)
class Failure:
    """Why a recording failed, and the exit code that belongs to it."""

    reason: str
    exit: int


def find_recordings(places: Sequence[Path]) -> list[Path]:
    """Return the files, and the recordings (``*.h5``) in the folders, in the order of their names.

    Hidden files in folders are left out: some systems write one, as ``._scan.h5``, beside each file that is copied. A
    file that is named twice is returned once.

    Raises:
        BadInput: a folder holds no recording, or nothing of all that is there.
    """
    found: list[Path] = []
    for place in places:
        visible = (path for path in place.glob("*.h5") if not path.name.startswith("."))
        inside = sorted(visible) if place.is_dir() else [place]
        if not inside:
            raise BadInput("holds no recording (*.h5)", file=place, hint="name the folder of the recordings")
        found += inside
    if not any(path.exists() for path in found):
        raise BadInput("no such file or folder", file=places[0], hint="name recordings (HDF5), or their folder")
    unique: dict[Path, Path] = {}
    for path in found:
        unique.setdefault(path.absolute(), path)
    return list(unique.values())


def state_inputs(device: Device | str | Path | None, mapping: Path | None) -> str:
    """Return a text that states the contents of device, mapping and registered files, for :func:`plan_fleet`.

    A path alone would not: results of a file that was edited since would be taken as results of the file as it is.

    Args:
        device: in place of that of the recordings; None for none.
        mapping: of all recordings; None for none.

    Raises:
        BadInput: there is no such device, or a file cannot be read.
    """
    content = {
        "device": None if device is None else devices.find(device).to_toml(),
        "mapping": None if mapping is None else read_toml(mapping),
        "registered": {str(path): path.read_text(encoding="utf-8") for path in registered_files()} or None,
    }
    return " ".join(f"{name}={_digest(each)}" for name, each in content.items())


def registered_files() -> tuple[Path, ...]:
    """Return the users' files of terms, estimators and readers that are registered."""
    return (*terms.registered(), *estimators.registered(), *registered())


def _digest(content: object) -> str | None:
    """SHA-256 of the text of a value, which does not depend on the order of keys; None for None."""
    if content is None:
        return None
    return hashlib.sha256(json.dumps(content, sort_keys=True, default=str).encode()).hexdigest()


def plan_fleet(
    paths: Sequence[Path], output: Path, options: str, result: str, overwrite: bool, keys: Collection[str] = ()
) -> Fleet:
    """Assign a folder to each recording, and find those that an earlier run has completed.

    Args:
        paths: the recordings.
        output: folder of the folders; it is made.
        options: of the work, as text. Folders that were made with others are neither used nor replaced.
        result: JSON file that a completed folder holds.
        overwrite: do everything anew. The ``result`` of each recording is deleted, and no other file, before the new
            options are written: after a kill, what is left of the old results is not taken as done.
        keys: that ``result`` states. A damaged one, as of a disk that was full, is done anew.

    Raises:
        BadInput: ``output`` cannot be written, or holds results of other options or of a recording that has changed.
    """
    check_folder(output)
    made = None if output.exists() else output
    output.mkdir(exist_ok=True)
    before = {} if overwrite else _read_job(output)
    hint = "add --overwrite, or name another folder with -o"
    if before and before.get("options") != options:
        raise BadInput("holds results that were made with other options", file=output, hint=hint)
    known: dict[str, Any] = dict(before.get("recordings", {}))
    folders: dict[Path, Path] = {}
    done = set()
    for path in paths:
        key, stamp = str(path.absolute()), _stamp(path)
        if key in known and known[key]["file"] != stamp and (output / known[key]["folder"] / result).is_file():
            what = f"has changed since its results were written into {known[key]['folder']}"
            raise BadInput(what, file=path, hint=hint)
        if key not in known:
            name = _free_name(path.stem, {entry["folder"] for entry in known.values()})
            if not overwrite and (output / name / result).is_file():
                raise BadInput("holds results of another run", file=output / name, hint=hint)
            known[key] = {"folder": name}
        known[key]["file"] = stamp
        folders[path] = output.absolute() / known[key]["folder"]
        if not overwrite and _is_whole(folders[path] / result, keys):
            done.add(path)
    if overwrite:
        for folder in folders.values():
            (folder / result).unlink(missing_ok=True)
    with replacing(output / JOB_FILE) as beside:
        write_json(beside, {"options": options, "recordings": known})
    return Fleet(folders, frozenset(done), made)


def run_fleet(
    fleet: Fleet, work: Work, title: str, scheduler: str | None = None, workers: int | None = None
) -> dict[Path, Failure]:
    """Process every recording that has no result yet; return the failures.

    If a worker is killed, the recordings that it did not complete are submitted again.

    Args:
        fleet: recordings and folders.
        work: function that processes one recording; picklable.
        title: of the progress bar.
        scheduler, workers: see :func:`recon.runtime.executors.open_executor`; a cluster needs the same paths.

    Raises:
        BadInput: no scheduler answers.
        InterruptedError: by the user. Completed folders remain, and the same call continues.
    """
    from tqdm import tqdm

    began = time.time()
    failures: dict[Path, Failure] = {}
    left = [path for path in fleet.folders if path not in fleet.done]
    with tqdm(total=len(fleet.folders), initial=len(fleet.done), desc=title, unit="recording", file=sys.stderr) as bar:
        try:
            for _ in range(SHARED_ROUNDS):
                if left:
                    left = _run_round(left, fleet, work, scheduler, workers, failures, bar)
            for path in left:
                if _run_round([path], fleet, work, scheduler, 1, failures, bar):
                    failures[path] = Failure(f"{path}: its worker was killed (out of memory?)", 1)
        except BadInput:
            if fleet.made is not None and list(fleet.made.iterdir()) == [fleet.made / JOB_FILE]:  # no scheduler answers
                (fleet.made / JOB_FILE).unlink()
                fleet.made.rmdir()
            raise
        except KeyboardInterrupt:
            reason = f"interrupted; {bar.n} of {len(fleet.folders)} recordings are done, the same command continues"
            raise InterruptedError(errno.EINTR, reason, str(next(iter(fleet.folders.values())).parent)) from None
    _remove_unfinished(fleet, began)
    return failures


def _remove_unfinished(fleet: Fleet, began: float) -> None:
    """Delete what an earlier run that was killed has left: temporary folders not touched since ``began`` [s]."""
    for folder in fleet.folders.values():
        for path in folder.parent.glob(f".{escape(folder.name)}.*.part"):
            if path.is_dir() and path.stat().st_mtime < began:
                shutil.rmtree(path, ignore_errors=True)


def _run_round(
    paths: Sequence[Path],
    fleet: Fleet,
    work: Work,
    scheduler: str | None,
    workers: int | None,
    failures: dict[Path, Failure],
    bar: Any,
) -> list[Path]:
    """Submit the work on each recording; return those whose worker was killed, in their order."""
    lost = []
    with open_executor(scheduler, workers) as executor:
        jobs = {}
        for path in paths:
            task = picklable_task(_attempt, registered(), work, path.absolute(), fleet.folders[path])
            jobs[_submit(executor, task)] = path
        for job in as_completed(jobs):
            try:
                failure = job.result()
            except (BrokenExecutor, CancelledError):
                lost.append(jobs[job])
                continue
            except Exception as error:  # Dask's KilledWorker is no BrokenExecutor; its module is optional
                if type(error).__name__ != "KilledWorker":
                    raise
                lost.append(jobs[job])
                continue
            bar.update()
            if failure is not None:
                failures[jobs[job]] = failure
    return [path for path in paths if path in lost]


def _attempt(reader_files: Sequence[Path], work: Work, path: Path, folder: Path) -> Failure | None:
    """Do the work in a worker; an error becomes a failure with its reason, so that it stops no other recording."""
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    for file in reader_files:
        register(file)
    try:
        work(path, folder)
    except BadInput as error:
        error.file = error.file or path
        return Failure(str(error), 2)
    except MemoryError:
        return Failure(f"{path}: needs more memory than there is; cut it into shorter ones", 2)
    except OSError as error:  # such as a full disk
        return Failure(line_of(error, folder), 1)
    except Exception as error:
        reason = " ".join(f"{type(error).__name__}: {error}".split())
        return Failure(f"{path}: ended with {reason}; the same command with this recording alone shows where", 1)
    return None


def _submit(executor: Executor, task: Callable[[], Failure | None]) -> Future[Failure | None]:
    """Submit a task; return a failed future if a worker was killed before all were submitted."""
    try:
        return executor.submit(task)
    except BrokenExecutor as error:
        broken: Future[Failure | None] = Future()
        broken.set_exception(error)
        return broken


def _is_whole(result: Path, keys: Collection[str]) -> bool:
    """Whether a file is a JSON object that states the keys."""
    try:
        content = json.loads(result.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return False
    return isinstance(content, dict) and content.keys() >= set(keys)


def _read_job(output: Path) -> dict[str, Any]:
    """Content of an earlier run's ``JOB_FILE``; empty without one."""
    hint = "delete it, or name another folder with -o"
    try:
        content = json.loads((output / JOB_FILE).read_text(encoding="utf-8"))
    except FileNotFoundError:
        return {}
    except (OSError, ValueError) as error:
        raise BadInput(f"cannot be read: {error}", file=output / JOB_FILE, hint=hint) from None
    if not _is_job(content):
        raise BadInput("does not state the options and the folders of a run", file=output / JOB_FILE, hint=hint)
    return dict(content)


def _is_job(content: object) -> bool:
    """Whether a value has the form that :func:`plan_fleet` writes: each recording has a stamp and a folder's name."""
    if not isinstance(content, dict) or not isinstance(content.get("options"), str):
        return False
    recordings = content.get("recordings")
    return isinstance(recordings, dict) and all(
        isinstance(entry, dict) and "file" in entry and _is_folder_name(entry.get("folder"))
        for entry in recordings.values()
    )


def _is_folder_name(name: object) -> bool:
    """Whether a value names a folder directly below another one, as ``scan`` and not ``..``."""
    return isinstance(name, str) and os.path.dirname(os.path.normpath(os.path.join("output", name))) == "output"


def _stamp(path: Path) -> list[int] | None:
    """Size and time of change of a file [bytes, ns]; None where it cannot be read, which the work reports."""
    try:
        status = path.stat()
    except OSError:
        return None
    return [status.st_size, status.st_mtime_ns]


def _free_name(stem: str, taken: set[str]) -> str:
    """The stem, with a number appended if it is taken."""
    name, number = stem, 2
    while name in taken:
        name, number = f"{stem}-{number}", number + 1
    return name
