"""Values of terms that a device file states are checked: one line names the file, the key and what is wrong."""

from collections.abc import Mapping
from dataclasses import replace

import pytest

from phantoms.forward import Plan, simulate
from phantoms.waveforms import Sine
from scanner import devices
from scanner.active_terms import check_effects, stated_terms
from scanner.device import Device
from scanner.errors import DeviceInvalid
from scanner.stages import Drive, Position
from scanner.terms import catalogue

POSITIVE = "must be a number greater than 0"
DEVICE = devices.load("imaging").to_toml()


def stated(effect: str, values: str) -> None:
    stated_terms(Device.from_toml(f"{DEVICE}\n[x.terms.{effect}]\n{values}\n", "dev.toml").axis("x"))


@pytest.mark.parametrize(
    ("effect", "values", "key", "what"),
    [
        ("readout-lag", "f_c = 0.0", "f_c", POSITIVE),
        ("drive-lag", "f_c = 0.0", "f_c", POSITIVE),
        ("charging", "V_c = 1.0\ntau = 0.0", "tau", POSITIVE),
        ("charging", "V_c = 1.0\ntau = -1e-3", "tau", POSITIVE),
        ("viscoelastic", "k_v = 1e-9\ntau_v = 0.0", "tau_v", POSITIVE),
        ("resonance-drift", "alpha = 0.01\ntau = -1e-3", "tau", POSITIVE),
        ("coulomb-friction", "tau_c = 1e-12\nomega_s = 0.0", "omega_s", POSITIVE),
        ("second-mode", "c = 0.01\nf2 = 1e3\nQ2 = 0.0", "Q2", POSITIVE),
        ("gain-drift", "g = 0.1\nT = 0.0", "T", POSITIVE),
        ("feedthrough", "g = 0.1\nh = 0.1\nomega_d = 0.0", "omega_d", POSITIVE),
        ("bleaching", "tau = 0.0", "tau", POSITIVE),
        ("saturation", "limit = -0.05", "limit", POSITIVE),
        ("saturation", "limit = 0.05\nvariant = 0.7", "variant", "must be a whole number, 0 or greater"),
        ("saturation", "limit = 0.05\nvariant = 'upper'", "variant", "must be a whole number, 0 or greater"),
        ("saturation", "limit = 0.05\nvariant = 3", "variant", "known are 0: sense, 1: sense:upper, 2: sense:lower"),
        ("cubic-stiffness", "k3 = 'a'", "k3", "must be a finite number"),
    ],
)
def test_a_value_without_a_meaning_is_refused_in_one_line(effect: str, values: str, key: str, what: str) -> None:
    with pytest.raises(DeviceInvalid) as refused:
        stated(effect, values)
    assert str(refused.value).startswith(f"dev.toml: x.terms.{effect}.{key}: is ")
    assert what in str(refused.value)
    assert "\n" not in str(refused.value)


def test_one_rail_clips_at_a_level_of_any_sign() -> None:
    stated("saturation", "limit = -0.05\nvariant = 1")


def test_more_terms_of_the_torque_than_the_integrator_takes_are_refused() -> None:
    effects: Mapping[str, dict[str, float]] = {
        "cubic-stiffness": {"k3": 1e-9},
        "quintic-stiffness": {"k5": 1e-9},
        "quadratic-stiffness": {"k2": 1e-9},
        "quadratic-drag": {"b2": 1e-18},
        "cubic-damping": {"b3": 1e-18},
    }
    axis = devices.load("imaging").axis("x")
    stated_terms(replace(axis, terms=dict(list(effects.items())[:4])))
    with pytest.raises(DeviceInvalid, match=r"x\.terms: states 5 effects on the torque, and at most 4"):
        stated_terms(replace(axis, terms=effects))


@pytest.mark.parametrize("term", catalogue().values(), ids=lambda term: term.effect)
def test_every_term_accepts_positive_values(term) -> None:  # type: ignore[no-untyped-def]
    values = {parameter.name: 1.0 for parameter in term.parameters}
    axis = replace(devices.load("imaging").axis("x"), terms={term.effect: values})
    assert stated_terms(axis)[0].values == tuple(values.values())


@pytest.mark.parametrize(
    ("effect", "values", "what"),
    [
        ("square-law", {"w": 3e10}, "on a position readout"),
        ("filter-lag", {"s": 1.1}, "on a position readout"),
        ("profile-shape", {"a": 0.1}, "without a capacitance"),
        ("sensor-crosstalk", {"c": 0.1}, "in a device with one axis"),
        ("cross-axis-coupling", {"kappa": 1e-8}, "in a device with one axis"),
    ],
)
def test_a_term_without_an_effect_is_refused_in_one_line(effect: str, values: dict[str, float], what: str) -> None:
    """It was accepted, and changed nothing."""
    imaging = devices.load("imaging")
    axis = replace(imaging.axis("x"), terms={effect: values})
    check_effects(replace(imaging, axes={**imaging.axes, "x": axis}))
    bare = replace(axis, capacitance=None, drive=Drive("linear", 1e-9), readout=Position(10.0, 1e-3))
    with pytest.raises(DeviceInvalid, match=rf"x\.terms\.{effect}: has no effect {what}; remove the term"):
        check_effects(Device("stage", {"x": bare}))
    plan = Plan({"x": Sine(15_500.0, 1.0)}, 0.001, 1e6)
    with pytest.raises(DeviceInvalid, match="has no effect"):
        simulate(Device("stage", {"x": bare}), plan)
