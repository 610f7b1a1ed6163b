"""The sentence at the start of a report."""

from dataclasses import replace

import numpy as np
import pytest

from recon.pipeline import reconstruct
from recon.report.conclusions import conclude_fleet, conclude_prediction, conclude_study
from recon.report.picture_conclusion import conclude_reconstruction
from recon.report.summary import summarise
from recon.steps.reconstruction import Options
from tests.support.simulated import imaging


def conclude(intensity: np.ndarray) -> str:
    recording = imaging()[0]
    recording = recording.with_channel(replace(recording["intensity"], raw=intensity, gain=1.0, offset=0.0))
    return conclude_reconstruction(summarise(reconstruct(recording, Options(pixels=(100, 100)), quiet=True)))


def test_only_a_picture_that_shows_its_scene_is_called_sharp() -> None:
    light = imaging()[0]["intensity"].read()
    assert conclude(light).startswith("The picture is sharp")
    saturated = conclude(np.minimum(light, np.quantile(light, 0.3)))
    assert "the detector is saturated" in saturated.split(". ")[0]
    noise = np.random.default_rng(0).normal(1.0, 0.1, light.size)
    assert conclude(noise).startswith("intensity: no structure beyond the noise")
    assert "The motion alone would give a picture that is" in saturated
    for text in (saturated, conclude(noise)):
        assert "The picture is" not in text


def test_an_estimator_that_blurs_every_picture_is_not_recommended() -> None:
    def conclude_single(error_deg: float, within: float) -> str:
        statistics = {"phase_rmse_deg_median": error_deg, "within_bound": within}
        return conclude_study({"cells": 1, "failed": 0, "estimators": {"tracker": statistics}})

    assert conclude_single(0.01, 1.0).startswith("Use tracker: its phase error is the smallest")
    assert conclude_single(97.9, 0.05).startswith("No estimator is accurate enough")


def test_a_prediction_as_far_off_as_none_is_no_prediction() -> None:
    def conclude_single(nrmse: float) -> str:
        channel = {"nrmse": nrmse, "rmse": 0.1, "unit": "V", "noise_sd": 0.1}
        return conclude_prediction({"device": "mirror", "terms": {}, "channels": {"sense_x": channel}})

    assert "predicts the channel with an error of 5% of the signal" in conclude_single(0.05)
    assert "with an error of 100% of the signal" in conclude_single(0.999)
    assert "does not predict sense_x: they differ by 2 times the signal" in conclude_single(2.0)


@pytest.mark.parametrize("terms", [{}, {"x": ["cubic-stiffness"]}])
def test_a_device_without_found_laws_is_to_be_diagnosed(terms: dict[str, list[str]]) -> None:
    channel = {"nrmse": 0.05, "rmse": 0.4, "unit": "V", "noise_sd": 0.1}
    text = conclude_prediction({"device": "mirror", "terms": terms, "channels": {"sense_x": channel}})
    assert "4.0 times its noise." in text
    assert ("Run lissajous diagnose" in text) is not bool(terms)


@pytest.mark.parametrize(
    ("effects", "stated"),
    [
        ("a a", "The most frequent is x a, in 2."),
        ("a b", "No effect occurs in more than one."),
        ("ab ab", "The most frequent are x a and x b, in 2."),
        ("a", "1 of 1 recording shows effects that the nominal device omits."),
    ],
)
def test_an_effect_is_called_the_most_frequent_only_where_it_is(effects: str, stated: str) -> None:
    rows = [
        {"recording": str(number), "axis": "x", "effect": effect}
        for number, found in enumerate(effects.split())
        for effect in found
    ]
    assert conclude_fleet({"table": rows, "failed": 0}).endswith(stated)
