"""The scores of blind recordings, computed from diagnoses written for the tests."""

from __future__ import annotations

import json
import stat
import sys

import numpy as np
import pytest

from benchmarks.blind import score
from benchmarks.blind.by_family import (
    family_table,
    has_false_alarm,
    lower_bound,
    named_right,
    stage_right,
    summarise,
    summarise_families,
    upper_bound,
)
from benchmarks.blind.imaging import intensity
from benchmarks.blind.imaging_score import score_motion
from benchmarks.blind.outcome import Outcome, normalise_key
from benchmarks.blind.table import both_named, intervals_hit, markdown, share, summary


def key(kind="one", effects=(), coloured=False, angle=True):
    return {"kind": kind, "family": "ring", "coloured": coloured, "angle": angle, "effects": list(effects)}


def target(name="cubic-stiffness", stage="mechanics", sigma=50.0, distance=10.0, **parameters):
    return {"effect": name, "stage": stage, "listed": True, "sigma": sigma, "distance": distance,
            "nearest": "quintic-stiffness", "parameters": parameters}  # fmt: skip


def finding(name="cubic-stiffness", stage="mechanics", rivals=(), after=1.01, **intervals):
    parameters = [{"name": n, "value": sum(ci) / 2, "ci95": list(ci), "unit": ""} for n, ci in intervals.items()]
    return {"axis": "x", "stage": stage, "effect": name, "parameters": parameters, "probability": 0.9,
            "rivals": [{"effect": rival, "probability": 0.1} for rival in rivals],
            "heldout": {"metric": "", "before": 9.0, "after": after}}  # fmt: skip


def diagnosis_of(*found):
    return {"schema": "lissajous-diagnosis/1", "verdict": "mismatch" if found else "consistent",
            "findings": list(found), "unexplained": None}  # fmt: skip


def run(key, diagnosis, failure=""):
    return Outcome("blind-001", key, diagnosis, 12.0, failure)


def rate_of(name, *runs):
    return summary(runs)["rates"][name]


def test_the_stage_must_be_right_if_confounders_of_other_stages_are_distant():
    rivals = {"viscoelastic": 1.0, "drive-lag": 2.0}, {"viscoelastic": 1.0, "drive-lag": 7.0}
    runs = [
        run(key(effects=[target() | {"rivals": each}]), diagnosis_of(finding("drive-lag", "drive"))) for each in rivals
    ]
    assert rate_of("right stage, visible", *runs)["of"] == 2
    assert rate_of("right stage, confounders of other stages clear", *runs) == share(0, 1)


def test_false_alarms_are_counted_separately_for_white_and_coloured_noise():
    quiet, alarm = diagnosis_of(), diagnosis_of(finding())
    runs = [run(key("none"), quiet), run(key("none"), alarm), run(key("none", coloured=True), quiet)]
    assert rate_of("false alarm, white noise", *runs)["rate"] == 0.5
    assert rate_of("false alarm, coloured noise", *runs)["rate"] == 0.0


def test_a_failed_run_counts_as_an_error():
    failed = run(key("none"), None, "more than 600 s")
    assert rate_of("false alarm, white noise", failed)["rate"] == 1.0
    assert summary([failed])["failures"] == {"blind-001": "more than 600 s"}


def test_clear_effects_must_be_named_uniquely_and_visible_ones_within_their_class():
    near = run(
        key(effects=[target(distance=2.0)]), diagnosis_of(finding("quintic-stiffness", rivals=["cubic-stiffness"]))
    )
    far = run(key(effects=[target()]), diagnosis_of(finding()))
    unseen = run(key(effects=[target(sigma=1.0, distance=0.5)]), diagnosis_of())
    runs = near, far, unseen
    assert rate_of("right name, one effect, clear", *runs) | {"ci95": None} == {"of": 1, "rate": 1.0, "ci95": None}
    assert rate_of("right name, one effect, any", *runs)["rate"] == pytest.approx(1 / 3)
    assert rate_of("named class holds the truth, visible", *runs) | {"ci95": 0} == {"of": 2, "rate": 1.0, "ci95": 0}
    assert rate_of("right stage, visible", *runs)["rate"] == 1.0


def test_both_of_two_effects_must_be_named():
    two = key("two", [target(), target("gain-drift", "readout")])
    assert both_named(run(two, diagnosis_of(finding("gain-drift", "readout"), finding())))
    assert not both_named(run(two, diagnosis_of(finding())))


def test_an_unlisted_effect_must_be_unknown_in_its_stage():
    injected = key("unlisted", [target("play-in-readout", "readout")])
    right, misplaced = diagnosis_of(finding("unknown", "readout")), diagnosis_of(finding("unknown", "mechanics"))
    runs = [run(injected, right), run(injected, misplaced), run(injected, diagnosis_of(finding()))]
    assert rate_of("unknown and right stage, unlisted, any", *runs)["rate"] == pytest.approx(1 / 3)
    assert rate_of("unknown, unlisted, any stage", *runs)["rate"] == pytest.approx(2 / 3)


def test_intervals_are_compared_with_the_truth_by_either_name():
    assert intervals_hit(run(key(effects=[target(k3=2.0)]), diagnosis_of(finding(k3=(1.0, 3.0))))) == [True]
    assert intervals_hit(run(key(effects=[target(k3=4.0)]), diagnosis_of(finding(k3=(1.0, 3.0))))) == [False]
    drift = key(effects=[target("resonance-drift", dk=0.01, tau=1.0)])
    assert intervals_hit(run(drift, diagnosis_of(finding("resonance-drift", alpha=(0.0, 0.02), tau=(2.0, 3.0))))) == [
        True,
        False,
    ]
    assert intervals_hit(run(drift, diagnosis_of(finding("cubic-stiffness", alpha=(0.0, 0.02))))) == []


@pytest.mark.parametrize(("angle", "holds"), [(False, True), (True, False)])
def test_an_indeterminate_sign_is_ignored(angle, holds):
    injected = key(effects=[target("comb-offset", "capacitance", theta_c=-0.005)], angle=angle)
    assert intervals_hit(
        run(injected, diagnosis_of(finding("comb-offset", "capacitance", theta_c=(0.004, 0.006))))
    ) == [holds]


def test_fractions_have_wilson_intervals():
    low, high = share(95, 100)["ci95"]
    assert (low, high) == pytest.approx((0.8883, 0.9785), abs=1e-3)
    assert share(0, 0)["rate"] is None


def test_a_key_of_one_effect_without_a_distance_is_accepted():
    old = {"family": "ring", "effect": "cubic-stiffness", "stage": "mechanics", "parameters": {}, "coloured": False}
    assert normalise_key(old)["effects"][0]["effect"] == "cubic-stiffness"
    assert normalise_key(old | {"effect": "none", "stage": None})["kind"] == "none"
    named = run(normalise_key(old), diagnosis_of(finding()))
    assert rate_of("right name, one effect, clear", named)["rate"] == 1.0


@pytest.mark.slow
def test_the_score_command_writes_score_and_page(tmp_path):
    """A substitute for the command line names one effect correctly, fails on one recording and hangs on another."""
    tool = tmp_path / "tool"
    tool.write_text(
        f"#!{sys.executable}\nimport json, pathlib, sys, time\n"
        "_, verb, recording, o, out, as_json = sys.argv\n"
        "assert (verb, o, as_json) == ('diagnose', '-o', '--json')\n"
        "name = pathlib.Path(recording).stem\n"
        "if name == 'c': time.sleep(60)\n"
        "if name == 'b': sys.exit('the sense channel is empty')\n"
        f"pathlib.Path(out, 'diagnosis.json').write_text({json.dumps(diagnosis_of(finding()))!r})\n"
    )
    tool.chmod(tool.stat().st_mode | stat.S_IXUSR)
    keys = {name: key(effects=[target()]) for name in "abc"}
    (tmp_path / "keys.json").write_text(json.dumps(keys))
    out = tmp_path / "out"
    table = tmp_path / "blind_benchmark.md"
    table.write_text(f"before\n{score.BEGIN}old\n{score.END}\nafter\n")
    arguments = [str(tmp_path), str(tmp_path / "keys.json"), str(out), "--command", str(tool), "--timeout", "3"]
    arguments += ["--page", str(table)]
    assert score.main(arguments) == 0
    result = json.loads((out / "score.json").read_text())
    assert result["rates"]["right name, one effect, clear"]["rate"] == pytest.approx(1 / 3)
    assert result["failures"] == {"b": "exit 1: the sense channel is empty", "c": "more than 3 s"}
    assert result["confusion"] == {"cubic-stiffness": {"failed": 2, "cubic-stiffness": 1}}
    assert result["heldout"] == {"before": 9.0, "after": 1.01}
    page = (out / "score.md").read_text()
    assert "| right name, one effect, clear | 33.3% |" in page
    assert page == markdown(result) + "\n" + family_table(result["families"])
    assert table.read_text() == f"before\n{score.BEGIN}\n{page}\n{score.END}\nafter\n"
    tool.unlink()
    assert score.main(arguments) == 0  # finished recordings are not run again
    assert json.loads((out / "score.json").read_text()) == result


# --- Rates by family.


def test_bounds_are_clopper_and_pearsons() -> None:
    """Rule of three: none of n has the upper bound 1 - 0.05^(1/n)."""
    assert upper_bound(0, 400) == pytest.approx(1 - 0.05 ** (1 / 400))
    assert lower_bound(400, 400) == pytest.approx(0.05 ** (1 / 400))
    assert upper_bound(3, 3) == 1.0
    assert lower_bound(0, 3) == 0.0


def imaging_key(*effects):
    return key(effects=effects) | {"family": "imaging"}


def in_axis(entry, axis):
    return entry | {"axis": axis}


def test_a_stated_drift_beside_the_concealed_effect_is_no_false_alarm() -> None:
    drifts = [in_axis(target("resonance-drift"), axis) for axis in "xy"]
    found = [
        in_axis(finding("resonance-drift"), "y"),
        in_axis(finding(), "x"),
        in_axis(finding("resonance-drift"), "x"),
    ]
    named = run(imaging_key(in_axis(target(), "x"), *drifts), diagnosis_of(*found))
    assert named_right(named)
    assert stage_right(named)
    drifting = run(imaging_key(*drifts) | {"kind": "none"}, diagnosis_of(found[0], found[2]))
    assert not has_false_alarm(drifting)
    alarmed = run(
        imaging_key(*drifts) | {"kind": "none"}, diagnosis_of(found[0], in_axis(finding("gain-drift", "readout"), "x"))
    )
    assert has_false_alarm(alarmed)


def test_another_name_of_the_same_law_is_right() -> None:
    pendulum = target("sine-stiffness") | {"also_right": ["cubic-stiffness"]}
    assert named_right(run(key(effects=[pendulum]), diagnosis_of(finding())))
    assert not named_right(run(key(effects=[pendulum]), diagnosis_of(finding("quadratic-drag"))))


def test_reliability_counts_names_by_their_stated_probability() -> None:
    sure, wrong = finding() | {"probability": 0.999}, finding("gain-drift", "readout") | {"probability": 0.95}
    result = summarise([run(key(effects=[target()]), diagnosis_of(sure, wrong))])
    assert (result["right of names with p above 0.99"]["right"], result["right of names with p above 0.99"]["of"]) == (
        1,
        1,
    )
    assert (
        result["right of names with p 0.9 to 0.99"]["right"],
        result["right of names with p 0.9 to 0.99"]["of"],
    ) == (0, 1)


def test_an_improved_device_is_compared_on_the_unused_recording() -> None:
    errors = {"nominal": {"sense_x": 1.0}, "improved": {"sense_x": 0.5}}
    better, worse = (
        Outcome("a", key(effects=[target()]), diagnosis_of(finding()), 1.0, "", errors | {"improved": {"sense_x": e}})
        for e in (0.5, 1.5)
    )
    result = summarise([better, worse])
    assert result["open-loop error, improved over nominal"] == {"median": 1.0, "largest": 1.5}
    assert result["improved device not worse, unused recording"]["right"] == 1
    assert "imaging" not in family_table(summarise_families([better, worse]))
    assert "| ring |" in family_table(summarise_families([better, worse]))


@pytest.mark.parametrize("improved", [{}, {"improved": {}}, {"improved": {"sense_x": np.nan}}])
def test_an_improved_device_that_predicts_nothing_is_worse(improved: dict) -> None:
    """Such a recording was left out of the rate and of the largest error."""
    errors = {"nominal": {"sense_x": 1.0}} | improved
    result = summarise([Outcome("a", key(effects=[target()]), diagnosis_of(finding()), 1.0, "", errors)])
    rate = result["improved device not worse, unused recording"]
    assert (rate["right"], rate["of"]) == (0, 1)
    assert result["open-loop error, improved over nominal"]["largest"] == np.inf


def test_errors_of_a_reconstructed_scan_equal_the_simulated_errors() -> None:
    rate, time = 1e6, np.arange(60_000) / 1e6
    rng = np.random.default_rng(1)
    truths = {axis: 0.17 * np.sin(2 * np.pi * f * time) for axis, f in (("x", 13_840.0), ("y", 3_270.0))}
    light = intensity(truths["x"], truths["y"], rng)
    same = score_motion(truths, truths, light, rate)
    assert same == {"phase_deg": pytest.approx(0, abs=1e-9), "field": pytest.approx(1), "picture": pytest.approx(1)}
    late = -1.01 * 0.17 * np.sin(2 * np.pi * 13_840.0 * time - np.deg2rad(2.0))  # and of the other sign
    wrong = score_motion(truths | {"x": late}, truths, light, rate)
    assert wrong["phase_deg"] == pytest.approx(2.0, abs=1e-3)
    assert wrong["field"] == pytest.approx(1.01, abs=1e-4)
    assert wrong["picture"] > 1.05
