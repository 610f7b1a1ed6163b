"""Further modes in a device file: what sensors see of them, and that every estimator takes them off."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from estimation.estimate import estimate
from phantoms.forward import Plan, simulate
from phantoms.waveforms import Sine
from scanner.active_terms import stated_terms
from scanner.device import Device
from scanner.errors import DeviceInvalid
from scanner.terms import catalogue
from scanner.terms.driven_modes import mode_response

TABLE: dict[str, Any] = {
    "frequency": [805.0, 930.0], "quality": [40.0, 60.0], "gain": [6e4, 2e5], "gain_rate": [0.0, -5e4], "direct": 0.02,
}  # fmt: skip
BARE = """
name = "fibre"
[x.mechanics]
J = 1.0
b = 63.0
k = 39478417.6
[x.drive]
kind = "linear"
torque_per_volt = 3e5
[x.readout]
kind = "{kind}"
gain = {gain}
noise_sd = 1e-9
"""


def device(kind: str = "position", gain: float = 1.0, terms: dict[str, Any] | None = None) -> Device:
    bare = Device.from_toml(BARE.format(kind=kind, gain=gain))
    return bare.with_terms({"x": {"driven-modes": terms}}) if terms else bare


def test_a_device_file_keeps_further_modes() -> None:
    made = device(terms=TABLE)
    assert Device.from_toml(made.to_toml()) == made
    assert "driven-modes" not in catalogue()


@pytest.mark.parametrize("order", [0, 1, 2, 3])
def test_a_mode_answers_a_steady_tone_with_its_transfer_function(order: int) -> None:
    rate, f, quality, tone = 4e5, 805.0, 40.0, 790.0
    time = np.arange(60000) / rate
    response = mode_response(np.cos(2 * np.pi * tone * time), f, quality, 1 / rate)[order]
    w, w0 = 2 * np.pi * tone, 2 * np.pi * f
    height = (1j * w) ** order / (w0**2 - w**2 + 1j * w * w0 / quality)
    expected = (height * np.exp(1j * w * time)).real
    late = slice(40000, -2)
    assert response[late] == pytest.approx(expected[late], abs=2e-3 * abs(height))


@pytest.mark.parametrize(("kind", "order"), [("position", 0), ("velocity", 1), ("acceleration", 2)])
def test_a_sensor_of_motion_sees_the_modes_in_its_own_derivative(kind: str, order: int) -> None:
    gain, tone = 1.0 / (2 * np.pi * 1000.0) ** order, 870.0
    plan = Plan({"x": Sine(tone, 1.0)}, 0.3, 1e5, settle=0.2)
    plain, more = (simulate(device(kind, gain, terms), plan, seed=3)[0]["sense_x"].read() for terms in (None, TABLE))
    time = np.arange(plain.size) / 1e5
    w = 2 * np.pi * tone
    steady = np.exp(-1j * w * time)[plain.size // 2 :]

    def height(values: np.ndarray) -> complex:
        return complex(2 * np.mean((values * np.hanning(values.size) / np.hanning(values.size).mean()) * steady))

    rates, quality, a, h = (np.array(TABLE[key]) for key in ("frequency", "quality", "gain", "gain_rate"))
    w0 = 2 * np.pi * rates
    modes = (1j * w) ** order * gain * np.sum((a + h * 1j * w / w0) / (w0**2 - w**2 + 1j * w * w0 / quality))
    added = height((more - plain)[plain.size // 2 :])
    drive = height(simulate(device(kind, gain), plan, seed=3)[0]["drive_x"].read()[plain.size // 2 :])
    assert added / drive == pytest.approx(modes + TABLE["direct"], rel=0.02)


def test_estimators_take_the_modes_off_the_sense_signal() -> None:
    plan = Plan({"x": Sine(995.0, 1.0)}, 0.1, 1e5, settle=0.2)
    phases = []
    for terms in (None, TABLE):
        stated = device(terms=terms)
        recording, _ = simulate(stated, plan, seed=4)
        phases.append(estimate(recording, stated, method="tracker").axes["x"].phase)
    difference = np.angle(np.exp(1j * (phases[1] - phases[0])))[5:]
    assert np.rad2deg(np.abs(difference).max()) < 0.05


@pytest.mark.parametrize(
    ("changed", "what"),
    [
        ({"gain": None}, "lacks gain"),
        ({"quality": [40.0]}, "different lengths"),
        ({"frequency": 805.0, "quality": 40.0, "gain": 1.0}, "frequency: is 805.0 and must be a list of numbers"),
        ({"frequency": ["a", 805.0]}, "frequency: is 'a' and must be a number"),
        ({"gain": [float("nan"), 1.0]}, "gain: is nan and must be a finite number"),
        ({"direct": "a"}, "direct: is 'a' and must be a finite number"),
        ({"frequency": [805.0, 0.0]}, "frequency: is 0.0 and must be a number greater than 0"),
    ],
)
def test_modes_that_cannot_be_used_are_refused(changed: dict[str, Any], what: str) -> None:
    table = {key: value for key, value in (TABLE | changed).items() if value is not None}
    with pytest.raises(DeviceInvalid, match=what) as refused:
        stated_terms(device(terms=table).axis("x"))
    assert "x.terms.driven-modes" in str(refused.value)
