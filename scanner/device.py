"""The nominal device: what its maker or its calibration says of every stage, as text (TOML) and as values.

A device file holds one table an axis, SI units, mechanical angles in radians. What a table may hold is what the
dataclasses here have as fields; a key nobody knows is kept in ``extra`` and written back, so that a file survives
a round trip through a program that is older than it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from math import pi, sqrt
from pathlib import Path
from typing import Any, ClassVar

import tomli_w

from scanner import device_toml
from scanner.device_toml import CAN_BE_OFF, FINITE, NONZERO, NOT_NEGATIVE, POSITIVE, WHOLE
from scanner.errors import DeviceInvalid
from scanner.files import parse_toml, read_toml

AXES = ("x", "y")
DEFAULT_TOLERANCE = 0.02
"""Relative standard uncertainty of a nominal value that states none."""


class Checked:
    """A table of the device file: its values are checked, and turned into floats, when it is made."""

    def __post_init__(self) -> None:
        device_toml.check_values(self)


@dataclass(frozen=True)
class Mechanics(Checked):
    """``J theta'' + b theta' + k theta = torque`` (chen2020 eq 8).

    Attributes:
        J: moment of inertia [kg m^2].
        b: damping [N m s].
        k: stiffness [N m / rad].
    """

    J: float = field(metadata=POSITIVE)
    b: float = field(metadata=POSITIVE)
    k: float = field(metadata=POSITIVE)

    @property
    def resonance(self) -> float:
        """Undamped resonance ``sqrt(k / J) / 2 pi`` [Hz]."""
        return sqrt(self.k / self.J) / (2 * pi)

    @property
    def quality(self) -> float:
        """Quality factor ``sqrt(k J) / b``."""
        return sqrt(self.k * self.J) / self.b


@dataclass(frozen=True)
class Capacitance(Checked):
    """``C(theta) = C0 exp(-((theta - theta_th) / theta0)^2) + Cb`` (chen2020 eq 9).

    Attributes:
        C0: height of the bell [F].
        Cb: what does not move with the mirror [F].
        theta0: width of the bell [rad].
        theta_th: angle of the largest capacitance [rad].
    """

    C0: float = field(metadata=POSITIVE)
    Cb: float = field(metadata=FINITE)
    theta0: float = field(metadata=POSITIVE)
    theta_th: float = field(default=0.0, metadata=FINITE)


@dataclass(frozen=True)
class Drive(Checked):
    """How a voltage turns the mirror.

    Attributes:
        kind: ``"electrostatic"``, torque ``C'(theta) V^2 / 2``, or ``"linear"``, torque ``torque_per_volt V``.
        torque_per_volt: of a linear drive [N m / V].
    """

    KINDS: ClassVar[tuple[str, ...]] = ("electrostatic", "linear")

    kind: str
    torque_per_volt: float | None = field(default=None, metadata=NONZERO | CAN_BE_OFF)

    def __post_init__(self) -> None:
        device_toml.check_kind(self.kind, self.KINDS)
        if self.kind == "linear" and self.torque_per_volt is None:
            raise DeviceInvalid("is missing", channel="torque_per_volt", hint="a linear drive needs it [N m / V]")
        super().__post_init__()


@dataclass(frozen=True)
class Amdm(Checked):
    """Amplitude modulation and demodulation: ``V = a_cir C + b_cir`` through first-order sections (chen2020 II-C).

    Attributes:
        a_cir: gain [V / F].
        b_cir: offset [V].
        lpf_hz: corner frequency of every low-pass section [Hz].
        noise_var: variance of the output's noise [V^2].
        bits: of the converter.
    """

    kind: ClassVar[str] = "amdm"

    a_cir: float = field(metadata=NONZERO)
    b_cir: float = field(metadata=FINITE)
    lpf_hz: tuple[float, ...] = field(metadata=POSITIVE)
    noise_var: float = field(metadata=NOT_NEGATIVE)
    bits: int | None = field(default=None, metadata=WHOLE | CAN_BE_OFF)

    @property
    def noise_sd(self) -> float:
        """Standard deviation of the output's noise [V]."""
        return sqrt(self.noise_var)


@dataclass(frozen=True)
class Transimpedance(Checked):
    """Current of the biased comb: ``V = -R_s V_bias C'(theta) theta'`` (chen2019 eq 2).

    Attributes:
        R_s: feedback resistor [ohm].
        V_bias: [V].
        noise_sd: standard deviation of the output's noise [V].
        bits: of the converter.
    """

    kind: ClassVar[str] = "transimpedance"

    R_s: float = field(metadata=POSITIVE)
    V_bias: float = field(metadata=NONZERO)
    noise_sd: float = field(metadata=NOT_NEGATIVE)
    bits: int | None = field(default=None, metadata=WHOLE | CAN_BE_OFF)


@dataclass(frozen=True)
class Position(Checked):
    """A position sensor: ``V = gain theta + offset``.

    Attributes:
        gain: [V / rad].
        noise_sd: standard deviation of the output's noise [V].
        offset: output at rest [V].
        bits: of the converter.
    """

    kind: ClassVar[str] = "position"

    gain: float = field(metadata=NONZERO)
    noise_sd: float = field(metadata=NOT_NEGATIVE)
    offset: float = field(default=0.0, metadata=FINITE)
    bits: int | None = field(default=None, metadata=WHOLE | CAN_BE_OFF)


@dataclass(frozen=True)
class Scan(Checked):
    """Field of view that fills the picture, as mechanical half angles [rad].

    Attributes:
        metres_per_radian: by which the beam moves over the sample [m/rad]; where it is told pictures are to scale.
    """

    half_angle_x: float = field(metadata=POSITIVE)
    half_angle_y: float = field(metadata=POSITIVE)
    metres_per_radian: float | None = field(default=None, metadata=POSITIVE | CAN_BE_OFF)


Readout = Amdm | Transimpedance | Position
READOUTS: dict[str, type[Readout]] = {readout.kind: readout for readout in (Amdm, Transimpedance, Position)}


@dataclass(frozen=True)
class Axis:
    """One axis, stage by stage; a stage the file does not speak of is None.

    Attributes:
        tolerance: stated relative standard uncertainties, by the name of the value.
        terms: physics beyond the nominal laws, effect -> parameter -> value [SI].
        extra: what the file holds beyond that, nested as in the file.
        name: ``"x"`` or ``"y"``, for messages.
        source: where the axis came from, for messages.
    """

    mechanics: Mechanics | None = None
    capacitance: Capacitance | None = None
    drive: Drive | None = None
    readout: Readout | None = None
    tolerance: Mapping[str, float] = field(default_factory=dict)
    terms: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    extra: Mapping[str, Any] = field(default_factory=dict)
    name: str = field(default="", compare=False)
    source: str | None = field(default=None, compare=False)

    @property
    def resonance(self) -> float:
        """Undamped resonance of the nominal mechanics [Hz]; raises as :meth:`require_mechanics`."""
        return self.require_mechanics().resonance

    @property
    def quality(self) -> float:
        """Quality factor of the nominal mechanics; raises as :meth:`require_mechanics`."""
        return self.require_mechanics().quality

    def require_mechanics(self) -> Mechanics:
        """The mechanics; DeviceInvalid where the device states none."""
        if self.mechanics is None:
            raise self._missing("mechanics", "J, b and k")
        return self.mechanics

    def require_capacitance(self) -> Capacitance:
        """The capacitance; DeviceInvalid where the device states none."""
        if self.capacitance is None:
            raise self._missing("capacitance", "C0, Cb and theta0")
        return self.capacitance

    def require_drive(self) -> Drive:
        """The drive; DeviceInvalid where the device states none."""
        if self.drive is None:
            raise self._missing("drive", "kind")
        return self.drive

    def require_readout(self) -> Readout:
        """The axis's own readout; DeviceInvalid where the device states none."""
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
        readout: the one readout that sees ``C_x + C_y`` where all combs share an electrode, else None.
        scan: field of view, None where the file states none.
        shared_tolerance: stated relative uncertainties of the shared readout.
        extra: what the file holds beyond that, nested as in the file.
        source: where the device came from, for messages.
    """

    name: str
    axes: Mapping[str, Axis]
    readout: Readout | None = None
    scan: Scan | None = None
    shared_tolerance: Mapping[str, float] = field(default_factory=dict)
    extra: Mapping[str, Any] = field(default_factory=dict)
    source: str | None = field(default=None, compare=False)

    @classmethod
    def load(cls, path: str | Path) -> Device:
        """The device in the TOML file at ``path``.

        Raises:
            BadInput: the file cannot be read, or is not TOML.
            DeviceInvalid: it lacks a needed key or holds a value that is not physical.
        """
        return cls.from_table(read_toml(path), source=str(path))

    @classmethod
    def from_toml(cls, text: str, source: str | None = None) -> Device:
        """The device that ``text`` describes.

        Raises:
            BadInput: the text is not TOML.
            DeviceInvalid: with ``source``, the key (``x.mechanics.k``), what is wrong and what to do.
        """
        return cls.from_table(parse_toml(text, source), source)

    @classmethod
    def from_table(cls, table: Mapping[str, Any], source: str | None = None) -> Device:
        """The device in a table already parsed from TOML; raises as :meth:`from_toml`."""
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
            shared_tolerance=_tolerance(rest),
            extra=rest.take_rest(),
            source=source,
        )

    def to_toml(self) -> str:
        """The device as text; :meth:`from_toml` of it equals this device."""
        table: dict[str, Any] = {"name": self.name}
        for name, axis in self.axes.items():
            stages = {stage: getattr(axis, stage) for stage in ("mechanics", "capacitance", "drive", "readout")}
            body = {stage: device_toml.to_table(value) for stage, value in stages.items() if value is not None}
            body |= {"tolerance": dict(axis.tolerance)} if axis.tolerance else {}
            body |= {"terms": {effect: dict(values) for effect, values in axis.terms.items()}} if axis.terms else {}
            table[name] = device_toml.merged(body, axis.extra)
        for key, value in (("readout", self.readout), ("scan", self.scan)):
            if value is not None:
                table[key] = device_toml.to_table(value)
        if self.shared_tolerance:
            table["tolerance"] = dict(self.shared_tolerance)
        return tomli_w.dumps(device_toml.merged(table, self.extra))

    def axis(self, name: str) -> Axis:
        """One axis; DeviceInvalid where the device has none of that name."""
        if name not in self.axes:
            hint = f"add the table [{name}]; the device holds {', '.join(self.axes)}"
            raise DeviceInvalid("is missing and needed here", file=self.source, channel=name, hint=hint)
        return self.axes[name]

    def sensed_axis(self, name: str) -> Axis:
        """One axis with the readout that sees it, its own or the shared one; raises as :meth:`axis`."""
        axis = self.axis(name)
        return axis if self.readout is None else replace(axis, readout=self.readout)

    def require_scan(self) -> Scan:
        """The field of view; DeviceInvalid where the device states none."""
        if self.scan is None:
            hint = "add [scan] with half_angle_x and half_angle_y to the device"
            raise DeviceInvalid("is missing and needed here", file=self.source, channel="scan", hint=hint)
        return self.scan

    def tolerance(self, axis: str, key: str) -> float:
        """Relative standard uncertainty of ``key`` (``"k"``, ``"a_cir"``, ...) of one axis."""
        return self.axis(axis).tolerance.get(key, self.shared_tolerance.get(key, DEFAULT_TOLERANCE))


def _axis(name: str, table: device_toml.Table) -> Axis:
    terms = {}
    if (effects := table.take_table("terms")) is not None:
        terms = {key: effect.take_numbers() for key in list(effects.rest) if (effect := effects.take_table(key))}
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
    return {} if tolerance is None else tolerance.take_numbers(NOT_NEGATIVE)
