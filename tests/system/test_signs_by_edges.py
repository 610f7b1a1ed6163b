"""A picture whose signs rest on what is stated of edges says so once, because nothing in the recording tells."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

import lissajous
from recon.cli import main
from scanner.device import Device
from scanner.recording import Recording
from tests.support.two_axis_scan import EDGES, RATE_HZ, angles, crossings, edges, reconstruct

UP = {"event": "zero-crossing-up"}
READOUT_X = '[x.readout]\nkind = "position"\ngain = 20.0\nnoise_sd = 2e-3\n'


def downward(axis: str) -> np.ndarray:
    """Times at which the axis passes the centre towards negative angles [s]."""
    return np.setdiff1d(crossings(axis, upward=False), crossings(axis))


def sign_notes(notes: list[str]) -> list[str]:
    return [note for note in notes if note.startswith("the sign of")]


def test_edges_state_once_what_the_signs_rest_on() -> None:
    """Edges of the direction that is not stated mirror the picture, which nothing in the recording shows."""
    right = reconstruct(edges(crossings("x"), crossings("y")), EDGES)
    wrong = reconstruct(edges(downward("x"), crossings("y")), EDGES)
    difference = {
        name: np.nanmean(np.abs(right.picture.image - image))
        for name, image in (("same", wrong.picture.image), ("mirrored", wrong.picture.image[:, ::-1]))
    }
    assert difference["mirrored"] < 0.5 * difference["same"]
    for result in (right, wrong):
        (note,) = sign_notes(result.notes)
        assert note.startswith(
            "the sign of x and y rests on event = zero-crossing-up of sync_x and event = zero-crossing-up of sync_y"
        )
        assert "compare it with a known target" in note
        assert "if it is mirrored in x, state event = zero-crossing-down or give --flip-x" in note
        assert "if it is mirrored in y, state event = zero-crossing-down or give --flip-y" in note


def test_only_axes_whose_sign_is_that_of_the_edges_are_named_with_them() -> None:
    channels = edges(crossings("x"), crossings("y"))
    recording = Recording.from_arrays(channels, Device.from_toml(EDGES))
    (note,) = sign_notes(lissajous.reconstruct(recording, pixels=(80, 80), flip_x=True).notes)
    assert note.startswith("the sign of y rests on event = zero-crossing-up of sync_y, and")
    channels["sync_x"] = (crossings("x", upward=False), "s", {"event": "both-edges"})
    first, second = sorted(sign_notes(reconstruct(channels, EDGES).notes))
    assert first.startswith("the sign of x is ambiguous")
    assert second.startswith("the sign of y rests on")


def test_the_sign_of_a_detector_beside_the_centre_rests_on_its_angle() -> None:
    angle = angles()["x"] - 0.03
    at = np.flatnonzero(angle[:-1] * angle[1:] < 0.0)
    times = (at - angle[at] / (angle[at + 1] - angle[at])) / RATE_HZ
    channels = edges(crossings("x"), crossings("y"))
    pictures = {}
    for stated in (0.03, -0.03):
        result = reconstruct(channels | {"sync_x": (times, "s", {"angle": stated})}, EDGES)
        (note,) = sign_notes(result.notes)
        assert f"rests on angle = {stated} rad of sync_x and event = zero-crossing-up of sync_y" in note
        assert f"if it is mirrored in x, state angle = {-stated} rad or give --flip-x" in note
        pictures[stated] = result.picture.image
    same = np.nanmean(np.abs(pictures[0.03] - pictures[-0.03]))
    assert np.nanmean(np.abs(pictures[0.03] - pictures[-0.03][:, ::-1])) < 0.5 * same


def test_the_summary_states_what_the_signs_by_edges_rest_on(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    Recording.from_arrays(edges(crossings("x"), crossings("y")), Device.from_toml(EDGES)).write(tmp_path / "scan.h5")
    assert main(["reconstruct", str(tmp_path / "scan.h5"), "-o", str(tmp_path / "out")]) == 0
    assert capsys.readouterr().out.count("rests on event = zero-crossing-up of sync_x") == 1
    summary = json.loads((tmp_path / "out" / "summary.json").read_text(encoding="utf-8"))
    assert summary["sign"]["x"] == "known: sync_x"
    assert len(sign_notes(summary["notes"])) == 1


REFERENCES = {"angle_x": (0, "rad", EDGES), "velocity_x": (1, "rad/s", EDGES), "sense_x": (0, "V", EDGES + READOUT_X)}


@pytest.mark.parametrize("name", REFERENCES)
def test_a_sensor_of_the_same_axis_confirms_or_contradicts_the_edges(name: str) -> None:
    order, unit, device = REFERENCES[name]
    gain = 20.0 if unit == "V" else 1.0
    signal = gain * (np.gradient(angles()["x"], 1.0 / RATE_HZ) if order else angles()["x"])
    channels = edges(crossings("x"), crossings("y")) | {name: (signal, unit, RATE_HZ)}
    for times, opposed in ((crossings("x"), False), (downward("x"), True)):
        recording = Recording.from_arrays(channels | {"sync_x": (times, "s", UP)}, Device.from_toml(device))
        notes = lissajous.reconstruct(recording, estimator="edges", pixels=(80, 80)).notes
        assert any(note.startswith(f"sync_x: its edges move opposite to {name}") for note in notes) == opposed
        (note,) = sign_notes(notes)
        assert note.startswith("the sign of y rests on")


@pytest.mark.parametrize("lag_deg", [40.0, 90.0, 140.0])
def test_a_linear_drive_confirms_or_contradicts_the_edges(lag_deg: float) -> None:
    drive = np.sin(2 * np.pi * 1870.0 * np.arange(angles()["x"].size) / RATE_HZ + 0.4 + np.radians(lag_deg))
    channels = edges(crossings("x"), crossings("y")) | {"drive_x": (drive, "V", RATE_HZ)}
    device = EDGES.replace("[y]", '[x.drive]\nkind = "linear"\ntorque_per_volt = 1e-9\n[y]')
    for times, opposed in ((crossings("x"), False), (downward("x"), True)):
        recording = Recording.from_arrays(channels | {"sync_x": (times, "s", UP)}, Device.from_toml(device))
        notes = lissajous.reconstruct(recording, estimator="edges", pixels=(80, 80)).notes
        found = [note for note in notes if note.startswith("sync_x: its edges move opposite to the torque of drive_x")]
        assert len(found) == opposed
        assert not opposed or "state event = zero-crossing-down or give --flip-x" in found[0]
        (note,) = sign_notes(notes)
        assert note.startswith("the sign of y rests on")


@pytest.mark.parametrize("drive", ["electrostatic", "none", "in phase"])
def test_without_sensor_and_deciding_drive_the_sign_rests_on_the_edges(drive: str) -> None:
    """Combs, no drive, and a torque in phase with the motion do not decide the sign."""
    channels = edges(crossings("x"), crossings("y"))
    device = EDGES
    if drive != "none":
        kind = 'kind = "linear"\ntorque_per_volt = 1e-9' if drive == "in phase" else 'kind = "electrostatic"'
        device = EDGES.replace("[y]", f"[x.drive]\n{kind}\n[y]")
        volts = np.sin(2 * np.pi * 1870.0 * np.arange(angles()["x"].size) / RATE_HZ + 0.4)
        if drive == "in phase":
            channels["drive_x"] = (volts, "V", RATE_HZ)
        else:
            channels["drive_x"] = (volts**2, "V", RATE_HZ)
    recording = Recording.from_arrays(channels, Device.from_toml(device))
    (note,) = sign_notes(lissajous.reconstruct(recording, estimator="edges", pixels=(80, 80)).notes)
    assert note.startswith("the sign of x and y rests on")
