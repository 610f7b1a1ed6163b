"""The figures of the summary that combine several measurements."""

from dataclasses import replace

import numpy as np
import pytest

from recon.evaluation import Truth
from recon.imaging.picture import Grid
from recon.imaging.scan_phase.phase_error import PhaseError, PhaseEstimate
from recon.quality.defects import Defect
from recon.report.conclusions import describe_slices
from recon.report.fill_summary import seconds_to_fill
from recon.report.summary import picture_phase_error, spot_px
from recon.steps.reconstruction import Reconstruction
from tests.support.two_axis_scan import FIELD, RATE_HZ, READOUTS, SAMPLES, light, reconstruct, sensors

SLICES = 16


@pytest.fixture(scope="module")
def result() -> Reconstruction:
    return reconstruct({**sensors(0), "intensity": (light(0), "V", RATE_HZ)}, READOUTS + FIELD)


def slices(value: np.ndarray, sd: np.ndarray) -> list[PhaseError]:
    none = PhaseEstimate(float("nan"), float("inf"))
    return [PhaseError(float(k), PhaseEstimate(*each), none) for k, each in enumerate(zip(value, sd, strict=True))]


def coverage(scatter: float, determined: int) -> float:
    """Share of the means within 1.96 standard errors of the scan's mean, at a ``scatter`` between slices [rad]."""
    rng, inside = np.random.default_rng(0), []
    for _ in range(1000):
        true, sd = 0.02 + rng.normal(0.0, scatter, SLICES), rng.uniform(0.5e-3, 2e-3, SLICES)
        value = true + rng.normal(0.0, sd)
        sd[determined:] = np.inf
        mean = picture_phase_error(slices(value, sd), "x")
        inside.append(abs(mean["value"] - np.degrees(true.mean())) < 1.96 * mean["sd"])
    return float(np.mean(inside))


@pytest.mark.parametrize("scatter", [0.0, 0.01])
@pytest.mark.parametrize("determined", [SLICES, SLICES // 2])
def test_the_mean_of_slices_holds_that_of_the_scan_as_often_as_it_states(scatter: float, determined: int) -> None:
    """With an estimated scatter of seven degrees of freedom, the normal interval holds 91 %."""
    assert 0.88 < coverage(scatter, determined) < 0.98


def test_slices_that_differ_beyond_their_errors_are_named_beside_the_mean() -> None:
    apart = picture_phase_error(slices(np.array([0.05, -0.03, 0.07]), np.full(3, 2e-3)), "x")
    assert describe_slices(apart) == " (mean; slices of the scan differ by 3°, 1 sd)"
    agree = picture_phase_error(slices(np.array([0.050, 0.053, 0.047]), np.full(3, 2e-3)), "x")
    assert agree["scatter"] == 0.0
    assert describe_slices(agree) == ""


def test_the_spot_of_a_simulation_is_round_on_the_sample(result: Reconstruction) -> None:
    picture = replace(result.picture, grid=Grid(200, 300, 0.1, 0.05))  # pixels are three times as wide as high
    simulated = replace(result, picture=picture, truth=Truth({}, None, 0.01))
    assert spot_px(simulated, "x") == pytest.approx(2.0)
    assert spot_px(simulated, "y") == pytest.approx(6.0)
    assert spot_px(replace(simulated, spot=0.7), "y") == 0.7
    assert spot_px(result, "y") == 0.0


def test_samples_that_are_not_mapped_fill_no_pixel(result: Reconstruction) -> None:
    """The first half of the scan has no intensity, or no phase."""
    half_s = 0.5 * SAMPLES / RATE_HZ
    assert seconds_to_fill(result)["0.5"] < half_s
    dark = replace(result, defects=[Defect("intensity", "gap", 0.0, half_s)])
    assert seconds_to_fill(dark)["0.5"] > half_s
    x = result.motion.axes["x"]
    unknown = replace(x, phase_sd=np.where(x.time < half_s, np.inf, x.phase_sd))
    motion = replace(result.motion, axes={**result.motion.axes, "x": unknown})
    lost = replace(result, motion=motion, defects=[Defect("sense_x", "gap", 0.0, half_s)])
    assert seconds_to_fill(lost)["0.5"] > half_s
