"""A phase error is stated as a blur where the device has a field of view, and in degrees where it has none."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from estimation.device_fit.posterior import PredictionPhaseError
from recon.report import diagnosis
from recon.report.prediction_phase import (
    ANGLE_SCALE,
    PICTURE_SCALE,
    PhaseErrorScale,
    describe_largest_error,
    prediction_phase_section,
    scale_for,
)
from scanner import devices


def constant_error(before: float, after: float) -> PredictionPhaseError:
    """Phase errors [rad] that are the same at all times."""
    return PredictionPhaseError(np.linspace(0.0, 1e-3, 5), np.full(5, before), np.full(5, after), np.ones(5))


def test_a_device_with_a_field_of_view_has_its_errors_in_pixels() -> None:
    imaging = devices.find("imaging")
    assert imaging.scan is not None
    assert scale_for(imaging) is PICTURE_SCALE
    assert scale_for(replace(imaging, scan=None)) is ANGLE_SCALE


@pytest.mark.parametrize(
    ("scale", "stated"),
    [
        (PICTURE_SCALE, "motion is wrong by 4.0 px rms"),
        (ANGLE_SCALE, "phase of the nominal motion is wrong by 1.1°"),
    ],
)
def test_the_largest_error_is_stated_in_the_unit_of_the_device(scale: PhaseErrorScale, stated: str) -> None:
    errors = {"a, axis x": constant_error(0.001, 1e-5), "a, axis y": constant_error(0.02, 1e-4)}
    assert stated in describe_largest_error(errors, scale)
    section = prediction_phase_section(errors, scale)
    assert section.table is not None
    assert scale.unit in section.table.head[0]


def test_an_error_within_its_uncertainty_is_not_stated() -> None:
    assert describe_largest_error({"a, axis x": constant_error(0.001, 0.02)}, PICTURE_SCALE) == ""
    assert describe_largest_error({}, PICTURE_SCALE) == ""


def test_an_error_at_the_end_of_a_decay_is_no_error_of_the_motion() -> None:
    amplitude = np.exp(-np.arange(10.0))
    error = PredictionPhaseError(np.arange(10.0), np.linspace(0.0, 0.2, 10) ** 2, np.full(10, 1e-4), amplitude)
    assert "wrong by 0.023° rms" in describe_largest_error({"decay, axis x": error}, ANGLE_SCALE)


def test_recordings_of_one_name_have_their_own_phase_errors(monkeypatch: pytest.MonkeyPatch) -> None:
    runs = [SimpleNamespace(name=name, inputs=dict.fromkeys("xy")) for name in ("scan", "decay", "scan")]
    search = cast(Any, SimpleNamespace(nominal=None, likelihood=SimpleNamespace(runs=runs)))
    monkeypatch.setattr(diagnosis, "phase_error", lambda nominal, improved, axis, r: constant_error(float(r), 0.0))
    errors = diagnosis._phase_errors(search, cast(Any, None))
    names = [f"{name}, axis {axis}" for name in ("scan (1)", "decay", "scan (2)") for axis in "xy"]
    assert list(errors) == names
    assert [error.before[0] for error in errors.values()] == [0.0, 0.0, 1.0, 1.0, 2.0, 2.0]
