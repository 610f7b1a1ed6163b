"""Detectability of effects in planned measurements, compared with known physics and with simulated recordings."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest

from recon.cli import main
from recon.experiment_planning import (
    Excitation,
    predict_detectability,
    prepare_planned_run,
    read_excitation,
    simulate_excitation,
)
from scanner import devices
from scanner.errors import BadInput
from tests.support.bench import DEVICE

SWEEP = """
duration = 0.15
sample_rate = 40e3
[x]
kind = "sweep"
f0 = 400
f1 = 600
amplitude = 1.5
"""
RINGDOWN = """
duration = 0.1
sample_rate = 40e3
[x]
kind = "ringdown"
angle = 4e-3
"""


def excitation(folder: Path, text: str, name: str = "excitation") -> Excitation:
    file = folder / f"{name}.toml"
    file.write_text(text)
    return read_excitation(file)


def predicted_detectability(*excitations: Excitation) -> dict[str, tuple[float, float]]:
    """Effect -> its size and its distance from the nearest confounder, in standard deviations."""
    runs = [prepare_planned_run(planned, DEVICE) for planned in excitations]
    return {each.candidate.key: (each.sigma, each.distance) for each in predict_detectability(runs, DEVICE)}


@pytest.mark.slow
def test_a_ringdown_beside_a_sweep_separates_more_effects_than_the_sweep(tmp_path: Path) -> None:
    sweep, ringdown = excitation(tmp_path, SWEEP), excitation(tmp_path, RINGDOWN)
    alone, both = predicted_detectability(sweep), predicted_detectability(sweep, ringdown)
    for key, (size, distance) in alone.items():
        assert both[key][0] > 0.99 * size, key
        assert both[key][1] > 0.99 * distance, key
    assert both["x.resonance-drift"][1] > 1.5 * alone["x.resonance-drift"][1]


@pytest.mark.slow
def test_a_recorded_angle_separates_gain_from_damping(tmp_path: Path) -> None:
    ringdown = excitation(tmp_path, RINGDOWN)
    without_angle, with_angle = (
        predicted_detectability(ringdown),
        predicted_detectability(replace(ringdown, angle_noise=1e-5)),
    )
    assert without_angle["x.gain-drift"][1] < 0.5 * without_angle["x.gain-drift"][0]
    assert with_angle["x.gain-drift"][1] > 4 * without_angle["x.gain-drift"][1]


@pytest.mark.slow
def test_a_plan_predicts_the_detectability_in_the_recording(tmp_path: Path) -> None:
    """Compared with the detectability around a fit of a noisy recording, with the noise measured in it."""
    from estimation.diagnosis.diagnose import diagnose
    from estimation.diagnosis.identifiability import detectability
    from scanner.terms import catalogue

    sweep = excitation(tmp_path, SWEEP)
    diagnosis = diagnose([simulate_excitation(sweep, DEVICE)], DEVICE)
    assert diagnosis.verdict == "consistent"
    assert diagnosis.search is not None
    sigma_in_recording = {
        effect.candidate.key: effect.sigma
        for effect in detectability(diagnosis.search.likelihood, diagnosis.search.final, catalogue().values())
    }
    planned = predicted_detectability(sweep)
    for key in ("x.cubic-stiffness", "x.quadratic-drag", "x.gain-drift", "x.damping-drift", "x.readout-lag"):
        assert planned[key][0] == pytest.approx(sigma_in_recording[key], rel=0.25), key


def test_every_kind_of_excitation_moves_the_mirror(tmp_path: Path) -> None:
    kinds = {
        "steady": "frequency = 450\namplitude = 1",
        "steps": "levels = [0.0, 9.0, -9.0]",
        "multisine": "frequencies = [450, 500, 550]\namplitude = 1",
        "ringdown": "angle = 4e-3",
    }
    for kind, keys in kinds.items():
        planned = excitation(tmp_path, f'duration = 0.05\nsample_rate = 40e3\n[x]\nkind = "{kind}"\n{keys}\n')
        recording = simulate_excitation(planned, DEVICE)
        assert recording.duration == pytest.approx(0.05)
        assert recording["sense_x"].read().std() > 5e-3, kind
    assert sorted(set(recording["drive_x"].read())) == [0.0]
    steps = excitation(tmp_path, 'duration = 0.03\nsample_rate = 40e3\n[x]\nkind = "steps"\nlevels = [1, 3, 2]\n')
    assert simulate_excitation(steps, DEVICE)["drive_x"].read()[[100, 500, 900]].tolist() == [1.0, 3.0, 2.0]


@pytest.mark.slow
def test_the_command_writes_plan_and_report(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "stage.toml").write_text(DEVICE.to_toml())
    (tmp_path / "down.toml").write_text(RINGDOWN)
    simulate_excitation(read_excitation(tmp_path / "down.toml"), DEVICE).write(tmp_path / "rec<b>.h5")
    words = ["diagnose", "--plan", str(tmp_path / "down.toml"), str(tmp_path / "rec<b>.h5")]
    assert main([*words, "--device", str(tmp_path / "stage.toml"), "-o", str(tmp_path / "out")]) == 0
    shown = capsys.readouterr().out
    assert "could identify" in shown
    plan = json.loads((tmp_path / "out" / "plan.json").read_text())
    assert plan["schema"] == "lissajous-plan/1"
    assert plan["excitations"][0]["name"] == "down"
    assert {"cubic-stiffness", "gain-drift"} <= {effect["effect"] for effect in plan["effects"]}
    assert all(effect["distance"] <= effect["sigma"] * 1.001 for effect in plan["effects"])
    listed = [line.split(" sigma")[0].rpartition(":")[0].strip() for line in shown.splitlines()[1:-1]]
    assert listed == [effect["key"] for effect in plan["effects"]]
    assert len(set(listed)) == len(listed)
    page = (tmp_path / "out" / "report.html").read_text()
    assert "What a measurement can show" in page
    assert "<b>" not in page


@pytest.mark.parametrize(
    ("text", "channel"),
    [
        ("sample_rate = 1e5\n[x]\nkind = 'steps'\nlevels = [1]", "duration"),
        ("duration = 1\nsample_rate = 1e5", None),
        ("duration = 1\nsample_rate = 1e5\n[x]\nkind = 'chirp'", "x.kind"),
        ("duration = 1\nsample_rate = 1e5\n[x]\nkind = 'steps'\nlevels = 3", "x.levels"),
        ("duration = 1\nsample_rate = 1e5\n[x]\nkind = 'steady'\nfrequency = 3", "x.amplitude"),
        ("duration = 1\nsample_rate = 1e5\n[x]\nkind = 'ringdown'\nangle = true", "x.angle"),
        ("duration = 1\nsample_rate = 1e5\n[x]\nkind = 'ringdown'\nangle = 1\ntilt = 2", "x.tilt"),
    ],
)
def test_an_invalid_excitation_is_refused(tmp_path: Path, text: str, channel: str | None) -> None:
    with pytest.raises(BadInput) as error:
        excitation(tmp_path, text)
    assert error.value.channel == channel
    assert str(tmp_path) in str(error.value)


def test_an_excitation_of_one_axis_on_a_shared_readout_is_refused(tmp_path: Path) -> None:
    planned = excitation(tmp_path, 'duration = 0.01\nsample_rate = 1e6\n[x]\nkind = "ringdown"\nangle = 0.1')
    with pytest.raises(BadInput, match="shares its readout"):
        simulate_excitation(planned, devices.load("imaging"))
