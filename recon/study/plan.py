"""Plan of a blur study: its file (docs/reference/study.md), and the jobs and cells that follow from it."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import MISSING, asdict, dataclass, field, fields
from importlib.metadata import version
from itertools import product
from pathlib import Path
from typing import Any, TypeVar

from estimation.estimators import estimators
from estimation.estimators import registered as registered_estimators
from phantoms.targets import TARGETS, TISSUES
from recon.imaging.picture import Grid
from scanner import devices
from scanner.device_toml import FINITE, NOT_NEGATIVE, POSITIVE, WHOLE, check_values, checked_number
from scanner.errors import BadInput
from scanner.files import read_toml
from scanner.terms import registered as registered_terms

T = TypeVar("T")


@dataclass(frozen=True)
class Conditions:
    """Conditions that all recordings of a study share, as in ``phantoms.experiment.Experiment``.

    Attributes:
        duration: [s].
        sample_rate: [Hz].
        drift_tau: time constant of the drift [s].
        field_um: width of the field on the sample [um].
        spot_um: standard deviation of the beam's spot [um].
        photons: per sample at full brightness.
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
class StudyDesign:
    """A device and its drives.

    Attributes:
        name: of the design.
        device: as TOML text, so that a worker on another machine needs no file.
        drive_x, drive_y: frequency [Hz], amplitude [V], offset [V].
    """

    name: str
    device: str
    drive_x: tuple[float, float, float]
    drive_y: tuple[float, float, float]


@dataclass(frozen=True)
class Study:
    """A study: every phantom under every design, drift and sense noise, with every estimator at every resolution.

    Attributes:
        name: of the study.
        designs, phantoms, estimators: by name, or files of phantoms.
        drifts: final relative changes of both stiffnesses.
        snr_db: rms of the sense signal over rms of its noise [dB]; empty uses the noise of the device.
        pixels: of the picture along both sides.
        p: tolerated displacements [px].
        seeds: number of recordings of each scenario, with the seeds 0, 1, ...
        recording: conditions of all recordings.
    """

    name: str
    designs: tuple[StudyDesign, ...]
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
            if name not in estimators():
                known = ", ".join(estimators())
                raise BadInput(f"no estimator is named {name!r}", channel="estimators", hint=f"there are {known}")
        for name in self.phantoms:
            if name not in TARGETS and name not in TISSUES and not Path(name).is_file():
                known = ", ".join((*TARGETS, *TISSUES))
                hint = f"give a file or one of {known}"
                raise BadInput(f"no target and no file is called {name!r}", channel="phantoms", hint=hint)
        for side in self.pixels:
            Grid(side, side, 1.0, 1.0)
        names = [design.name for design in self.designs]
        if len(set(names)) < len(names):
            raise BadInput("two have one name", channel="designs", hint="give each its own")


@dataclass(frozen=True)
class Scenario:
    """Parameters of one simulated recording."""

    phantom: str
    design: StudyDesign
    drift: float
    snr_db: float | None
    seed: int
    recording: Conditions


@dataclass(frozen=True)
class Job:
    """A scenario and the reconstructions of it that are still to be done.

    Attributes:
        scenario: the recording.
        variants: estimator and pixels of each reconstruction.
        p: tolerated displacements [px]; each gives a separate cell.
        digest: hash of the contents of everything that a cell refers to by name.
    """

    scenario: Scenario
    variants: tuple[tuple[str, int], ...]
    p: tuple[float, ...]
    digest: str

    def cell(self, variant: tuple[str, int], p: float) -> dict[str, Any]:
        """Return the parameters of one cell, as the journal stores them."""
        scenario = self.scenario
        return {
            "phantom": scenario.phantom,
            "design": scenario.design.name,
            "drift": scenario.drift,
            "snr_db": scenario.snr_db,
            "estimator": variant[0],
            "pixels": variant[1],
            "p": p,
            "seed": scenario.seed,
            "of": self.digest,
        }

    def cells(self) -> Iterator[dict[str, Any]]:
        """Yield all cells of the job."""
        return (self.cell(variant, p) for variant, p in product(self.variants, self.p))


def cell_key(cell: Mapping[str, Any]) -> str:
    """Return a text that is equal for equal cells."""
    return json.dumps(cell, sort_keys=True)


def plan_jobs(study: Study) -> Iterator[Job]:
    """Yield all jobs, seed by seed, so that a study that is stopped early covers every scenario."""
    digests = {
        (phantom, design.name): _digest(phantom, design, study.recording)
        for phantom, design in product(study.phantoms, study.designs)
    }
    variants = tuple(product(study.estimators, study.pixels))
    scenarios = product(range(study.seeds), study.phantoms, study.designs, study.drifts, study.snr_db or (None,))
    for seed, phantom, design, drift, snr in scenarios:
        scenario = Scenario(phantom, design, drift, snr, seed, study.recording)
        yield Job(scenario, variants, study.p, digests[phantom, design.name])


def remaining_jobs(all_jobs: Iterable[Job], done: Mapping[str, Any]) -> list[Job]:
    """Return the jobs without the variants whose cells are all in ``done``, a mapping by ``cell_key``."""
    left = []
    for job in all_jobs:
        variants = tuple(
            variant for variant in job.variants if any(cell_key(job.cell(variant, p)) not in done for p in job.p)
        )
        if variants:
            left.append(Job(job.scenario, variants, job.p, job.digest))
    return left


def read_study(path: Path) -> Study:
    """Read a study from a TOML file.

    Raises:
        BadInput: the file cannot be read, or a key is missing, unknown or has an invalid value.
    """
    table = read_toml(path)
    try:
        conditions = _build(Conditions, table.pop("recording", {}), "recording")
        listed = table.pop("designs", [])
        if not isinstance(listed, list):
            raise BadInput("must be a list of tables", channel="designs", hint="write [[designs]]")
        designs = tuple(_read_design(each, path.parent) for each in listed)
        return _build(Study, _check_texts(table) | {"recording": conditions, "designs": designs}, "")
    except BadInput as error:
        where = f"{path}: {error.file}" if error.file else path
        raise BadInput(error.what, file=where, channel=error.channel, hint=error.hint) from None


def _build(cls: type[T], table: object, where: str) -> T:
    """An instance of a dataclass from a table; ``where`` is the table's dotted key for messages."""
    known = [attribute.name for attribute in fields(cls)]  # type: ignore[arg-type]
    needed = [a.name for a in fields(cls) if a.default is MISSING and a.default_factory is MISSING]  # type: ignore[arg-type]
    if not isinstance(table, Mapping):
        raise BadInput("must be a table", channel=where, hint=f"write [{where}]")
    for name in table:
        if name not in known:
            raise BadInput(
                "is no key of a study", channel=_dotted_key(where, name), hint=f"there are {', '.join(known)}"
            )
    for name in needed:
        if name not in table:
            raise BadInput("is missing", channel=_dotted_key(where, name), hint=f"needed are {', '.join(needed)}")
    try:
        return cls(**table)
    except BadInput as error:
        channel = _dotted_key(where, error.channel or "") or None
        raise BadInput(error.what, file=error.file, channel=channel, hint=error.hint) from None


def _dotted_key(where: str, name: str) -> str:
    return ".".join(part for part in (where, name) if part)


def _check_texts(table: Mapping[str, Any]) -> dict[str, Any]:
    """The table, after a check of its names and lists of names."""
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


def _read_design(table: object, folder: Path) -> StudyDesign:
    """A design. Its device is a name or a file, relative to the folder of the study."""
    design = _build(StudyDesign, table, "designs")
    for name in ("name", "device"):
        if not isinstance(getattr(design, name), str):
            raise BadInput(f"is {getattr(design, name)!r} and must be text", channel=f"designs.{name}")
    beside = folder / design.device
    device = devices.find(beside if beside.is_file() else design.device)
    device.require_scan()
    for name in ("x", "y"):
        device.axis(name)
    return StudyDesign(
        design.name, device.to_toml(), _read_drive(design.drive_x, "drive_x"), _read_drive(design.drive_y, "drive_y")
    )


def _read_drive(value: object, name: str) -> tuple[float, float, float]:
    channel = f"designs.{name}"
    if not isinstance(value, list) or len(value) != 3:
        hint = "give frequency, amplitude, offset, as [27680.0, 30.0, 30.0]"
        raise BadInput(f"is {value!r}", channel=channel, hint=hint)
    frequency, amplitude, offset = (
        float(checked_number(number, must["must"], channel))
        for number, must in zip(value, (POSITIVE, FINITE, FINITE), strict=True)
    )
    return frequency, amplitude, offset


def _digest(phantom: str, design: StudyDesign, recording: Conditions) -> str:
    """Digest of what determines a result besides the numbers of the cell: device, picture, terms, version."""
    picture = Path(phantom)
    bytes_of = hashlib.sha256(picture.read_bytes()).hexdigest() if picture.is_file() else phantom
    user_files = [path.read_text(encoding="utf-8") for path in (*registered_terms(), *registered_estimators())]
    text = json.dumps([version("lissajous"), bytes_of, asdict(design), asdict(recording), *user_files], sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:16]
