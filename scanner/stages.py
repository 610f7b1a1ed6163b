"""The stages of a device: the values of mechanics, capacitance, drive, readouts and field of view as dataclasses.

Their fields are the keys of the tables of a device file.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from math import pi, sqrt
from typing import ClassVar

from scanner import device_toml
from scanner.device_toml import CAN_BE_OFF, FINITE, NONZERO, NOT_NEGATIVE, POSITIVE, WHOLE
from scanner.errors import DeviceInvalid

NO_SPRING_HINT = {"hint": "a device without a spring has no resonance: state its stiffness, or leave out its mechanics"}


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
    k: float = field(metadata=POSITIVE | NO_SPRING_HINT)

    @property
    def resonance(self) -> float:
        """Undamped resonance ``sqrt(k / J) / 2 pi`` [Hz]."""
        return sqrt(self.k / self.J) / (2 * pi)

    @property
    def quality(self) -> float:
        """Quality factor ``sqrt(k J) / b``."""
        return sqrt(self.k * self.J) / self.b

    @property
    def fastest_pole(self) -> float:
        """Frequency of the fastest free motion [Hz]: the resonance, or the faster exponential of an overdamped axis."""
        return self.resonance * max(1.0, (0.5 + sqrt(max(0.25 - self.quality**2, 0.0))) / self.quality)


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
        V_bias: bias voltage on the comb [V]. Where a channel ``bias_x`` without a drive is recorded, that is the bias.
        noise_sd: standard deviation of the output's noise [V].
        bits: resolution of the converter.
    """

    kind: ClassVar[str] = "transimpedance"

    R_s: float = field(metadata=POSITIVE)
    V_bias: float = field(metadata=NONZERO)
    noise_sd: float = field(metadata=NOT_NEGATIVE)
    bits: int | None = field(default=None, metadata=WHOLE | CAN_BE_OFF)


@dataclass(frozen=True)
class MotionSensor(Checked):
    """A readout that follows the motion itself: ``V = gain d^n theta / dt^n + offset``.

    Attributes:
        kind: of the readout.
        order: n, the time derivatives of the angle that the output follows.
        gain: of mechanical angle [V / (rad / s^n)].
        noise_sd: standard deviation of the output's noise [V].
        offset: output at rest [V].
        bits: resolution of the converter.
    """

    kind: ClassVar[str]
    order: ClassVar[int]

    gain: float = field(metadata=NONZERO)
    noise_sd: float = field(metadata=NOT_NEGATIVE)
    offset: float = field(default=0.0, metadata=FINITE)
    bits: int | None = field(default=None, metadata=WHOLE | CAN_BE_OFF)


class Position(MotionSensor):
    """A position sensor: ``V = gain theta + offset``.

    Attributes:
        gain: output by mechanical angle [V / rad].
    """

    kind: ClassVar[str] = "position"
    order: ClassVar[int] = 0


class Velocity(MotionSensor):
    """A velocity sensor, such as a laser Doppler vibrometer: ``V = gain theta' + offset``.

    Attributes:
        gain: output by angular velocity [V s / rad].
    """

    kind: ClassVar[str] = "velocity"
    order: ClassVar[int] = 1


class Acceleration(MotionSensor):
    """An acceleration sensor: ``V = gain theta'' + offset``.

    Attributes:
        gain: output by angular acceleration [V s^2 / rad].
    """

    kind: ClassVar[str] = "acceleration"
    order: ClassVar[int] = 2


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


def without_noise(readout: Readout) -> Readout:
    """The readout without noise, for a signal that contains the noise already."""
    return replace(readout, noise_var=0.0) if isinstance(readout, Amdm) else replace(readout, noise_sd=0.0)
