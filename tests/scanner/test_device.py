"""The device file: lossless round trip, defaults, and errors that name the key."""

from __future__ import annotations

import tomllib
from datetime import date
from math import pi
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from scanner.device import Axis, Device
from scanner.errors import BadInput, DeviceInvalid
from scanner.stages import (
    READOUTS,
    Acceleration,
    Amdm,
    Capacitance,
    Drive,
    Mechanics,
    Position,
    Scan,
    Transimpedance,
    Velocity,
)

CONTRACT = """
name = "chen2020"
[x.mechanics]
J = 1.0e-15
b = 5.2e-13
k = 9.6e-6
[x.capacitance]
C0 = 5.71e-12
Cb = 9.79e-12
theta0 = 0.2
theta_th = 0.0
[x.drive]
kind = "electrostatic"
[x.readout]
kind = "amdm"
a_cir = -3.574e11
b_cir = 6.3945
lpf_hz = [40800.0, 41100.0]
noise_var = 1.92e-4
bits = 12
[x.tolerance]
k = 0.0005
b = 0.03
[scan]
half_angle_x = 0.18
half_angle_y = 0.16
"""

finite = st.floats(-1e15, 1e15)
positive = st.floats(1e-30, 1e15)
not_negative = st.floats(0, 1e15)
nonzero = finite.filter(bool)
bits = st.none() | st.integers(1, 32)
words = st.text(st.characters(codec="ascii", categories=["L", "N"]), min_size=1, max_size=8)
numbers = st.dictionaries(words, finite, max_size=3)
readouts = st.one_of(
    st.builds(Amdm, nonzero, finite, st.lists(positive, max_size=3).map(tuple), not_negative, bits),
    st.builds(Transimpedance, positive, nonzero, not_negative, bits),
    *(st.builds(sensor, nonzero, not_negative, finite, bits) for sensor in (Position, Velocity, Acceleration)),
)
drives = st.just(Drive("electrostatic")) | st.builds(Drive, st.just("linear"), nonzero)
extras = st.dictionaries(
    words.map("unknown_{}".format),
    st.recursive(finite | st.text() | st.booleans() | st.dates(), lambda inner: st.lists(inner, max_size=2)),
    max_size=2,
)
axes = st.builds(
    Axis,
    mechanics=st.none() | st.builds(Mechanics, positive, positive, positive),
    capacitance=st.none() | st.builds(Capacitance, positive, finite, positive, finite),
    drive=st.none() | drives,
    readout=st.none() | readouts,
    tolerance=st.dictionaries(words, not_negative, max_size=3),
    terms=st.dictionaries(words, numbers, max_size=2),
    extra=extras,
)
devices = st.builds(
    Device,
    name=st.text(),
    axes=st.dictionaries(st.sampled_from(["x", "y"]), axes, min_size=1),
    readout=st.none() | readouts,
    scan=st.none() | st.builds(Scan, positive, positive),
    shared_tolerance=st.dictionaries(words, not_negative, max_size=2),
    extra=extras,
)


@settings(deadline=None)  # the machine may be busy
@given(devices)
def test_round_trip_is_lossless(device: Device) -> None:
    assert Device.from_toml(device.to_toml()) == device


def test_documented_device_file_is_read() -> None:
    device = Device.from_toml(CONTRACT)
    axis = device.axis("x")
    assert axis.mechanics == Mechanics(J=1e-15, b=5.2e-13, k=9.6e-6)
    assert axis.readout == Amdm(a_cir=-3.574e11, b_cir=6.3945, lpf_hz=(40800.0, 41100.0), noise_var=1.92e-4, bits=12)
    assert axis.readout.noise_sd == pytest.approx(0.013856406)
    assert device.require_scan() == Scan(0.18, 0.16)
    assert axis.resonance == pytest.approx((9.6e-6 / 1e-15) ** 0.5 / (2 * pi))
    assert axis.quality == pytest.approx((9.6e-6 * 1e-15) ** 0.5 / 5.2e-13)
    assert tomllib.loads(device.to_toml()) == tomllib.loads(CONTRACT)


def test_unknown_keys_are_preserved() -> None:
    text = """
name = "d"
made = 2026-01-31
[optics]
magnification = [1, 2]
[x]
owner = "lab"
[x.mechanics]
J = 1.0
b = 1.0
k = 1.0
note = "drawn, not measured"
[x.terms.cubic-stiffness]
k3 = 2.0
unit = "N m/rad^3"
[y.readout]
kind = "position"
gain = 1.0
noise_sd = 0.0
serial = 17
"""
    device = Device.from_toml(text)
    assert device.extra["made"] == date(2026, 1, 31)
    assert device.axis("x").terms == {"cubic-stiffness": {"k3": 2.0}}
    expected = tomllib.loads(text)
    expected["y"]["readout"]["offset"] = 0.0
    assert tomllib.loads(device.to_toml()) == expected


def test_tolerance_defaults_to_the_shared_one_and_then_to_two_percent() -> None:
    device = Device.from_toml(CONTRACT + "[tolerance]\na_cir = 0.1\nk = 0.5\n")
    assert [device.tolerance("x", key) for key in ("k", "a_cir", "C0")] == [0.0005, 0.1, 0.02]


@pytest.mark.parametrize(
    ("swap", "line"),
    [
        (("k = 9.6e-6", ""), "x.mechanics.k: is missing; [x.mechanics] needs J, b, k"),
        (("k = 9.6e-6", "k = true"), "x.mechanics.k: is True and must be a number greater than 0"),
        (("k = 9.6e-6", 'k = "1"'), "x.mechanics.k: is '1' and must be a number greater than 0"),
        (("J = 1.0e-15", "J = 0"), "x.mechanics.J: is 0 and must be a number greater than 0"),
        (("b = 5.2e-13", "b = nan"), "x.mechanics.b: is nan and must be a number greater than 0"),
        (("C0 = 5.71e-12", "C0 = -1"), "x.capacitance.C0: is -1 and must be a number greater than 0"),
        (("Cb = 9.79e-12", "Cb = inf"), "x.capacitance.Cb: is inf and must be a finite number"),
        (("theta0 = 0.2", "theta0 = 0"), "x.capacitance.theta0: is 0 and must be a number greater than 0"),
        (
            ('"electrostatic"', '"magnetic"'),
            "x.drive.kind: 'magnetic' is unknown; known kinds: electrostatic, linear",
        ),
        (
            ('"electrostatic"', '"linear"'),
            "x.drive.torque_per_volt: is missing; a linear drive needs it [N m / V]",
        ),
        (('kind = "electrostatic"', ""), "x.drive.kind: is missing; [x.drive] needs kind"),
        (('"amdm"', '"a"'), f"x.readout.kind: 'a' is unknown; known kinds: {', '.join(READOUTS)}"),
        (('kind = "amdm"', ""), f"x.readout.kind: is missing; known kinds: {', '.join(READOUTS)}"),
        (("[40800.0, 41100.0]", "40800.0"), "x.readout.lpf_hz: is 40800.0 and must be a list of numbers"),
        (("41100.0]", "-1]"), "x.readout.lpf_hz: is -1 and must be a number greater than 0"),
        (("noise_var = 1.92e-4", "noise_var = -1"), "x.readout.noise_var: is -1 and must be a number, 0 or greater"),
        (("a_cir = -3.574e11", "a_cir = 0"), "x.readout.a_cir: is 0 and must be a number other than 0"),
        (("bits = 12", "bits = 12.0"), "x.readout.bits: is 12.0 and must be a whole number greater than 0"),
        (("k = 0.0005", "k = -1"), "x.tolerance.k: is -1 and must be a number, 0 or greater"),
        (("half_angle_y = 0.16", ""), "scan.half_angle_y: is missing; [scan] needs half_angle_x, half_angle_y"),
        (('name = "chen2020"', "name = 7"), "name: is 7 and must be text; put it in quotes"),
        (("[scan]", "[x.terms]\nheat = 3\n[scan]"), "x.terms.heat: is 3 and must be a table; write [x.terms.heat]"),
        (
            ("[scan]", "[x.terms.drift]\nk3 = false\n[scan]"),
            "x.terms.drift.k3: is False and must be a finite number",
        ),
        (("J = 1.0e-15", "J = 1" + 400 * "0"), f"x.mechanics.J: is 1{400 * '0'} and must be a number greater than 0"),
    ],
)
def test_wrong_value_is_reported_in_one_line(swap: tuple[str, str], line: str) -> None:
    assert swap[0] in CONTRACT
    with pytest.raises(DeviceInvalid) as caught:
        Device.from_toml(CONTRACT.replace(*swap), source="d.toml")
    assert str(caught.value) == f"d.toml: {line}"


@pytest.mark.parametrize(
    ("text", "line"),
    [
        ("", "holds no axis; a device needs a table [x], [y] or both"),
        ("x = 3", "x: is 3 and must be a table; write [x]"),
        ("x =", "is not TOML: Invalid value (at end of document); correct the line that it names"),
    ],
)
def test_text_that_is_no_device_is_refused(text: str, line: str) -> None:
    with pytest.raises(BadInput) as caught:
        Device.from_toml(text, source="d.toml")
    assert str(caught.value) == f"d.toml: {line}"


def test_value_set_in_python_is_checked() -> None:
    with pytest.raises(DeviceInvalid, match="theta0: is -1"):
        Capacitance(C0=1, Cb=1, theta0=-1)
    assert isinstance(Mechanics(J=1, b=1, k=1).J, float)


def test_position_stage_needs_no_mechanics_until_they_are_used() -> None:
    text = '[y.readout]\nkind = "position"\ngain = 1\nnoise_sd = 0\n'
    device = Device.from_toml(text, source="stage.toml")
    axis = device.axis("y")
    assert axis.require_readout() == Position(gain=1.0, noise_sd=0.0)
    asked = [
        (axis.require_mechanics, "y.mechanics", "add [y.mechanics] with J, b and k to the device"),
        (lambda: axis.resonance, "y.mechanics", "add [y.mechanics] with J, b and k to the device"),
        (lambda: axis.quality, "y.mechanics", "add [y.mechanics] with J, b and k to the device"),
        (axis.require_capacitance, "y.capacitance", "add [y.capacitance] with C0, Cb and theta0 to the device"),
        (axis.require_drive, "y.drive", "add [y.drive] with kind to the device"),
        (lambda: device.axis("x"), "x", "add the table [x]; the device holds y"),
        (device.require_scan, "scan", "add [scan] with half_angle_x and half_angle_y to the device"),
    ]
    for ask, key, hint in asked:
        with pytest.raises(DeviceInvalid) as caught:
            ask()
        assert str(caught.value) == f"stage.toml: {key}: is missing and needed here; {hint}"


def test_error_of_load_names_the_file(tmp_path: Path) -> None:
    with pytest.raises(BadInput, match=r"gone\.toml: cannot be read: No such file"):
        Device.load(tmp_path / "gone.toml")
    (tmp_path / "binary.toml").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(BadInput, match=r"binary\.toml: is not text"):
        Device.load(tmp_path / "binary.toml")
    (tmp_path / "good.toml").write_text(CONTRACT)
    assert Device.load(tmp_path / "good.toml") == Device.from_toml(CONTRACT)
