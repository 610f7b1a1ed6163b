"""What planned measurements could tell: against the physics that is known, and against the recordings they plan."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest

from recon.cli import main
from recon.planning import Excitation, planned_run, played, read_excitation, what_is_told
from scanner import devices
from scanner.device import Axis, Device, Drive, Mechanics, Position
from scanner.errors import BadInput

STAGE = Device(
    "stage",
    {
        "x": Axis(
            Mechanics(1e-12, 1e-12 * 3141.6 / 40, 1e-12 * 3141.6**2),
            drive=Drive("linear", 1e-9),
            readout=Position(20.0, 2e-3),
            tolerance={"k": 0.01, "b": 0.1, "torque_per_volt": 0.05, "gain": 0.03},
            name="x",
        )
    },
)
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


def told(*excitations: Excitation) -> dict[str, tuple[float, float]]:
    runs = [planned_run(each, STAGE) for each in excitations]
    return {each.candidate.key: (each.sigma, each.distance) for each in what_is_told(runs, STAGE)}


def test_a_ringdown_beside_a_sweep_tells_more_than_either(tmp_path: Path) -> None:
    sweep, ringdown = excitation(tmp_path, SWEEP), excitation(tmp_path, RINGDOWN)
    alone, both = told(sweep), told(sweep, ringdown)
    for key, (size, distance) in alone.items():
        assert both[key][0] > 0.99 * size, key
        assert both[key][1] > 0.99 * distance, key
    assert both["x.resonance-drift"][1] > 1.5 * alone["x.resonance-drift"][1]


def test_a_recorded_angle_tells_gain_from_damping(tmp_path: Path) -> None:
    ringdown = excitation(tmp_path, RINGDOWN)
    blind, seeing = told(ringdown), told(replace(ringdown, angle_noise=1e-5))
    assert blind["x.gain-drift"][1] < 0.5 * blind["x.gain-drift"][0]
    assert seeing["x.gain-drift"][1] > 4 * blind["x.gain-drift"][1]


def test_a_plan_foretells_what_the_recording_then_shows(tmp_path: Path) -> None:
    """The same map around a fit of a noisy recording, under the noise measured in it."""
    from estimation.mismatch.diagnosis import diagnose
    from estimation.mismatch.sensitivity import visibility
    from scanner.terms import catalogue

    sweep = excitation(tmp_path, SWEEP)
    found = diagnose([played(sweep, STAGE)], STAGE)
    assert found.verdict == "consistent"
    assert found.search is not None
    shown = {
        each.candidate.key: each.sigma
        for each in visibility(found.search.comparison, found.search.final, catalogue().values())
    }
    planned = told(sweep)
    for key in ("x.cubic-stiffness", "x.quadratic-drag", "x.gain-drift", "x.damping-drift", "x.readout-lag"):
        assert planned[key][0] == pytest.approx(shown[key], rel=0.25), key


def test_every_kind_of_excitation_moves_the_mirror_as_it_says(tmp_path: Path) -> None:
    kinds = {
        "steady": "frequency = 450\namplitude = 1",
        "steps": "levels = [0.0, 9.0, -9.0]",
        "multisine": "frequencies = [450, 500, 550]\namplitude = 1",
        "ringdown": "angle = 4e-3",
    }
    for kind, keys in kinds.items():
        made = excitation(tmp_path, f'duration = 0.05\nsample_rate = 40e3\n[x]\nkind = "{kind}"\n{keys}\n')
        recording = played(made, STAGE)
        assert recording.duration == pytest.approx(0.05)
        assert recording["sense_x"].read().std() > 5e-3, kind
    assert sorted(set(recording["drive_x"].read())) == [0.0]
    steps = excitation(tmp_path, 'duration = 0.03\nsample_rate = 40e3\n[x]\nkind = "steps"\nlevels = [1, 3, 2]\n')
    assert played(steps, STAGE)["drive_x"].read()[[100, 500, 900]].tolist() == [1.0, 3.0, 2.0]


def test_the_command_writes_table_and_page(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "stage.toml").write_text(STAGE.to_toml())
    (tmp_path / "down.toml").write_text(RINGDOWN)
    played(read_excitation(tmp_path / "down.toml"), STAGE).write(tmp_path / "rec<b>.h5")
    words = ["diagnose", "--plan", str(tmp_path / "down.toml"), str(tmp_path / "rec<b>.h5")]
    assert main([*words, "--device", str(tmp_path / "stage.toml"), "-o", str(tmp_path / "out")]) == 0
    assert "could be named alone" in capsys.readouterr().out
    plan = json.loads((tmp_path / "out" / "plan.json").read_text())
    assert plan["schema"] == "lissajous-plan/1"
    assert plan["excitations"][0]["name"] == "down"
    assert {"cubic-stiffness", "gain-drift"} <= {each["effect"] for each in plan["effects"]}
    assert all(each["distance"] <= each["sigma"] * 1.001 for each in plan["effects"])
    page = (tmp_path / "out" / "report.html").read_text()
    assert "What a measurement can tell" in page
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
def test_an_excitation_that_cannot_be_played_is_refused(tmp_path: Path, text: str, channel: str | None) -> None:
    with pytest.raises(BadInput) as error:
        excitation(tmp_path, text)
    assert error.value.channel == channel
    assert str(tmp_path) in str(error.value)


def test_a_shared_readout_needs_every_axis(tmp_path: Path) -> None:
    made = excitation(tmp_path, 'duration = 0.01\nsample_rate = 1e6\n[x]\nkind = "ringdown"\nangle = 0.1')
    with pytest.raises(BadInput, match="shares its readout"):
        played(made, devices.load("imaging"))
