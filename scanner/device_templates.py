"""Device files to start from: a commented TOML text for a kind of scanner, filled with what is known of it."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from math import hypot, pi, radians, sqrt

from scanner.device import AXES
from scanner.errors import BadInput
from scanner.steady_drive import COMB_AMPLITUDE_THETA0, COMB_C0, COMB_STIFFNESS, comb_frequency, comb_voltage

MIRROR_INERTIA = 1.0e-10
"""Moment of inertia of a linearly driven axis [kg m2]: an arbitrary value, which only scales b, k and the torque."""
LINEAR_VOLTS = 10.0
"""Voltage of a linear drive that reaches the amplitude [V]: sets the torque per volt where none is stated."""


@dataclass(frozen=True)
class KnownAxis:
    """What is known of one axis; None where it is not.

    Attributes:
        resonance: of the motion [Hz].
        quality: quality factor.
        amplitude: half the scanned range, mechanical [rad].
        drive_frequency: of the drive voltage [Hz].
    """

    resonance: float | None = None
    quality: float | None = None
    amplitude: float | None = None
    drive_frequency: float | None = None


@dataclass(frozen=True)
class ScannerKind:
    """A kind of scanner and its typical values.

    Attributes:
        title: in words.
        is_parametric: comb drives, which move at half the drive's frequency.
        x, y: typical values; a drive frequency is given only if the axis is not driven at its resonance.
        sensor: what the position readout is, for the comment.
        gain: of the position readout [V / rad].
        noise_sd: of the position readout [V].
        metres_per_radian: displacement of the beam by mechanical angle [m / rad]; None if there is no typical value.
    """

    title: str
    x: KnownAxis
    y: KnownAxis
    is_parametric: bool = False
    sensor: str = "position-sensitive detector"
    gain: float = 20.0
    noise_sd: float = 2.0e-3
    metres_per_radian: float | None = None


KINDS = {
    "parametric": ScannerKind(
        "comb-driven mirror, all combs on one sense electrode",
        KnownAxis(13763.0, 120.0, 0.18),
        KnownAxis(3252.0, 120.0, 0.18),
        is_parametric=True,
    ),
    "electromagnetic": ScannerKind(
        "electromagnetic mirror with a position detector", KnownAxis(2000.0, 100.0, 0.08), KnownAxis(835.0, 100.0, 0.08)
    ),
    "piezo": ScannerKind(
        "piezoelectric mirror with a piezoresistive sensor",
        KnownAxis(20000.0, 500.0, 0.15),
        KnownAxis(1100.0, 200.0, 0.1),
        sensor="piezoresistive bridge",
        gain=1.0,
        noise_sd=2.0e-4,
    ),
    "fibre": ScannerKind(
        "resonant fibre with a position detector; angle = deflection of the tip / length of the fibre",
        KnownAxis(1000.0, 100.0, 0.1),
        KnownAxis(1009.0, 100.0, 0.1),
        noise_sd=5.0e-3,
        metres_per_radian=2.5e-3,
    ),
    "afm": ScannerKind(
        "piezo stage with position sensors, driven far below its resonance; 1 rad of this file is 1 um of the stage",
        KnownAxis(500.0, 20.0, 5.0, 20.0),
        KnownAxis(500.0, 20.0, 5.0, 0.5),
        sensor="position sensor of the stage",
        gain=0.0133,
        noise_sd=7.0e-5,
        metres_per_radian=1.0e-6,
    ),
    "galvo": ScannerKind(
        "resonant mirror (x) and galvanometer (y), each with the position output of its controller",
        KnownAxis(7960.0, 100.0, 0.08),
        KnownAxis(300.0, 0.7, 0.08, 30.0),
        sensor="position output of the controller",
        gain=10.0,
        noise_sd=5.0e-3,
    ),
}
"""Kinds of scanners by name. Typical values are those of the recipes."""


MIRRORS = ("parametric", "electromagnetic", "piezo", "galvo")
"""Kinds whose angles are those of a mirror; a fibre and a stage have others."""

MAX_MIRROR_ANGLE_RAD = pi / 2
"""Amplitude above which a unit is wrong: no mirror turns further."""

MIN_RESONANCE_HZ = 50.0
"""Resonance of a mirror or a fibre below which a unit is wrong: the slowest resonant mirrors reach about 100 Hz, and
the fastest, 50 kHz, stated in kHz, are still below."""

TYPICAL_SD = 0.3
"""Relative standard uncertainty of a typical gain or torque: instruments of one kind differ by a factor of 2."""


def new_device(
    kind: str, known: Mapping[str, KnownAxis], name: str | None = None, frequencies_only: bool = False
) -> str:
    """Return a commented device file for a kind of scanner.

    Args:
        kind: a key of ``KINDS``.
        known: what is known of ``"x"`` and ``"y"``; typical values fill the rest.
        name: of the device; the kind's where None.
        frequencies_only: state nothing but the drive frequencies, which must be known, and the field. Phases then come
            from the picture.

    Raises:
        BadInput: no such kind, a drive frequency is missing, an amplitude is larger or a resonance lower than any
            mirror's.
    """
    if kind not in KINDS:
        raise BadInput(f"no kind of scanner is named {kind!r}", hint=f"there are {', '.join(KINDS)}")
    scanner = KINDS[kind]
    axes = {axis: known.get(axis, KnownAxis()) for axis in AXES}
    for axis, each in axes.items():
        if kind in MIRRORS and each.amplitude and each.amplitude > MAX_MIRROR_ANGLE_RAD:
            what = f"is {each.amplitude:g} rad, and no mirror turns so far"
            hint = f"{each.amplitude:g} degrees are {radians(each.amplitude):.4g} rad"
            raise BadInput(what, channel=f"--amplitude-{axis}", hint=hint)
        if kind != "afm" and each.resonance and each.resonance < MIN_RESONANCE_HZ:
            what = f"is {each.resonance:g} Hz, and no {kind} scanner resonates below {MIN_RESONANCE_HZ:g} Hz"
            hint = f"{each.resonance:g} kHz are {1e3 * each.resonance:g} Hz"
            raise BadInput(what, channel=f"--resonance-{axis}", hint=hint)
        if kind == "parametric" and each.resonance and each.drive_frequency:
            _check_parametric_drive(axis, each.resonance, each.drive_frequency)
    filled = {axis: _fill(scanner, getattr(scanner, axis), axes[axis]) for axis in AXES}
    parts = [_heading(kind, scanner, filled), f"name = {json.dumps(name or kind)}"]
    if frequencies_only:
        parts = [FREQUENCIES_HEADING, *parts[1:], *_frequencies(scanner, axes), _scan(scanner, axes, filled)]
        return _aligned("\n\n".join(parts))
    for axis in AXES:
        parts.append((_comb_axis if scanner.is_parametric else _linear_axis)(scanner, axis, axes[axis], filled[axis]))
    if scanner.is_parametric:
        parts.append(SHARED_READOUT)
    parts.append(_scan(scanner, axes, filled))
    return _aligned("\n\n".join(parts))


def _check_parametric_drive(axis: str, resonance: float, drive: float) -> None:
    """Check that combs, which move a mirror at half the drive's frequency, are not driven at the resonance itself.

    Raises:
        BadInput: the drive is nearer to the resonance than to twice the resonance.
    """
    if drive < sqrt(2.0) * resonance:
        what = f"is {drive:g} Hz, and combs move the mirror at half of that; its resonance is {resonance:g} Hz"
        hint = f"drive it near {2.0 * resonance:g} Hz, or state another kind"
        raise BadInput(what, channel=f"--drive-frequency-{axis}", hint=hint)


def _aligned(text: str) -> str:
    """The text with the comments after values aligned in one column."""
    lines = (line.partition("  # ") for line in text.splitlines())
    return "".join((f"{left.rstrip():<28}# {comment}" if mark else left) + "\n" for left, mark, comment in lines)


def _fill(scanner: ScannerKind, typical: KnownAxis, known: KnownAxis) -> KnownAxis:
    """Known values, and typical ones in place of the others; a known drive frequency determines the resonance."""
    quality = known.quality or typical.quality or 1.0
    ratio = comb_frequency(1.0, quality) if scanner.is_parametric else 1.0
    from_drive = known.drive_frequency / ratio if known.drive_frequency and _is_driven_at_resonance(typical) else None
    resonance = known.resonance or from_drive or typical.resonance or 1.0
    drive = known.drive_frequency or typical.drive_frequency or ratio * resonance
    return KnownAxis(resonance, quality, known.amplitude or typical.amplitude, drive)


def _is_driven_at_resonance(typical: KnownAxis) -> bool:
    """Whether an axis of typical values is driven at its resonance, so that the drive's frequency determines it."""
    return typical.drive_frequency is None


def _heading(kind: str, scanner: ScannerKind, filled: Mapping[str, KnownAxis]) -> str:
    drives = [f"--drive-{axis} {_volts(scanner, filled[axis])}" for axis in AXES]
    moved = [(filled[axis].drive_frequency or 1.0) / (2.0 if scanner.is_parametric else 1.0) for axis in AXES]
    rate = float(f"{360 * max(moved):.2g}")
    duration = float(f"{min(200 / min(moved), max(12 / min(moved), 0.2)):.2g}")
    simulate = f"lissajous simulate --device device.toml {' '.join(drives)} \\\n#     --rate {rate:g}"
    return f"""\
# Device file: {scanner.title}.
# Written by `lissajous new-device --kind {kind}`. SI units; angles of the mirror (mechanical) in rad.
# "typical" marks what was not stated: replace it by the value from the data sheet or from `lissajous identify`.
# Try it without an instrument:
#   {simulate} --duration {duration:g} --drift -0.0005 -o scan.h5"""


def _volts(scanner: ScannerKind, axis: KnownAxis) -> str:
    """Frequency, amplitude and offset of a drive that reaches the amplitude, as ``simulate`` takes them."""
    if not scanner.is_parametric:
        return f"{axis.drive_frequency:.8g},{LINEAR_VOLTS:g},0"
    volts = comb_voltage(COMB_STIFFNESS, axis.quality or 1.0, COMB_C0, _theta0(axis))
    return f"{axis.drive_frequency:.8g},{volts:.3g},{volts:.3g}"


def _theta0(axis: KnownAxis) -> float:
    return (axis.amplitude or 1.0) / COMB_AMPLITUDE_THETA0


def _mechanics(scanner: ScannerKind, axis: str, known: KnownAxis, filled: KnownAxis, inertia: float) -> str:
    omega = 2 * pi * (filled.resonance or 1.0)
    k, b = inertia * omega**2, inertia * omega / (filled.quality or 1.0)
    by_drive = not known.resonance and known.drive_frequency and _is_driven_at_resonance(getattr(scanner, axis))
    source = ", from the stated drive frequency" if by_drive else _mark(known.resonance)
    return f"""\
[{axis}.mechanics]  # J theta'' + b theta' + k theta = torque
J = {inertia:.6g}  # kg m2, typical; resonance and Q follow from b / J and k / J
b = {b:.6g}  # N m s, for a Q of {filled.quality:g}{_mark(known.quality)}
k = {k:.6g}  # N m / rad, for a resonance of {filled.resonance:.8g} Hz{source}

[{axis}.tolerance]  # relative standard uncertainty of a value; 2 % where none is stated
k = {0.002 if known.resonance or by_drive else 0.02}  # twice that of the resonance
b = {0.05 if known.quality else 0.2}"""


def _comb_axis(scanner: ScannerKind, axis: str, known: KnownAxis, filled: KnownAxis) -> str:
    inertia = COMB_STIFFNESS / (2 * pi * (filled.resonance or 1.0)) ** 2
    return f"""\
{_mechanics(scanner, axis, known, filled, inertia)}
C0 = 0.02
theta0 = 0.02

[{axis}.capacitance]  # C(theta) = C0 exp(-((theta - theta_th) / theta0)^2) + Cb
C0 = {COMB_C0:g}  # F, typical
Cb = 9.79e-12  # F, typical
theta0 = {_theta0(filled):.4g}  # rad, typical for an amplitude of {filled.amplitude:g} rad
theta_th = 0.0  # rad

[{axis}.drive]
kind = "electrostatic"  # torque C'(theta) V^2 / 2; the mirror moves at half the drive's frequency
{_drive_frequency(known, filled)}"""


def _linear_axis(scanner: ScannerKind, axis: str, known: KnownAxis, filled: KnownAxis) -> str:
    omega = 2 * pi * (filled.resonance or 1.0)
    ratio = (filled.drive_frequency or 1.0) / (filled.resonance or 1.0)
    response = hypot(1.0 - ratio**2, ratio / (filled.quality or 1.0))
    torque = MIRROR_INERTIA * omega**2 * (filled.amplitude or 1.0) * response / LINEAR_VOLTS
    return f"""\
{_mechanics(scanner, axis, known, filled, MIRROR_INERTIA)}
torque_per_volt = {TYPICAL_SD}  # state a smaller one with a measured value
gain = {TYPICAL_SD}  # the same

[{axis}.drive]
kind = "linear"  # torque = torque_per_volt V
torque_per_volt = {torque:.4g}  # N m / V, typical: {LINEAR_VOLTS:g} V reach {filled.amplitude:g} rad
{_drive_frequency(known, filled)}

[{axis}.readout]  # {scanner.sensor}: V = gain theta + offset
kind = "position"
gain = {scanner.gain:g}  # V / rad, typical
offset = 0.0  # V
noise_sd = {scanner.noise_sd:g}  # V, typical
bits = 16  # resolution of the converter, typical"""


def _frequencies(scanner: ScannerKind, known: Mapping[str, KnownAxis]) -> list[str]:
    """The drives of both axes, of which nothing but the frequency is stated."""
    kind = "electrostatic" if scanner.is_parametric else "linear"
    moves = "half the drive's" if scanner.is_parametric else "the drive's"
    if missing := [axis for axis in AXES if known[axis].drive_frequency is None]:
        hint = "from the picture alone the phase can be found, not the frequency"
        raise BadInput("is not stated", channel=f"--drive-frequency-{missing[0]}", hint=hint)
    return [
        f'[{axis}.drive]\nkind = "{kind}"  # the mirror moves at {moves} frequency\n'
        f"frequency = {known[axis].drive_frequency!r}  # Hz; a recorded drive channel is used instead"
        for axis in AXES
    ]


def _drive_frequency(known: KnownAxis, filled: KnownAxis) -> str:
    comment = "Hz; only used where no drive was recorded"
    if known.drive_frequency is None:
        return f"# frequency = {filled.drive_frequency:.8g}  # {comment}; left out, `simulate` drives at the resonance"
    return f"frequency = {known.drive_frequency!r}  # {comment}"


def _scan(scanner: ScannerKind, known: Mapping[str, KnownAxis], filled: Mapping[str, KnownAxis]) -> str:
    lines = ["[scan]  # field of view; the amplitudes fill it"]
    for axis in AXES:
        lines.append(f"half_angle_{axis} = {filled[axis].amplitude:g}  # rad{_mark(known[axis].amplitude)}")
    lines.append('angle = "mechanical"  # or "optical": half angles and all reported angles are those of the beam')
    metres = scanner.metres_per_radian
    stated = f"metres_per_radian = {metres:g}" if metres else "# metres_per_radian = 1.0e-3"
    return "\n".join([*lines, f"{stated}  # displacement of the beam on the sample, for pictures to scale"])


def _mark(known: float | None) -> str:
    return ", as stated" if known else ", typical"


FREQUENCIES_HEADING = """\
# Device file of a scanner of which only the drive frequencies and the field are known. `reconstruct` finds the phases
# in the picture. Sign and amplitude of the motion cannot be found there: the field is taken as the amplitude."""

SHARED_READOUT = """\
[readout]  # one for both axes, channel sense; for channels sense_x and sense_y write [x.readout] and [y.readout]
kind = "amdm"  # V = a_cir C + b_cir; or "transimpedance": V = -R_s V_bias C'(theta) theta'
a_cir = -3.574e11  # V / F, typical
b_cir = 9.9  # V, typical
lpf_hz = [40800.0, 41100.0]  # corner frequencies of the low-pass sections, typical
noise_var = 1.92e-4  # V2, typical
bits = 12  # resolution of the converter, typical

[tolerance]  # of the shared readout
a_cir = 0.02
b_cir = 0.02"""
