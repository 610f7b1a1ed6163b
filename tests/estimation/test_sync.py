"""Phase and frequency from edge times: against the truth, against the bound, and with defective lists of edges."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest

from estimation.amplitude_calibration import motion_calibration_sd
from estimation.estimate import default_estimator, estimate
from estimation.sync.edge_phase import amplitude_from_edges, phase_from_edges
from estimation.sync.motion import axis_motion_from_edges
from phantoms.sync import SyncDetector, sync_edges
from recon.cli import main
from recon.evaluation import evaluate_axis
from scanner.device import Device
from scanner.edges import Edges, make_edges
from scanner.errors import BadInput, UnitUnknown
from scanner.recording import Recording
from tests.support.simulated import imaging

AMPLITUDE_RAD, FREQUENCY_HZ, RATE_HZ, JITTER_S = 0.1, 5000.0, 1e6, 2e-8
FIELD = Device.from_toml("[x]\n[y]\n[scan]\nhalf_angle_x = 0.1\nhalf_angle_y = 0.1\n")


def drifting(seed: int, samples: int = 100_000, walk: float = 30.0) -> tuple[np.ndarray, np.ndarray]:
    """Times [s] and phase of a motion whose frequency walks at random, by ``walk`` [rad/s] in the root of a second."""
    rng = np.random.default_rng(seed)
    rate = np.cumsum(rng.normal(0.0, walk / np.sqrt(RATE_HZ), samples))
    return np.arange(samples) / RATE_HZ, 0.7 + np.cumsum(2 * np.pi * FREQUENCY_HZ + rate) / RATE_HZ


def detected(seed: int, detector: SyncDetector, **stated: float | str) -> tuple[Edges, np.ndarray, np.ndarray]:
    time, phase = drifting(seed)
    rng = np.random.default_rng([seed, 1])
    times = sync_edges(AMPLITUDE_RAD * np.sin(phase), RATE_HZ, detector, rng)
    return make_edges("sync_x", times, {"unit": "s", **(stated or {"event": "both-edges"})}), time, phase


def phase_error(edges: Edges, time: np.ndarray, phase: np.ndarray) -> np.ndarray:
    found = phase_from_edges(edges)
    error = found.phase - np.interp(found.time, time, phase)
    turn = 2 * np.pi if found.sign != "ambiguous" else np.pi
    return error - turn * np.round(np.median(error) / turn)


@pytest.mark.parametrize("angle", [0.0, 0.03, -0.05])
def test_phase_and_its_interval_hold_for_any_position_of_the_detector(angle: float) -> None:
    edges, time, phase = detected(5, SyncDetector(angle, jitter=JITTER_S), angle=angle)
    found, error = phase_from_edges(edges), phase_error(edges, time, phase)
    jitter = 2 * np.pi * FREQUENCY_HZ * JITTER_S
    assert np.sqrt(np.mean(error**2)) < 0.4 * jitter
    assert np.mean(np.abs(error) < 1.96 * found.phase_sd) > 0.85
    assert found.jitter_sd == pytest.approx(JITTER_S, rel=0.1)
    assert np.abs(found.asymmetry - np.arcsin(angle / AMPLITUDE_RAD)).max() < 5 * found.asymmetry_sd.min()
    assert found.sign == ("known: sync_x" if angle else "ambiguous")
    amplitude = amplitude_from_edges(edges, found)
    if angle:
        assert amplitude is not None
        assert np.abs(amplitude[0] - AMPLITUDE_RAD).max() < 5 * amplitude[1].min()
        assert amplitude[1].max() < 1e-3 * AMPLITUDE_RAD
    else:
        assert amplitude is None


def test_the_amplitude_of_a_transient_is_followed_by_a_detector_beside_the_centre() -> None:
    time, phase = drifting(6)
    true = AMPLITUDE_RAD * (1.0 + 0.1 * np.exp(-time / 0.01))
    times = sync_edges(true * np.sin(phase), RATE_HZ, SyncDetector(0.02, jitter=JITTER_S), np.random.default_rng(6))
    edges = make_edges("sync_x", times, {"unit": "s", "angle": 0.02})
    found = phase_from_edges(edges)
    amplitude = amplitude_from_edges(edges, found)
    assert amplitude is not None
    error = amplitude[0] / np.interp(found.time, time, true) - 1.0
    assert np.sqrt(np.mean(error**2)) < 2e-3
    assert np.sqrt(np.mean(phase_error(edges, time, phase) ** 2)) < 0.6 * 2 * np.pi * FREQUENCY_HZ * JITTER_S


@pytest.mark.parametrize("delay", [0.0, 0.9e-4, 1.0e-4, 1.1e-4, 2.0e-4])
def test_both_sides_of_a_pause_have_one_sign(delay: float) -> None:
    """The motion stops, and starts again with another phase: the intervals show which edges are of which direction."""
    time = np.arange(100_000) / RATE_HZ
    phase = 0.7 + 2 * np.pi * FREQUENCY_HZ * (time + delay * (time > 0.05))
    amplitude = AMPLITUDE_RAD * np.minimum(np.abs(time - 0.05) / 0.02, 1.0) ** 2
    detector = SyncDetector(0.01, jitter=JITTER_S)
    times = sync_edges(amplitude * np.sin(phase), RATE_HZ, detector, np.random.default_rng(1))
    found = phase_from_edges(make_edges("sync_x", times, {"unit": "s", "angle": 0.01}))
    error = found.phase - np.interp(found.time, time, phase)
    moving = np.abs(found.time - 0.05) > 0.02
    assert found.sign == "known: sync_x"
    assert np.abs(np.angle(np.exp(1j * error[moving]))).max() < 0.01


def test_the_phase_in_a_gap_is_within_its_interval_and_left_out_where_it_is_unknown() -> None:
    pulls = []
    for seed in range(8):
        edges, time, phase = detected(seed, SyncDetector(0.03, jitter=JITTER_S), angle=0.03)
        gapped = replace(edges, times=edges.times[np.abs(edges.times - 0.05) > 0.01])
        found, error = phase_from_edges(gapped), phase_error(gapped, time, phase)
        inside = np.abs(found.time - 0.05) < 0.009
        assert inside.sum() > 20  # points every 4 periods
        assert found.phase_sd[inside].max() > 10 * np.median(found.phase_sd)
        pulls.append(error[inside] / found.phase_sd[inside])
    assert 0.3 < np.sqrt(np.mean(np.square(pulls))) < 2.0

    time, phase = drifting(7, walk=4000.0)
    times = sync_edges(AMPLITUDE_RAD * np.sin(phase), RATE_HZ, SyncDetector(0.03), np.random.default_rng(1))
    times = times[np.abs(times - 0.05) > 0.03]
    wild = make_edges("sync_x", times, {"unit": "s", "angle": 0.03})
    motion, _, facts = axis_motion_from_edges(Recording({}, None, {}), FIELD, wild, (RATE_HZ, 0.0, time.size))
    unknown = np.isnan(motion.angle.read())
    assert unknown[np.abs(time - 0.05) < 0.005].all()
    assert not unknown[np.abs(time - 0.05) > 0.031].any()
    assert facts["edges"] == times.size


@pytest.mark.parametrize("event", ["zero-crossing-up", "zero-crossing-down", "turn"])
def test_every_event_gives_the_phase(event: str) -> None:
    time, phase = drifting(6)
    shift, step = {"zero-crossing-up": (0.0, 2), "zero-crossing-down": (1.0, 2), "turn": (0.5, 1)}[event]
    half_turns = np.arange(np.ceil(phase[0] / np.pi), np.floor(phase[-1] / np.pi)) // step * step + shift
    times = np.interp(np.unique(half_turns) * np.pi, phase, time)
    edges = make_edges("sync_x", times[2:-2], {"unit": "s", "event": event})
    assert np.abs(phase_error(edges, time, phase)).max() < 1e-4


def test_missing_doubled_and_stray_edges_are_counted_and_do_no_harm() -> None:
    clean, time, phase = detected(7, SyncDetector(0.02, jitter=JITTER_S), angle=0.02)
    bad, _, _ = detected(7, SyncDetector(0.02, jitter=JITTER_S, missing=0.05, doubled=0.05), angle=0.02)
    times = np.sort(np.append(bad.times, [0.0123456, 0.0456789]))
    bad = make_edges("sync_x", times, {"unit": "s", "angle": 0.02})
    found = phase_from_edges(bad)
    expected = clean.times.size
    assert found.numbered.missing + found.time.size + found.outliers == pytest.approx(expected, abs=3)
    assert found.numbered.doubled > 20
    assert found.numbered.stray + found.outliers in (1, 2)
    errors = [np.sqrt(np.mean(phase_error(edges, time, phase) ** 2)) for edges in (clean, bad)]
    assert errors[1] < 1.3 * errors[0]
    line = found.describe("sync_x")
    assert line.startswith(f"sync_x: {found.time.size} edges are used; ")
    assert "missing" in line
    assert "repeated" in line
    assert "\n" not in line


def test_hysteresis_delays_both_edges_and_is_taken_off() -> None:
    edges, time, phase = detected(8, SyncDetector(0.03, 0.002), angle=0.03)
    late = np.median(phase_error(edges, time, phase))
    assert late == pytest.approx(-0.002 / (AMPLITUDE_RAD * np.sqrt(1 - 0.09)), rel=0.01)
    channels = {"intensity": (np.zeros(time.size), "V", RATE_HZ)}
    stated = {"angle": 0.03, "hysteresis": 0.002}
    recording = Recording.from_arrays(
        {**channels, "sync_x": (edges.times, "s", stated)}, Device("d", {"x": FIELD.axes["x"]})
    )
    motion = estimate(recording)
    assert motion_calibration_sd(recording, recording.device, "x", motion) == 0.0
    angle = motion.axes["x"].angle.read()
    known = np.isfinite(angle)
    assert known.mean() > 0.99
    assert np.abs(angle - AMPLITUDE_RAD * np.sin(phase))[known].max() < 5e-4 * AMPLITUDE_RAD


def test_edges_are_the_default_where_nothing_else_shows_the_motion() -> None:
    edges, time, phase = detected(9, SyncDetector(jitter=JITTER_S))
    channels = {
        "intensity": (np.zeros(time.size), "V", RATE_HZ),
        "sync_x": (edges.times, "s", {"event": "both-edges"}),
        "angle_y": (0.1 * np.sin(2 * np.pi * 700 * time), "rad", RATE_HZ),
    }
    recording = Recording.from_arrays(channels, FIELD)
    assert default_estimator(recording, FIELD) == "edges"
    motion = estimate(recording)
    assert motion.axes["x"].sign == "ambiguous"
    assert motion.axes["y"].sign == "known: angle_y"
    assert any("do not determine the amplitude" in note for note in motion.notes)
    assert motion_calibration_sd(recording, FIELD, "x", motion) is None
    opposite = estimate(recording, flips={"x": True}).axes["x"].angle.read()
    error = min(np.nanmax(np.abs(sign * opposite - 0.1 * np.sin(phase))) for sign in (1.0, -1.0))
    assert error < 1e-3
    bare = Recording.from_arrays(channels, Device("bare", {"x": FIELD.axes["x"]}))
    with pytest.raises(BadInput, match="do not determine the amplitude"):
        estimate(bare)


@pytest.mark.parametrize("optical", [False, True])
def test_a_motion_that_fills_the_field_has_its_mechanical_half_angle(optical: bool) -> None:
    edges, time, _ = detected(9, SyncDetector(jitter=JITTER_S))
    assert FIELD.scan is not None
    stated = replace(FIELD.scan, angle="optical") if optical else FIELD.scan
    channels = {
        "intensity": (np.zeros(time.size), "V", RATE_HZ),
        "sync_x": (edges.times, "s", {"event": "both-edges"}),
        "angle_y": (0.1 * np.sin(2 * np.pi * 700 * time), "rad", RATE_HZ),
    }
    motion = estimate(Recording.from_arrays(channels, replace(FIELD, scan=stated)))
    assert np.allclose(motion.axes["x"].amplitude, FIELD.scan.half_angle_x * (0.5 if optical else 1.0))


def test_edges_settle_the_sign_of_a_capacitive_signal() -> None:
    recording, truth = imaging()
    channels = {key: (c.read(), c.unit, c.sample_rate, c.start) for key, c in recording.channels.items()}
    angle, rng = truth["angle_x"][0].astype(float), np.random.default_rng(4)
    for side in (1.0, -1.0):
        times = sync_edges(side * angle, 5e6, SyncDetector(0.04, jitter=1e-8), rng)
        made = Recording.from_arrays({**channels, "sync_x": (times, "s", {"angle": 0.04})}, recording.device)
        axis = estimate(made, method="tracker").axes["x"]
        assert axis.sign == "known: sync_x"
        assert side * np.corrcoef(axis.angle.read(), angle)[0, 1] > 0.999


def test_edges_are_written_read_and_cut(tmp_path: Path) -> None:
    values = np.arange(1.0, 9.0)
    channels = {"intensity": (values, "V", 1.0), "sync_y": (1e3 * values, "ms", {"angle": 0.01, "hysteresis": 1e-3})}
    Recording.from_arrays(channels).write(tmp_path / "a.h5")
    with h5py.File(tmp_path / "a.h5") as file:
        assert "sample_rate" not in file["channels/sync_y"].attrs
        assert file["channels/sync_y"].attrs["event"] == "both-edges"
    with Recording.open(tmp_path / "a.h5") as made:
        edges = made.edges["sync_y"]
        assert np.array_equal(edges.times, values)
        assert (edges.event, edges.angle, edges.hysteresis) == ("both-edges", 0.01, 1e-3)
        assert list(made.slice(2.0, 4.0).edges["sync_y"].times) == [2.0, 3.0]
        assert "8 edges, both-edges" in repr(made)


@pytest.mark.parametrize(
    ("times", "stated", "line"),
    [
        ([1, 3, 2.0], {"unit": "s", "event": "turn"}, "edge 2 at 2 s is earlier than the one before; sort the times"),
        ([1, np.nan], {"unit": "s", "event": "turn"}, "edge 1 is not finite; remove it from the list"),
        ([[1.0]], {"unit": "s", "event": "turn"}, "has shape (1, 1) of float64; store edge times as a list of numbers"),
        ([1.0], {"unit": "s"}, "states neither event nor angle; state event as one of zero-crossing-up, "),
        ([1.0], {"unit": "s", "event": "rise"}, "event 'rise' is unknown; state event as one of zero-crossing-up, "),
        ([1.0], {"unit": "s", "angle": "far"}, "angle is 'far', not a finite number; state angle in rad"),
    ],
)
def test_wrong_edges_are_refused_in_one_line(times: list[float], stated: dict[str, object], line: str) -> None:
    with pytest.raises(BadInput) as caught:
        make_edges("sync_x", np.array(times), stated)
    assert str(caught.value).startswith(f"sync_x: {line}")
    with pytest.raises(UnitUnknown, match="unit is missing"):
        make_edges("sync_x", np.array([1.0]), {"event": "turn"})


def test_lists_without_a_regular_sequence_are_refused() -> None:
    rng = np.random.default_rng(1)
    for times in (np.sort(rng.random(500)), np.arange(5.0)):
        with pytest.raises(BadInput, match=r"no regular sequence|edges; 12 are needed"):
            phase_from_edges(make_edges("sync_x", times, {"unit": "s", "event": "zero-crossing-up"}))


def test_the_amplitude_line_says_what_determines_it(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    edges, time, phase = detected(8, SyncDetector(0.03), angle=0.03)
    light = np.random.default_rng(0).normal(2.0 + np.sin(phase), 0.1)
    channels = {"intensity": (light, "V", RATE_HZ), "angle_y": (0.1 * np.sin(4400.0 * time), "rad", RATE_HZ)}
    words = {"angle": (0.03, "edges", "by the stated angle of the detector"),
             "event": ("both-edges", "field", "the half angle of [scan]")}  # fmt: skip
    for key, (value, source, line) in words.items():
        path = tmp_path / f"{key}.h5"
        recording = Recording.from_arrays({**channels, "sync_x": (edges.times, "s", {key: value})}, FIELD)
        recording.write(path)
        assert main(["reconstruct", str(path), "-o", str(tmp_path / key), "--pixels", "60x60"]) == 0
        assert json.loads((tmp_path / key / "summary.json").read_text())["x"]["amplitude_from"] == source
        assert line in capsys.readouterr().out


@pytest.mark.parametrize("event", ["both-edges", "zero-crossing-up", "zero-crossing-down", "turn"])
@pytest.mark.parametrize("axis", ["x", "y"])
def test_the_third_harmonic_of_combs_does_not_shift_the_phase(axis: str, event: str) -> None:
    """Without its correction the error is 0.05 degrees, of turns 0.16, and beyond the interval."""
    recording, truth = imaging()
    angle, attrs = truth[f"angle_{axis}"]
    rate, placed = attrs["sample_rate"], 0.02 if event == "both-edges" else 0.0
    position = np.gradient(angle) * rate if event == "turn" else angle  # a motion turns where its velocity is 0
    times = sync_edges(position, rate, SyncDetector(placed, jitter=2e-9), np.random.default_rng(3))
    if event.startswith("zero"):
        rising = np.interp(times, np.arange(angle.size) / rate, np.gradient(angle)) > 0.0
        times = times[rising == event.endswith("up")]
    stated = {"unit": "s", "event": event} | ({"angle": placed} if placed else {})
    edges = make_edges(f"sync_{axis}", times, stated)
    motion, _, _ = axis_motion_from_edges(recording, recording.device, edges, (rate, 0.0, angle.size))
    error = evaluate_axis(motion, angle, rate, 0.0)
    assert np.degrees(error.phase_rmse) < (0.03 if event == "turn" else 0.012)
    assert error.phase_rmse < 1.5 * np.sqrt(np.mean(motion.phase_sd**2))
    if placed:
        assert np.abs(np.mean(error.amplitude)) < 2e-4  # 5e-4 without the harmonic
        assert error.angle_rmse < 1e-4


def test_an_unknown_torque_widens_the_interval() -> None:
    recording, truth = imaging()
    angle, attrs = truth["angle_x"]
    times = sync_edges(angle, attrs["sample_rate"], SyncDetector(0.02, jitter=5e-9), np.random.default_rng(3))
    edges = make_edges("sync_x", times, {"unit": "s", "angle": 0.02})
    sds = []
    for tolerance in (0.02, 0.5):
        x = replace(recording.device.axis("x"), tolerance={"C0": tolerance})
        device = replace(recording.device, axes={**recording.device.axes, "x": x})
        motion, _, _ = axis_motion_from_edges(recording, device, edges, (attrs["sample_rate"], 0.0, angle.size))
        sds.append(float(np.degrees(np.median(motion.phase_sd))))
    assert sds[1] == pytest.approx(np.hypot(sds[0], 0.5 * 0.054), rel=0.1)


@pytest.mark.parametrize("frequency", [1024.0, 512.0])
def test_edges_without_any_rounding_give_the_phase(frequency: float) -> None:
    edges = make_edges("sync_x", np.arange(1000) / (2.0 * frequency), {"unit": "s", "event": "both-edges"})
    found = phase_from_edges(edges)
    assert np.isfinite(found.phase).all()
    slope = np.diff(found.phase) / np.diff(found.time)
    np.testing.assert_allclose(np.abs(slope), 2 * np.pi * frequency, rtol=1e-6)
