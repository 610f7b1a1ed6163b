"""A sensor or a mirror of one axis that also responds to the other axis."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from estimation.device_fit.predict import predict
from estimation.diagnosis.diagnose import diagnose
from estimation.estimate import estimate
from phantoms.forward import Plan, simulate
from phantoms.waveforms import Sine
from recon.report.effect_curve import effect_curve
from scanner.device import Device
from scanner.device_templates import KnownAxis, new_device
from scanner.recording import Recording
from scanner.terms import catalogue

CROSSTALK = 0.05
PLAN = Plan({"x": Sine(2000.0, 10.0), "y": Sine(835.0, 10.0)}, 0.05, 2e5, references=("angle",))
TEMPLATE = Device.from_toml(new_device("electromagnetic", {"x": KnownAxis(2000.0), "y": KnownAxis(835.0)}))


COMPARED = ("sensor-crosstalk", "cross-axis-coupling", "interference", "second-mode", "sensor-cubic", "feedthrough")


def stated(effect: str, **values: float) -> Device:
    """The device with an effect on x; its second channel, ``variant = 1``, is the angle."""
    axis = replace(TEMPLATE.axis("x"), terms={effect: values})
    return replace(TEMPLATE, axes=dict(TEMPLATE.axes) | {"x": axis})


def recorded(effect: str, **values: float) -> tuple[Recording, dict[str, object]]:
    return simulate(stated(effect, **values), PLAN, seed=3, nominal=TEMPLATE)


def without_angles(recording: Recording) -> Recording:
    kept = {name: channel for name, channel in recording.channels.items() if not name.startswith("angle")}
    return replace(recording, channels=kept)


@pytest.mark.parametrize(("variant", "channel", "gain"), [(0, "sense_x", 20.0), (1, "angle_x", 1.0)])
def test_a_channel_holds_a_fraction_of_that_of_the_other_axis(variant: int, channel: str, gain: float) -> None:
    recording, truth = recorded("sensor-crosstalk", c=CROSSTALK, variant=variant)
    x, y = (np.asarray(truth[f"angle_{name}"][0]) for name in "xy")  # type: ignore[index]
    noise = TEMPLATE.axis("x").require_readout().noise_sd if variant == 0 else 0.0  # type: ignore[union-attr]
    error = recording[channel].read() - gain * (x + CROSSTALK * y)
    assert np.std(error) < max(1.1 * noise, 1e-6)


def test_estimators_subtract_a_stated_crosstalk() -> None:
    recording, truth = recorded("sensor-crosstalk", c=CROSSTALK)
    angle, errors = np.asarray(truth["angle_x"][0]), []  # type: ignore[index]
    for device in (TEMPLATE, stated("sensor-crosstalk", c=CROSSTALK)):
        track = estimate(without_angles(recording), device, "sensor").axes["x"].angle
        errors.append(np.sqrt(np.nanmean((track.read(0, track.size) - angle) ** 2)))
    assert errors[1] < 0.1 * errors[0]


def test_an_axis_that_was_not_recorded_is_at_rest() -> None:
    recording, _ = recorded("sensor-crosstalk", c=CROSSTALK)
    alone = replace(recording, channels={name: recording[name] for name in ("drive_x", "sense_x")})
    nominal, with_crosstalk = (predict(alone, device) for device in (TEMPLATE, stated("sensor-crosstalk", c=CROSSTALK)))
    np.testing.assert_array_equal(with_crosstalk["sense_x"].values, nominal["sense_x"].values)


@pytest.mark.parametrize(
    ("effect", "size"),
    [("sensor-crosstalk", {"c": CROSSTALK}), ("cross-axis-coupling", {"kappa": 0.03 * TEMPLATE.axis("x").mechanics.k})],  # type: ignore[union-attr]
    ids=["sensor", "mirror"],
)
def test_crosstalk_of_the_sensor_and_coupling_of_the_mirror_are_named(effect: str, size: dict[str, float]) -> None:
    """The gain of the sensor is stated to 30 %. Around the fit of a coupling, nominal values seem to explain it."""
    recording, _ = recorded(effect, **size)
    others = [name for name in catalogue() if name not in COMPARED]
    found = diagnose([without_angles(recording)], excluded=others)
    (finding,) = found.findings
    assert (finding.effect, finding.axis) == (effect, "x")
    (parameter,) = finding.parameters
    low, high = parameter.ci95
    assert low < size[parameter.name] < high
    assert found.search is not None
    curve = effect_curve(found.search.final, found.search.final.model.candidates[0])
    assert curve is not None
    assert curve.x_label == "angle of the other axis (mrad)"


def test_a_sensor_that_is_rotated_against_the_axes_has_crosstalk_in_both() -> None:
    size = {"x": 0.035, "y": -0.035}
    rotated = {name: replace(TEMPLATE.axis(name), terms={"sensor-crosstalk": {"c": c}}) for name, c in size.items()}
    recording, _ = simulate(replace(TEMPLATE, axes=rotated), PLAN, seed=9, nominal=TEMPLATE)
    others = [name for name in catalogue() if name not in COMPARED]
    findings = diagnose([without_angles(recording)], excluded=others).findings
    assert {(finding.effect, finding.axis) for finding in findings} == {("sensor-crosstalk", name) for name in "xy"}
    for finding in findings:
        assert finding.parameters[0].value == pytest.approx(size[finding.axis], rel=0.01)
