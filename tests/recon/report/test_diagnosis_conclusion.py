"""What a diagnosis says about the device that it writes."""

from typing import Any

import pytest

from recon.cli.diagnose import format_summary
from recon.report.diagnosis_conclusion import conclude_diagnosis

CORRECTED, NOMINAL = "Use the corrected device.toml", "device.toml is the nominal device"


def found(effect: str, probability: float, *rivals: tuple[str, float]) -> dict[str, Any]:
    """A finding in the mechanics of x, as in diagnosis.json."""
    return {
        "axis": "x", "stage": "mechanics", "effect": effect, "parameters": [], "channel": "sense",
        "probability": probability, "rivals": [{"effect": name, "probability": p} for name, p in rivals],
    }  # fmt: skip


def open_loop(rmse: float) -> dict[str, float]:
    """The error of an open-loop prediction of a signal of 3 V, as in diagnosis.json."""
    return {"rmse": rmse, "fraction": rmse / 3.0}


@pytest.mark.parametrize("verdict", ["consistent", "mismatch"])
def test_the_error_of_the_corrected_device_is_stated_beside_the_nominal_one(verdict: str) -> None:
    findings = [found("cubic-stiffness", 0.98)] if verdict == "mismatch" else []
    loops = {"sense_x": {"nominal": open_loop(0.9), "improved": open_loop(0.06)}}
    text = conclude_diagnosis({"verdict": verdict, "findings": findings, "open_loop": loops})
    assert "an error of 2% of sense_x (nominal 30%)." in text
    assert "e+" not in text


@pytest.mark.parametrize(
    ("improved", "channel", "text"), [(0.2, "sense", CORRECTED), (0.9, "sense", NOMINAL), (0.9, "intensity", CORRECTED)]
)
def test_a_device_that_is_not_corrected_is_not_recommended(improved: float, channel: str, text: str) -> None:
    finding = found("unknown", 1.0) | {"channel": channel}
    loops = {"sense_x": {"nominal": open_loop(0.9), "improved": open_loop(improved)}}
    assert text in conclude_diagnosis({"verdict": "mismatch", "findings": [finding], "open_loop": loops})


def test_what_was_not_tested_is_said_and_nothing_else_of_it() -> None:
    content = {"verdict": "consistent", "findings": [], "untested": "the picture, because it cannot be made"}
    text = conclude_diagnosis(content)
    assert text.endswith("Not tested: the picture, because it cannot be made.")
    assert "pictures agree" not in text


def test_the_share_of_the_misfit_that_is_left_is_stated_with_its_stage() -> None:
    rest = {"share": 0.078, "stage": "mechanics", "channel": "angle_x"}
    unexplained = "samples are missed by 4.8 times the noise"
    content = {"verdict": "mismatch", "unexplained": unexplained, "remainder": rest}
    text = conclude_diagnosis({**content, "findings": [found("quintic-stiffness", 0.97)]})
    assert text.endswith(
        " Not explained: samples are missed by 4.8 times the noise; 7.8% of the nominal misfit of angle_x are left, "
        "and a change of the mechanics would take most of it."
    )
    assert "nominal misfit of angle_x" not in conclude_diagnosis({**content, "findings": []})


def test_a_measured_law_of_the_remainder_is_stated() -> None:
    rest = {"share": 0.03, "stage": "readout", "channel": "sense_x"}
    content = {"verdict": "mismatch", "unexplained": None, "findings": [found("cubic-stiffness", 0.97)]}
    sentence = "It also has a measured law of the readout."
    assert sentence in conclude_diagnosis({**content, "remainder": {**rest, "in_device": True}})
    assert sentence not in conclude_diagnosis({**content, "remainder": {**rest, "in_device": False}})


@pytest.mark.parametrize(("share", "leads"), [(0.4, False), (0.98, True)])
def test_a_remainder_of_more_than_half_of_the_misfit_leads_the_conclusion(share: float, leads: bool) -> None:
    rest = {"share": share, "stage": "drive", "channel": "sense_x"}
    content = {"verdict": "mismatch", "remainder": rest, "findings": [found("feedthrough", 0.999)]}
    above_noise = conclude_diagnosis({**content, "unexplained": "samples are missed by 4.8 times the noise"})
    start = "Most of the difference between recording and nominal device"
    assert above_noise.startswith(f"{start} is not explained.") == leads
    near_noise = conclude_diagnosis({**content, "unexplained": None})
    assert near_noise.startswith(f"{start} with fitted values, which is near the noise, is not explained.") == leads


def test_hum_that_is_stronger_than_the_noise_is_stated() -> None:
    hum = {"sense": {"frequency": 49.987, "rms": 0.021, "relative": 10.6}}
    text = conclude_diagnosis({"verdict": "consistent", "findings": [], "hum": hum})
    assert text.endswith(" sense has mains hum of 49.99 Hz, 11 times as strong as noise; it is taken as noise.")


def test_an_effect_that_is_less_probable_than_another_explanation_is_not_asserted() -> None:
    doubtful = found("second-mode", 0.22, ("unknown", 0.78))
    text = conclude_diagnosis({"verdict": "mismatch", "findings": [found("cubic-stiffness", 0.98), doubtful]})
    assert "The nominal device lacks cubic-stiffness in the mechanics of axis x. " in text
    assert "It may lack second-mode in the mechanics of axis x, with a probability of 22% (unknown: 78%)." in text
    alone = conclude_diagnosis({"verdict": "mismatch", "findings": [doubtful]})
    assert alone.startswith("The nominal device may lack second-mode")


def test_the_stage_in_which_an_unknown_effect_may_be_instead_is_named() -> None:
    rival = {"effect": "unknown", "probability": 0.2, "stage": "timing"}
    text = conclude_diagnosis({"verdict": "mismatch", "findings": [found("unknown", 0.8) | {"rivals": [rival]}]})
    assert "with a probability of 80% (unknown in other stages, the timing above all: 20%)." in text
    unlikely = found("unknown", 0.01) | {"rivals": [rival | {"probability": 0.99}]}
    text = conclude_diagnosis({"verdict": "mismatch", "findings": [unlikely]})
    assert "lacks several effects that are not in the catalogue, in the timing above all (99%); a single one" in text


def test_the_error_of_a_prediction_is_stated_beside_a_finding() -> None:
    content = {"verdict": "mismatch", "findings": [found("second-mode", 0.98)]}
    assert " Predicted from the drive alone, it is wrong." in conclude_diagnosis(
        content, "Predicted from the drive alone, it is wrong."
    )


@pytest.mark.parametrize(("probability", "verb"), [(0.97, "lacks "), (0.52, "probably lacks "), (0.3, "may lack ")])
def test_a_name_is_asserted_as_far_as_it_is_probable(probability: float, verb: str) -> None:
    finding = found("viscoelastic", probability, ("unknown", 1.0 - probability))
    text = conclude_diagnosis({"verdict": "mismatch", "findings": [finding]})
    assert text.startswith(f"The nominal device {verb}viscoelastic")
    assert (f"with a probability of {probability:.0%}" in text) is (probability < 0.9)


@pytest.mark.parametrize(("rmse", "useless"), [(4.5, True), (0.3, False)])
def test_a_prediction_that_misses_the_signal_is_called_so(rmse: float, useless: bool) -> None:
    loops = {"sense_x": {"nominal": open_loop(9.0), "improved": open_loop(rmse)}}
    text = conclude_diagnosis({"verdict": "mismatch", "findings": [found("unknown", 1.0)], "open_loop": loops})
    assert ("That is no better than no prediction of sense_x." in text) is useless


@pytest.mark.parametrize(
    ("pulls", "stated"),
    [
        (
            {"x.capacitance.C0": 7.65, "x.readout.R_s": 3.31, "x.mechanics.b": -0.12, "x.capacitance.theta0": -2.91},
            True,
        ),
        ({"x.capacitance.C0": 2.4, "x.readout.R_s": 1.1, "x.mechanics.b": -1.2, "x.capacitance.theta0": -0.4}, False),
        ({}, False),
    ],
)
def test_values_far_outside_their_tolerances_are_named(pulls: dict[str, float], stated: bool) -> None:
    nominal = {name: {"pull": pull} for name, pull in pulls.items()}
    text = conclude_diagnosis({"verdict": "mismatch", "findings": [found("unknown", 1.0)], "nominal": nominal})
    listed = "x.capacitance.C0 by 7.7, x.readout.R_s by 3.3, x.capacitance.theta0 by −2.9 tolerances"
    assert (listed in text) == stated
    assert ("Check that the device file belongs to this device" in text) == stated


def test_an_alternative_that_was_not_compared_is_not_called_improbable() -> None:
    finding = found("cubic-damping", 0.998, ("damping-drift", 0.002), ("gain-drift", 0.0)) | {
        "heldout": {"metric": "error", "before": 0.1, "after": 0.01}
    }
    summary = {"verdict": "mismatch", "conclusion": "", "findings": [finding], "unexplained": None, "output": "out"}
    lines = format_summary(summary).splitlines()
    assert "    alternative: damping-drift (0.2 %)" in lines
    assert "    not excluded by this recording: gain-drift" in lines
