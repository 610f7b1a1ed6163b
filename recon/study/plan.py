"""What a blur study varies: its file, and the cells that follow from it. docs/studies.md describes the file."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import MISSING, asdict, dataclass, field, fields
from importlib.metadata import version
from itertools import product
from pathlib import Path
from typing import Any, TypeVar

from estimation.estimate import ESTIMATORS
from phantoms.experiment import device_named
from phantoms.targets import TARGETS, TISSUES
from scanner.device import Device
from scanner.device_toml import FINITE, NOT_NEGATIVE, POSITIVE, WHOLE, check_values, checked_number
from scanner.errors import BadInput
from scanner.files import read_toml
from scanner.terms import registered

T = TypeVar("T")


@dataclass(frozen=True)
class Conditions:
    """What all recordings of a study share; the attributes are those of ``phantoms.experiment.Experiment``.

    Attributes:
        photons: a sample at full brightness.
    """

    duration: float = field(default=0.02, metadata=POSITIVE)
    sample_rate: float = field(default=2e6, metadata=POSITIVE)
    drift_tau: float = field(default=0.025, metadata=POSITIVE)
    field_um: float = field(default=250.0, metadata=POSITIVE)
    spot_um: float = field(default=0.4, metadata=NOT_NEGATIVE)
    photons: float = field(default=1000.0, metadata=POSITIVE)

    def __post_init__(self) -> None:
        check_values(self)


@dataclass(frozen=True)
class Design:
    """A way to scan.

    Attributes:
        device: as TOML text, so that a worker elsewhere needs no file.
        drive_x, drive_y: frequency [Hz], amplitude [V], offset [V].
    """

    name: str
    device: str
    drive_x: tuple[float, float, float]
    drive_y: tuple[float, float, float]


@dataclass(frozen=True)
class Study:
    """A study: every phantom under every design, drift and sense noise, seen by every estimator at every resolution.

    Attributes:
        drifts: relative changes of both stiffnesses in the end.
        snr_db: sense signal over its noise, rms to rms [dB]; empty keeps the device's own noise.
        pixels: of the picture, along both sides.
        p: pixels of shift tolerated.
        seeds: recordings of each world, with the seeds 0, 1, ...
    """

    name: str
    designs: tuple[Design, ...]
    phantoms: tuple[str, ...]
    estimators: tuple[str, ...]
    drifts: tuple[float, ...] = field(default=(-0.002,), metadata=FINITE)
    snr_db: tuple[float, ...] = field(default=(), metadata=FINITE)
    pixels: tuple[int, ...] = field(default=(400,), metadata=WHOLE)
    p: tuple[float, ...] = field(default=(1.0,), metadata=POSITIVE)
    seeds: int = field(default=1, metadata=WHOLE)
    recording: Conditions = field(default_factory=Conditions)

    def __post_init__(self) -> None:
        check_values(self)
        for name in ("designs", "phantoms", "estimators", "drifts", "pixels", "p"):
            if not getattr(self, name):
                raise BadInput("is empty", channel=name, hint="list at least one")
        for name in self.estimators:
            if name not in ESTIMATORS:
                known = ", ".join(ESTIMATORS)
                raise BadInput(f"no estimator is named {name!r}", channel="estimators", hint=f"there are {known}")
        for name in self.phantoms:
            if name not in TARGETS and name not in TISSUES and not Path(name).is_file():
                known = ", ".join((*TARGETS, *TISSUES))
                hint = f"give a file or one of {known}"
                raise BadInput(f"no target and no file is called {name!r}", channel="phantoms", hint=hint)
        names = [design.name for design in self.designs]
        if len(set(names)) < len(names):
            raise BadInput("two have one name", channel="designs", hint="give each its own")


@dataclass(frozen=True)
class World:
    """One simulated recording."""

    phantom: str
    design: Design
    drift: float
    snr_db: float | None
    seed: int
    recording: Conditions


@dataclass(frozen=True)
class Job:
    """A recording and the ways to reconstruct it that are still to be done.

    Attributes:
        ways: estimator and pixels.
        p: pixels tolerated, each a cell.
        of: digest of what the names in a cell stand for.
    """

    world: World
    ways: tuple[tuple[str, int], ...]
    p: tuple[float, ...]
    of: str

    def cell(self, way: tuple[str, int], p: float) -> dict[str, Any]:
        """What stands for one cell in the journal."""
        world = self.world
        return {
            "phantom": world.phantom,
            "design": world.design.name,
            "drift": world.drift,
            "snr_db": world.snr_db,
            "estimator": way[0],
            "pixels": way[1],
            "p": p,
            "seed": world.seed,
            "of": self.of,
        }

    def cells(self) -> Iterator[dict[str, Any]]:
        """All cells of the job."""
        return (self.cell(way, p) for way, p in product(self.ways, self.p))


def key(cell: Mapping[str, Any]) -> str:
    """A cell as text that is equal for equal cells."""
    return json.dumps(cell, sort_keys=True)


def jobs(study: Study) -> Iterator[Job]:
    """All jobs, seed by seed, so that a study that is stopped early has seen every world."""
    digests = {
        (phantom, design.name): _digest(phantom, design, study.recording)
        for phantom, design in product(study.phantoms, study.designs)
    }
    ways = tuple(product(study.estimators, study.pixels))
    worlds = product(range(study.seeds), study.phantoms, study.designs, study.drifts, study.snr_db or (None,))
    for seed, phantom, design, drift, snr in worlds:
        world = World(phantom, design, drift, snr, seed, study.recording)
        yield Job(world, ways, study.p, digests[phantom, design.name])


def remaining(all_jobs: Iterable[Job], done: Mapping[str, Any]) -> list[Job]:
    """The jobs without the ways all of whose cells are in ``done``, by ``key``."""
    left = []
    for job in all_jobs:
        ways = tuple(way for way in job.ways if any(key(job.cell(way, p)) not in done for p in job.p))
        if ways:
            left.append(Job(job.world, ways, job.p, job.of))
    return left


def read_study(path: Path) -> Study:
    """The study in a TOML file.

    Raises:
        BadInput: the file cannot be read, or a key is missing, unknown or holds what it cannot.
    """
    table = read_toml(path)
    try:
        conditions = _made(Conditions, table.pop("recording", {}), "recording")
        listed = table.pop("designs", [])
        if not isinstance(listed, list):
            raise BadInput("must be a list of tables", channel="designs", hint="write [[designs]]")
        designs = tuple(_design(each, path.parent) for each in listed)
        return _made(Study, _texts(table) | {"recording": conditions, "designs": designs}, "")
    except BadInput as error:
        where = f"{path}: {error.file}" if error.file else path
        raise BadInput(error.what, file=where, channel=error.channel, hint=error.hint) from None


def _made(cls: type[T], table: object, where: str) -> T:
    known = [each.name for each in fields(cls)]  # type: ignore[arg-type]
    needed = [each.name for each in fields(cls) if each.default is MISSING and each.default_factory is MISSING]  # type: ignore[arg-type]
    if not isinstance(table, Mapping):
        raise BadInput("must be a table", channel=where, hint=f"write [{where}]")
    for name in table:
        if name not in known:
            raise BadInput("is no key of a study", channel=_key(where, name), hint=f"there are {', '.join(known)}")
    for name in needed:
        if name not in table:
            raise BadInput("is missing", channel=_key(where, name), hint=f"needed are {', '.join(needed)}")
    try:
        return cls(**table)
    except BadInput as error:
        channel = _key(where, error.channel or "") or None
        raise BadInput(error.what, file=error.file, channel=channel, hint=error.hint) from None


def _key(where: str, name: str) -> str:
    return ".".join(part for part in (where, name) if part)


def _texts(table: Mapping[str, Any]) -> dict[str, Any]:
    """The table with its lists of names checked."""
    out = dict(table)
    for name in ("phantoms", "estimators"):
        value = out.get(name, [])
        if not (isinstance(value, list) and all(isinstance(each, str) for each in value)):
            raise BadInput(f"is {value!r} and must be a list of names", channel=name)
        if name in out:
            out[name] = tuple(value)
    if not isinstance(out.get("name", ""), str):
        raise BadInput(f"is {out['name']!r} and must be text", channel="name")
    return out


def _design(table: object, folder: Path) -> Design:
    """A design; its device is a named one or a file, relative to the study's own."""
    made = _made(Design, table, "designs")
    for name in ("name", "device"):
        if not isinstance(getattr(made, name), str):
            raise BadInput(f"is {getattr(made, name)!r} and must be text", channel=f"designs.{name}")
    beside = folder / made.device
    device = Device.load(beside) if beside.is_file() else device_named(made.device)
    device.require_scan()
    for name in ("x", "y"):
        device.axis(name)
    return Design(made.name, device.to_toml(), _drive(made.drive_x, "drive_x"), _drive(made.drive_y, "drive_y"))


def _drive(value: object, name: str) -> tuple[float, float, float]:
    channel = f"designs.{name}"
    if not isinstance(value, list) or len(value) != 3:
        hint = "give frequency, amplitude, offset, as [27680.0, 30.0, 30.0]"
        raise BadInput(f"is {value!r}", channel=channel, hint=hint)
    frequency, amplitude, offset = (
        float(checked_number(number, must["must"], channel))
        for number, must in zip(value, (POSITIVE, FINITE, FINITE), strict=True)
    )
    return frequency, amplitude, offset


def _digest(phantom: str, design: Design, recording: Conditions) -> str:
    """Of all that decides a result besides the cell's own numbers: another device, picture, term file or version."""
    picture = Path(phantom)
    bytes_of = hashlib.sha256(picture.read_bytes()).hexdigest() if picture.is_file() else phantom
    own_terms = [path.read_text(encoding="utf-8") for path in registered()]
    told = json.dumps([version("lissajous"), bytes_of, asdict(design), asdict(recording), *own_terms], sort_keys=True)
    return hashlib.sha256(told.encode()).hexdigest()[:16]
