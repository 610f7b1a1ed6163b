"""The nominal device: the values of every stage from design or calibration, as text (TOML) and as dataclasses.

A device file holds one table for each axis, in SI units and mechanical angles. The fields of the dataclasses are the
keys of the tables. Unknown keys are kept in ``extra`` and written back, so that an older program does not lose them.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any

import tomli_w

from scanner import device_toml
from scanner.arguments import check_type
from scanner.device_toml import NOT_NEGATIVE
from scanner.errors import DeviceInvalid
from scanner.files import parse_toml, read_toml
from scanner.geometry import Geometry
from scanner.stages import READOUTS, Capacitance, Drive, Mechanics, Readout, Scan

AXES = ("x", "y")
DEFAULT_TOLERANCE = 0.02
"""Relative standard uncertainty of a nominal value for which the device states none: typical of a data sheet."""

VALUES = frozenset(item.name for stage in (Mechanics, Capacitance, Drive, *READOUTS.values()) for item in fields(stage))
"""Names of the values that may have a tolerance."""

TERMS_WITH_LISTS = ("measured-law", "driven-modes")
"""Terms whose tables also hold text and lists; all others hold numbers."""


@dataclass(frozen=True)
class Axis:
    """One axis, stage by stage. A stage that the file does not state is None.

    Attributes:
        tolerance: stated relative standard uncertainties, by the name of the value.
        terms: physics beyond the nominal laws, effect -> parameter -> value [SI]. Those of ``TERMS_WITH_LISTS``
            have text and lists, see ``scanner.terms.measured_law`` and ``scanner.terms.driven_modes``.
        extra: unknown keys, nested as in the file.
        name: ``"x"`` or ``"y"``, for messages.
        source: where the axis came from, for messages.
    """

    mechanics: Mechanics | None = None
    capacitance: Capacitance | None = None
    drive: Drive | None = None
    readout: Readout | None = None
    tolerance: Mapping[str, float] = field(default_factory=dict)
    terms: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    extra: Mapping[str, Any] = field(default_factory=dict)
    name: str = field(default="", compare=False)
    source: str | None = field(default=None, compare=False)

    def __post_init__(self) -> None:
        drive = self.drive
        if drive and drive.kind == "linear" and drive.torque_per_volt is None and self.mechanics:
            key = ".".join(part for part in (self.name, "drive.torque_per_volt") if part)
            hint = "a linear drive of an axis with mechanics needs it [N m / V]"
            raise DeviceInvalid("is missing", file=self.source, channel=key, hint=hint)

    @property
    def resonance(self) -> float:
        """Undamped resonance of the nominal mechanics [Hz]; raises as :meth:`require_mechanics`."""
        return self.require_mechanics().resonance

    @property
    def quality(self) -> float:
        """Quality factor of the nominal mechanics; raises as :meth:`require_mechanics`."""
        return self.require_mechanics().quality

    def require_mechanics(self) -> Mechanics:
        """Return the mechanics; DeviceInvalid where the device states none."""
        if self.mechanics is None:
            raise self._missing("mechanics", "J, b and k")
        return self.mechanics

    def require_capacitance(self) -> Capacitance:
        """Return the capacitance; DeviceInvalid where the device states none."""
        if self.capacitance is None:
            raise self._missing("capacitance", "C0, Cb and theta0")
        return self.capacitance

    def require_drive(self) -> Drive:
        """Return the drive; DeviceInvalid where the device states none."""
        if self.drive is None:
            raise self._missing("drive", "kind")
        return self.drive

    def require_readout(self) -> Readout:
        """Return the readout of the axis; DeviceInvalid where the device states none."""
        if self.readout is None:
            raise self._missing("readout", "kind and its values")
        return self.readout

    def _missing(self, stage: str, content: str) -> DeviceInvalid:
        key = ".".join(part for part in (self.name, stage) if part)
        hint = f"add [{key}] with {content} to the device"
        return DeviceInvalid("is missing and needed here", file=self.source, channel=key, hint=hint)


@dataclass(frozen=True)
class Device:
    """The nominal scanner.

    Attributes:
        name: of the device.
        axes: ``"x"``, ``"y"`` or both.
        readout: the one readout that senses ``C_x + C_y`` where all combs share an electrode, else None.
        scan: field of view, None where the file states none.
        geometry: path of the beam over the mirror, for point clouds; None where the file states none.
        shared_tolerance: stated relative uncertainties of the shared readout.
        extra: unknown keys, nested as in the file.
        source: where the device came from, for messages.
    """

    name: str
    axes: Mapping[str, Axis]
    readout: Readout | None = None
    scan: Scan | None = None
    geometry: Geometry | None = None
    shared_tolerance: Mapping[str, float] = field(default_factory=dict)
    extra: Mapping[str, Any] = field(default_factory=dict)
    source: str | None = field(default=None, compare=False)

    def __repr__(self) -> str:
        return "\n".join([f"Device {self.name!r}", *(f"  {line}" for line in self._summary_lines())])

    def _summary_lines(self) -> list[str]:
        """One line each for axes, shared readout and field of view."""
        lines = []
        for name, axis in self.axes.items():
            parts = [f"{axis.resonance:.6g} Hz, Q {axis.quality:.4g}"] if axis.mechanics else []
            parts += [f"{axis.drive.kind} drive"] if axis.drive else []
            parts += [f"{axis.readout.kind} readout"] if axis.readout else []
            parts += [f"terms {', '.join(axis.terms)}"] if axis.terms else []
            lines.append(f"{name}: {'; '.join(parts) or 'nothing stated'}")
        lines += [f"shared {self.readout.kind} readout"] if self.readout else []
        lines += (
            [f"field ±{self.scan.half_angle_x:.4g} x ±{self.scan.half_angle_y:.4g} rad {self.scan.angle_kind}"]
            if self.scan
            else []
        )
        return lines

    @classmethod
    def load(cls, path: str | Path) -> Device:
        """Return the device in the TOML file at ``path``.

        Raises:
            BadInput: the file cannot be read, or is not TOML.
            DeviceInvalid: it lacks a needed key or holds a value that is not physical.
        """
        return cls.from_table(read_toml(path), source=str(path))

    @classmethod
    def from_toml(cls, text: str, source: str | None = None) -> Device:
        """Return the device that a TOML text describes.

        Raises:
            BadInput: the text is none, or is not TOML.
            DeviceInvalid: it lacks a needed key or holds a value that is not physical; the message names the key.
        """
        check_type(str, "give the text of a device file; Device.load reads a file", text=text)
        return cls.from_table(parse_toml(text, source), source)

    @classmethod
    def from_table(cls, table: Mapping[str, Any], source: str | None = None) -> Device:
        """Return the device in a table parsed from TOML. Raises as :meth:`from_toml`."""
        rest = device_toml.Table(dict(table), "", source)
        name = rest.take_text("name", default="unnamed")
        axes = {axis: _axis(axis, sub) for axis in AXES if (sub := rest.take_table(axis)) is not None}
        if not axes:
            raise DeviceInvalid("holds no axis", file=source, hint="a device needs a table [x], [y] or both")
        return cls(
            name=name,
            axes=axes,
            readout=_readout(rest),
            scan=rest.take_as(Scan, "scan"),
            geometry=rest.take_as(Geometry, "geometry"),
            shared_tolerance=_tolerance(rest),
            extra=rest.take_rest(),
            source=source,
        )

    def to_toml(self) -> str:
        """Return the device as TOML text, from which :meth:`from_toml` makes an equal device."""
        table: dict[str, Any] = {"name": self.name}
        for name, axis in self.axes.items():
            stages = {stage: getattr(axis, stage) for stage in ("mechanics", "capacitance", "drive", "readout")}
            body = {stage: device_toml.to_table(value) for stage, value in stages.items() if value is not None}
            body |= {"tolerance": dict(axis.tolerance)} if axis.tolerance else {}
            body |= {"terms": {effect: dict(values) for effect, values in axis.terms.items()}} if axis.terms else {}
            table[name] = device_toml.merged(body, axis.extra)
        for key, value in (("readout", self.readout), ("scan", self.scan), ("geometry", self.geometry)):
            if value is not None:
                table[key] = device_toml.to_table(value)
        if self.shared_tolerance:
            table["tolerance"] = dict(self.shared_tolerance)
        return tomli_w.dumps(device_toml.merged(table, self.extra))

    def axis(self, name: str) -> Axis:
        """Return one axis; DeviceInvalid where the device has none of that name."""
        if name not in self.axes:
            hint = f"add the table [{name}]; the device holds {', '.join(self.axes)}"
            raise DeviceInvalid("is missing and needed here", file=self.source, channel=name, hint=hint)
        return self.axes[name]

    def sensed_axis(self, name: str) -> Axis:
        """Return one axis with the readout that senses it, its own or the shared one. Raises as :meth:`axis`."""
        axis = self.axis(name)
        return axis if self.readout is None else replace(axis, readout=self.readout)

    def with_terms(self, terms: Mapping[str, Mapping[str, Mapping[str, Any]]]) -> Device:
        """Return the device with further terms: axis -> effect -> parameter -> value."""
        axes = {name: replace(axis, terms={**axis.terms, **terms.get(name, {})}) for name, axis in self.axes.items()}
        return replace(self, axes=axes)

    def require_scan(self) -> Scan:
        """Return the field of view; DeviceInvalid where the device states none."""
        if self.scan is None:
            hint = "add [scan] with half_angle_x and half_angle_y to the device"
            raise DeviceInvalid("is missing and needed here", file=self.source, channel="scan", hint=hint)
        return self.scan

    def tolerance(self, axis: str, key: str) -> float:
        """Return the relative standard uncertainty of ``key`` (``"k"``, ``"a_cir"``, ...) of one axis."""
        return self.axis(axis).tolerance.get(key, self.shared_tolerance.get(key, DEFAULT_TOLERANCE))


def _axis(name: str, table: device_toml.Table) -> Axis:
    terms = {}
    if (effects := table.take_table("terms")) is not None:
        terms = {
            key: effect.take_rest() if key in TERMS_WITH_LISTS else effect.take_numbers()
            for key in list(effects.rest)
            if (effect := effects.take_table(key))
        }
    return Axis(
        mechanics=table.take_as(Mechanics, "mechanics"),
        capacitance=table.take_as(Capacitance, "capacitance"),
        drive=table.take_as(Drive, "drive"),
        readout=_readout(table),
        tolerance=_tolerance(table),
        terms=terms,
        extra=table.take_rest(),
        name=name,
        source=table.source,
    )


def _readout(table: device_toml.Table) -> Readout | None:
    readout = table.take_table("readout")
    return None if readout is None else readout.made(READOUTS[readout.take_kind(READOUTS)])


def _tolerance(table: device_toml.Table) -> dict[str, float]:
    tolerance = table.take_table("tolerance")
    return {} if tolerance is None else tolerance.take_numbers(NOT_NEGATIVE, only=True)
