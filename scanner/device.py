"""The nominal device: the values of every stage from design or calibration, as text (TOML) and as dataclasses.

A device file holds one table for each axis, in SI units and mechanical angles. The fields of the dataclasses are the
keys of the tables. Unknown keys are kept in ``extra`` and written back, so that an older program does not lose them.
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
from scanner.geometry import Geometry

AXES = ("x", "y")
DEFAULT_TOLERANCE = 0.02
"""Relative standard uncertainty of a nominal value for which the device states none: typical of a data sheet."""


class Checked:
    """A table of the device file. Its values are checked and converted to float when it is made."""

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
        C0: amplitude of the Gaussian part [F].
        Cb: part that does not depend on the angle [F].
        theta0: half width of the Gaussian part at 1/e [rad].
        theta_th: angle of the largest capacitance [rad].
    """

    C0: float = field(metadata=POSITIVE)
    Cb: float = field(metadata=FINITE)
    theta0: float = field(metadata=POSITIVE)
    theta_th: float = field(default=0.0, metadata=FINITE)


@dataclass(frozen=True)
class Drive(Checked):
    """Conversion of voltage to torque.

    Attributes:
        kind: ``"electrostatic"``, torque ``C'(theta) V^2 / 2``, or ``"linear"``, torque ``torque_per_volt V``.
        torque_per_volt: torque per volt of a linear drive, which needs it unless the axis has no mechanics [N m / V].
        frequency: of the drive voltage, for a recording without a drive channel [Hz].
    """

    KINDS: ClassVar[tuple[str, ...]] = ("electrostatic", "linear")

    kind: str
    torque_per_volt: float | None = field(default=None, metadata=NONZERO | CAN_BE_OFF)
    frequency: float | None = field(default=None, metadata=POSITIVE | CAN_BE_OFF)

    def __post_init__(self) -> None:
        device_toml.check_kind(self.kind, self.KINDS)
        if self.kind == "linear" and self.torque_per_volt is None and self.frequency is None:
            raise DeviceInvalid("is missing", channel="torque_per_volt", hint="a linear drive needs it [N m / V]")
        super().__post_init__()

    @property
    def motion_per_drive(self) -> float:
        """Frequency of the motion by that of the drive: a half for combs, which pull at either end of the motion."""
        return 0.5 if self.kind == "electrostatic" else 1.0


@dataclass(frozen=True)
class Amdm(Checked):
    """Amplitude modulation and demodulation: ``V = a_cir C + b_cir`` through first-order sections (chen2020 II-C).

    Attributes:
        a_cir: gain of the circuit [V / F].
        b_cir: offset of the circuit [V].
        lpf_hz: corner frequency of every low-pass section [Hz].
        noise_var: variance of the output's noise [V^2].
        bits: resolution of the converter.
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
        V_bias: bias voltage on the comb [V].
        noise_sd: standard deviation of the output's noise [V].
        bits: resolution of the converter.
    """

    kind: ClassVar[str] = "transimpedance"

    R_s: float = field(metadata=POSITIVE)
    V_bias: float = field(metadata=NONZERO)
    noise_sd: float = field(metadata=NOT_NEGATIVE)
    bits: int | None = field(default=None, metadata=WHOLE | CAN_BE_OFF)


class MotionSensor(Checked):
    """A readout that follows the motion itself: ``V = gain d^n theta / dt^n + offset``.

    Attributes:
        kind: of the readout.
        order: n, the time derivatives of the angle that the output follows.
        gain: [V / (rad / s^n)].
        offset: output at rest [V].
        noise_sd: standard deviation of the output's noise [V].
    """

    kind: ClassVar[str]
    order: ClassVar[int]
    gain: float
    offset: float
    noise_sd: float


@dataclass(frozen=True)
class Position(MotionSensor):
    """A position sensor: ``V = gain theta + offset``.

    Attributes:
        gain: volts per radian of mechanical angle [V / rad].
        noise_sd: standard deviation of the output's noise [V].
        offset: output at rest [V].
        bits: resolution of the converter.
    """

    kind: ClassVar[str] = "position"
    order: ClassVar[int] = 0

    gain: float = field(metadata=NONZERO)
    noise_sd: float = field(metadata=NOT_NEGATIVE)
    offset: float = field(default=0.0, metadata=FINITE)
    bits: int | None = field(default=None, metadata=WHOLE | CAN_BE_OFF)


@dataclass(frozen=True)
class Velocity(MotionSensor):
    """A velocity sensor, such as a laser Doppler vibrometer: ``V = gain theta' + offset``.

    Attributes:
        gain: volts per radian a second of mechanical angle [V s / rad].
        noise_sd: standard deviation of the output's noise [V].
        offset: output at rest [V].
        bits: resolution of the converter.
    """

    kind: ClassVar[str] = "velocity"
    order: ClassVar[int] = 1

    gain: float = field(metadata=NONZERO)
    noise_sd: float = field(metadata=NOT_NEGATIVE)
    offset: float = field(default=0.0, metadata=FINITE)
    bits: int | None = field(default=None, metadata=WHOLE | CAN_BE_OFF)


@dataclass(frozen=True)
class Acceleration(MotionSensor):
    """An acceleration sensor: ``V = gain theta'' + offset``.

    Attributes:
        gain: volts per radian a second squared of mechanical angle [V s^2 / rad].
        noise_sd: standard deviation of the output's noise [V].
        offset: output at rest [V].
        bits: resolution of the converter.
    """

    kind: ClassVar[str] = "acceleration"
    order: ClassVar[int] = 2

    gain: float = field(metadata=NONZERO)
    noise_sd: float = field(metadata=NOT_NEGATIVE)
    offset: float = field(default=0.0, metadata=FINITE)
    bits: int | None = field(default=None, metadata=WHOLE | CAN_BE_OFF)


@dataclass(frozen=True)
class Scan(Checked):
    """Field of view that fills the picture, as half angles, and whether these and all reported angles are optical.

    Attributes:
        half_angle_x, half_angle_y: half the field of view, in the kind of angle that ``angle`` states [rad].
        metres_per_radian: displacement of the beam on the sample by that angle [m/rad]; where it is stated, pictures
            are to scale.
        angle: ``"mechanical"`` (of the mirror; the default) or ``"optical"`` (of the beam, twice the mechanical
            one): of this table and of every reported angle.
    """

    ANGLES: ClassVar[tuple[str, ...]] = ("mechanical", "optical")

    half_angle_x: float = field(metadata=POSITIVE)
    half_angle_y: float = field(metadata=POSITIVE)
    metres_per_radian: float | None = field(default=None, metadata=POSITIVE | CAN_BE_OFF)
    angle: str | None = None

    def __post_init__(self) -> None:
        if self.angle_kind not in self.ANGLES:
            hint = f"write one of {', '.join(self.ANGLES)}"
            raise DeviceInvalid(f"{self.angle!r} is unknown", channel="angle", hint=hint)
        super().__post_init__()

    @property
    def angle_kind(self) -> str:
        """``"mechanical"``, which is the default, or ``"optical"``."""
        return self.angle or "mechanical"

    @property
    def angle_scale(self) -> float:
        """Stated and reported angle by mechanical angle: 1, or 2 for optical angles."""
        return 2.0 if self.angle == "optical" else 1.0

    @property
    def mechanical_half_angles(self) -> tuple[float, float]:
        """Half the field of view in x and y as mechanical angles [rad]."""
        return self.half_angle_x / self.angle_scale, self.half_angle_y / self.angle_scale


Readout = Amdm | Transimpedance | Position | Velocity | Acceleration
READOUTS: dict[str, type[Readout]] = {
    readout.kind: readout for readout in (Amdm, Transimpedance, Position, Velocity, Acceleration)
}


@dataclass(frozen=True)
class Axis:
    """One axis, stage by stage. A stage that the file does not state is None.

    Attributes:
        tolerance: stated relative standard uncertainties, by the name of the value.
        terms: physics beyond the nominal laws, effect -> parameter -> value [SI]. ``measured-law`` also has text and
            lists, see ``scanner.terms.measured_law``.
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
            BadInput: the text is not TOML.
            DeviceInvalid: it lacks a needed key or holds a value that is not physical; the message names the key.
        """
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
            key: effect.take_rest() if key == "measured-law" else effect.take_numbers()
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
    return {} if tolerance is None else tolerance.take_numbers(NOT_NEGATIVE)
