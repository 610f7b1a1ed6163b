"""A law without a name in a device file: it moves the mirror as a named law does, and is straight beyond its range."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from scanner.active_terms import stated_terms
from scanner.device import Device
from scanner.errors import DeviceInvalid
from scanner.forward_model import DriveInput, simulate_axis
from scanner.terms import catalogue
from scanner.terms.measured_law import added, beyond, measured_law, polynomial

TABLE: dict[str, Any] = {
    "stage": "mechanics", "variables": ["angle", "rate"], "centre": [0.0, 0.0],
    "lower": [-1.0, -10.0], "upper": [1.0, 10.0],
    "powers": [[3, 0], [2, 1]], "coefficients": [-19.0, 0.05], "coefficients_sd": [0.1, 0.01],
}  # fmt: skip
READOUT: dict[str, Any] = {
    "stage": "readout", "variables": ["signal"], "centre": [0.0], "lower": [0.0], "upper": [2.0],
    "powers": [[2]], "coefficients": [0.1],
}  # fmt: skip
NAMED = {"cubic-stiffness": {"k3": -19.0}, "cubic-damping": {"b3": 0.05}}
BARE = """
name = "pendulum"
[x.mechanics]
J = 1.0
b = 0.5
k = 114.0
[x.readout]
kind = "position"
gain = 1.0
noise_sd = 0.001
"""


def device(terms: dict[str, Any]) -> Device:
    bare = Device.from_toml(BARE)
    return replace(bare, axes={"x": replace(bare.axis("x"), terms=terms)})


def angle(of: Device, start: float) -> np.ndarray:
    axis = of.axis("x")
    return simulate_axis(axis, stated_terms(axis), DriveInput(np.zeros((600, 3)), 5e-3), (start, 0.0)).angle


def test_a_device_file_keeps_a_measured_law() -> None:
    made = device({"measured-law": TABLE})
    assert Device.from_toml(made.to_toml()) == made
    assert "measured-law" not in catalogue()


def test_a_measured_law_moves_the_mirror_as_the_named_laws_do() -> None:
    assert angle(device({"measured-law": TABLE}), 0.8) == pytest.approx(angle(device(NAMED), 0.8), abs=1e-12)


def test_beyond_its_range_a_measured_law_continues_with_the_slope_at_the_edge() -> None:
    table = READOUT | {"centre": [0.5]}
    values = np.array([0.0, 0.5, 2.0, 3.0, -1.0])
    _, packed = measured_law(table)
    assert added(values, packed) == pytest.approx([0.025, 0.0, 0.225, 0.225 + 0.3, 0.025 + 0.1])
    assert beyond(table, [values]) == pytest.approx(0.4)


def test_a_table_adds_to_the_polynomial_and_continues_with_the_slope_of_its_last_piece() -> None:
    table = TABLE | {
        "stage": "drive", "variables": ["voltage"], "centre": [0.0], "lower": [-2.0], "upper": [2.0],
        "powers": [[1]], "coefficients": [-0.1], "knots": [-2.0, -0.5, 0.5, 2.0], "knot_values": [0.4, 0.1, -0.1, -0.1],
    }  # fmt: skip
    values = np.array([-3.0, -2.0, 0.0, 1.0, 3.0])
    _, packed = measured_law(table)
    assert added(values, packed) == pytest.approx(-0.1 * values + np.array([0.6, 0.4, 0.0, -0.1, -0.1]))
    made = device({"measured-law": table})
    assert Device.from_toml(made.to_toml()) == made


def test_beyond_the_ellipse_of_its_range_a_law_of_two_variables_continues_along_the_radius() -> None:
    """The polynomial is rate² times angle; in a corner of the box around the ellipse no sample was measured."""
    table = TABLE | {"powers": [[1, 2]], "coefficients": [1.0]}
    _, packed = measured_law(table)
    on_edge = np.sqrt(0.5) * np.array([1.0, 10.0])
    value, slope = on_edge[0] * on_edge[1] ** 2, 3.0 * on_edge[0] * on_edge[1] ** 2
    for radius in (0.5, 1.0):
        assert polynomial(np.array(packed), *(radius * on_edge)) == pytest.approx(radius**3 * value)
    for radius in (1.4, 3.0):
        assert polynomial(np.array(packed), *(radius * on_edge)) == pytest.approx(value + slope * (radius - 1.0))
    angle, rate = np.array([0.0, 1.0, 0.9, 0.0, np.inf]), np.array([10.0, 0.0, 9.0, 11.0, 0.0])
    assert beyond(table, [angle, rate]) == pytest.approx(0.6)


def test_a_law_that_does_no_work_over_a_turn_does_none_beyond_its_range() -> None:
    """In the corners of the box around the ellipse, which no turn reaches, the slope of this law is that of a motor."""
    rate = np.sqrt(114.0)
    table = TABLE | {
        "lower": [-1.0, -rate], "upper": [1.0, rate],
        "powers": [[0, 5], [2, 3]], "coefficients": [0.24 / rate**4, -1.2 / rate**2],
    }  # fmt: skip
    swing, damped = angle(device({"measured-law": table}), 2.5), angle(device({}), 2.5)
    assert np.abs(swing[-120:]).max() == pytest.approx(np.abs(damped[-120:]).max(), rel=0.02)


@pytest.mark.parametrize(
    ("changed", "what"),
    [
        ({"stage": "timing"}, "stage 'timing'"),
        ({"stage": ["readout"]}, "stage "),
        ({"powers": [[3, 0]]}, "powers: is .* one list of powers a coefficient"),
        (READOUT | {"powers": 2}, "powers: is 2 and must be a list"),
        (READOUT | {"powers": [2]}, "powers: is 2 and must be a list"),
        (READOUT | {"powers": [[-1]]}, "powers: is -1 and must be a whole number, 0 or greater"),
        (READOUT | {"powers": [[1.9]]}, "powers: is 1.9 and must be a whole number, 0 or greater"),
        (READOUT | {"centre": 0.0}, "centre: is 0.0 and must be a list of numbers"),
        (READOUT | {"centre": [0.0, 0.0]}, "centre: has 2 numbers and must have 1"),
        (READOUT | {"lower": [1.0], "upper": [-1.0]}, "upper: is .* and must not be below lower"),
        (READOUT | {"coefficients": 0.1}, "coefficients: is 0.1 and must be a list"),
        (READOUT | {"coefficients": ["a"]}, "coefficients: is 'a' and must be a finite number"),
        (READOUT | {"coefficients": [float("nan")]}, "coefficients: is nan and must be a finite number"),
        (READOUT | {"knots": [0.0, 1.0], "knot_values": [float("nan"), 1.0]}, "knot_values: is nan"),
        ({"coefficients": None}, "lacks"),
        ({"knots": [0.0, 1.0], "knot_values": [0.0, 1.0]}, "table"),
        (READOUT | {"knots": [0.0, 1.0, 1.0], "knot_values": [0.0, 1.0, 2.0]}, "table"),
        (READOUT | {"knots": [0.0, 1.0], "knot_values": [0.0]}, "table"),
        (READOUT | {"knots": [0.0], "knot_values": [0.0]}, "table"),
    ],
)
def test_a_measured_law_that_cannot_be_used_is_refused(changed: dict[str, Any], what: str) -> None:
    table = {key: value for key, value in (TABLE | changed).items() if value is not None}
    with pytest.raises(DeviceInvalid, match=what) as refused:
        stated_terms(device({"measured-law": table}).axis("x"))
    assert "x.terms.measured-law" in str(refused.value)
