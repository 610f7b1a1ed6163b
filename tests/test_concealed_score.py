"""The scorer of sealed recordings, on diagnoses made by hand."""

from __future__ import annotations

import json
import stat
import sys

import pytest

from benchmarks.concealed import score
from benchmarks.concealed.table import both_named, held, markdown, share, summary


def key(kind="one", effects=(), coloured=False, angle=True):
    return {"kind": kind, "family": "ring", "coloured": coloured, "angle": angle, "effects": list(effects)}


def secret(name="cubic-stiffness", stage="mechanics", sigma=50.0, distance=10.0, **parameters):
    return {"effect": name, "stage": stage, "listed": True, "sigma": sigma, "distance": distance,
            "nearest": "quintic-stiffness", "parameters": parameters}  # fmt: skip


def finding(name="cubic-stiffness", stage="mechanics", rivals=(), after=1.01, **intervals):
    parameters = [{"name": n, "value": sum(ci) / 2, "ci95": list(ci), "unit": ""} for n, ci in intervals.items()]
    return {"axis": "x", "stage": stage, "effect": name, "parameters": parameters, "probability": 0.9,
            "rivals": [{"effect": rival, "probability": 0.1} for rival in rivals],
            "heldout": {"metric": "", "before": 9.0, "after": after}}  # fmt: skip


def said(*found):
    return {"schema": "lissajous-diagnosis/1", "verdict": "mismatch" if found else "consistent",
            "findings": list(found), "unexplained": None}  # fmt: skip


def run(key, diagnosis, failure=""):
    return score.Run("sealed-001", key, diagnosis, 12.0, failure)


def rate_of(name, *runs):
    return summary(runs)["rates"][name]


def test_a_stage_must_be_right_where_no_look_alike_of_another_comes_near():
    rivals = {"viscoelastic": 1.0, "drive-lag": 2.0}, {"viscoelastic": 1.0, "drive-lag": 7.0}
    runs = [run(key(effects=[secret() | {"rivals": each}]), said(finding("drive-lag", "drive"))) for each in rivals]
    assert rate_of("right stage, visible", *runs)["of"] == 2
    assert rate_of("right stage, look-alikes of other stages clear", *runs) == share(0, 1)


def test_false_alarms_are_counted_by_the_noises_colour():
    quiet, alarm = said(), said(finding())
    runs = [run(key("none"), quiet), run(key("none"), alarm), run(key("none", coloured=True), quiet)]
    assert rate_of("false alarm, white noise", *runs)["rate"] == 0.5
    assert rate_of("false alarm, coloured noise", *runs)["rate"] == 0.0


def test_a_run_that_failed_is_no_success():
    failed = run(key("none"), None, "more than 600 s")
    assert rate_of("false alarm, white noise", failed)["rate"] == 1.0
    assert summary([failed])["failures"] == {"sealed-001": "more than 600 s"}


def test_only_clear_effects_must_be_named_singly_but_every_visible_one_within_its_class():
    near = run(key(effects=[secret(distance=2.0)]), said(finding("quintic-stiffness", rivals=["cubic-stiffness"])))
    far = run(key(effects=[secret()]), said(finding()))
    unseen = run(key(effects=[secret(sigma=1.0, distance=0.5)]), said())
    runs = near, far, unseen
    assert rate_of("right name, one effect, clear", *runs) | {"ci95": None} == {"of": 1, "rate": 1.0, "ci95": None}
    assert rate_of("right name, one effect, any", *runs)["rate"] == pytest.approx(1 / 3)
    assert rate_of("named class holds the truth, visible", *runs) | {"ci95": 0} == {"of": 2, "rate": 1.0, "ci95": 0}
    assert rate_of("right stage, visible", *runs)["rate"] == 1.0


def test_both_of_two_must_be_named():
    two = key("two", [secret(), secret("gain-drift", "readout")])
    assert both_named(run(two, said(finding("gain-drift", "readout"), finding())))
    assert not both_named(run(two, said(finding())))


def test_an_unlisted_effect_is_unknown_in_its_own_stage():
    hidden = key("unlisted", [secret("play-in-readout", "readout")])
    right, misplaced = said(finding("unknown", "readout")), said(finding("unknown", "mechanics"))
    runs = [run(hidden, right), run(hidden, misplaced), run(hidden, said(finding()))]
    assert rate_of("unknown and right stage, unlisted, any", *runs)["rate"] == pytest.approx(1 / 3)
    assert rate_of("unknown, unlisted, any stage", *runs)["rate"] == pytest.approx(2 / 3)


def test_intervals_are_held_against_the_truth_by_either_name():
    assert held(run(key(effects=[secret(k3=2.0)]), said(finding(k3=(1.0, 3.0))))) == [True]
    assert held(run(key(effects=[secret(k3=4.0)]), said(finding(k3=(1.0, 3.0))))) == [False]
    drift = key(effects=[secret("resonance-drift", dk=0.01, tau=1.0)])
    assert held(run(drift, said(finding("resonance-drift", alpha=(0.0, 0.02), tau=(2.0, 3.0))))) == [True, False]
    assert held(run(drift, said(finding("cubic-stiffness", alpha=(0.0, 0.02))))) == []


@pytest.mark.parametrize(("angle", "holds"), [(False, True), (True, False)])
def test_a_sign_that_cannot_be_known_is_not_asked_for(angle, holds):
    hidden = key(effects=[secret("comb-offset", "capacitance", theta_c=-0.005)], angle=angle)
    assert held(run(hidden, said(finding("comb-offset", "capacitance", theta_c=(0.004, 0.006))))) == [holds]


def test_shares_carry_wilsons_interval():
    low, high = share(95, 100)["ci95"]
    assert (low, high) == pytest.approx((0.8883, 0.9785), abs=1e-3)
    assert share(0, 0)["rate"] is None


def test_a_key_of_one_effect_without_a_distance_is_read_too():
    old = {"family": "ring", "effect": "cubic-stiffness", "stage": "mechanics", "parameters": {}, "coloured": False}
    assert score.opened(old)["effects"][0]["effect"] == "cubic-stiffness"
    assert score.opened(old | {"effect": "none", "stage": None})["kind"] == "none"
    named = run(score.opened(old), said(finding()))
    assert rate_of("right name, one effect, clear", named)["rate"] == 1.0


def test_from_command_to_page(tmp_path):
    """A stand-in for the command line: it names one recording rightly, fails on one and hangs on another."""
    tool = tmp_path / "tool"
    tool.write_text(
        f"#!{sys.executable}\nimport json, pathlib, sys, time\n"
        "_, verb, recording, o, out, as_json = sys.argv\n"
        "assert (verb, o, as_json) == ('diagnose', '-o', '--json')\n"
        "name = pathlib.Path(recording).stem\n"
        "if name == 'c': time.sleep(60)\n"
        "if name == 'b': sys.exit('the sense channel is empty')\n"
        f"pathlib.Path(out, 'diagnosis.json').write_text({json.dumps(said(finding()))!r})\n"
    )
    tool.chmod(tool.stat().st_mode | stat.S_IXUSR)
    keys = {name: key(effects=[secret()]) for name in "abc"}
    (tmp_path / "keys.json").write_text(json.dumps(keys))
    out = tmp_path / "out"
    results = tmp_path / "results.md"
    results.write_text(f"before\n{score.BEGIN}old\n{score.END}\nafter\n")
    arguments = [str(tmp_path), str(tmp_path / "keys.json"), str(out), "--command", str(tool), "--timeout", "3"]
    arguments += ["--page", str(results)]
    assert score.main(arguments) == 0
    result = json.loads((out / "score.json").read_text())
    assert result["rates"]["right name, one effect, clear"]["rate"] == pytest.approx(1 / 3)
    assert result["failures"] == {"b": "exit 1: the sense channel is empty", "c": "more than 3 s"}
    assert result["confusion"] == {"cubic-stiffness": {"failed": 2, "cubic-stiffness": 1}}
    assert result["heldout"] == {"before": 9.0, "after": 1.01}
    page = (out / "score.md").read_text()
    assert "| right name, one effect, clear | 33.3% |" in page
    assert page == markdown(result)
    assert results.read_text() == f"before\n{score.BEGIN}\n{page}\n{score.END}\nafter\n"
    tool.unlink()
    assert score.main(arguments) == 0  # what has run is not run again
    assert json.loads((out / "score.json").read_text()) == result
