"""Scan design: repetition of figures, mesh sizes equal to gaps of the picture, and bands equal to simulations."""

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from phantoms.forward import Plan, simulate
from phantoms.waveforms import Sine
from recon.cli import main
from recon.imaging.coverage import fill_against_time, gap_against_time, largest_gap
from recon.imaging.gridding import map_samples
from recon.imaging.picture import Grid
from recon.lissajous_figure import MAX_RATE_EXCESS, PHASES, LissajousFigure, enumerate_figures
from recon.scan_design import ScanRequirements, SustainedBand, design, find_sustained_band
from scanner import devices
from scanner.errors import BadInput
from scanner.stages import Drive


def coverage(figure: LissajousFigure, grid: Grid, phase: str) -> np.ndarray:
    x, y = figure.angles(figure.path_rate(grid), PHASES[phase])
    return map_samples(x, y, x, grid).coverage


@given(st.integers(2, 40), st.integers(2, 40), st.sampled_from(["best", "worst"]))
def test_a_figure_closes_exactly_after_one_picture(n_x: int, n_y: int, phase: str) -> None:
    assume(math.gcd(n_x, n_y) == 1)
    samples = 16 * n_x * n_y
    x, y = LissajousFigure((n_x, n_y), 50.0, (0.2, 0.1)).angles(50.0 * samples, PHASES[phase])
    assert x.size == samples
    # The velocity distinguishes two passages through one position.
    state = np.stack([x / 0.2, y / 0.1, np.gradient(x) * samples / n_x, np.gradient(y) * samples / n_y], 1)[1:-1]
    distance = np.linalg.norm(state - state[0], axis=1)
    assert distance[samples // 4 : 3 * samples // 4].min() > 2.0 * np.pi / samples
    assert np.allclose(np.diff(x, append=x[0])[-1], x[1] - x[0], atol=40 * 0.2 * n_x / samples)


@settings(max_examples=8)
@given(st.integers(5, 21), st.integers(5, 21))
def test_the_mesh_is_the_largest_gap_and_doubles_at_the_worst_phase(n_x: int, n_y: int) -> None:
    assume(math.gcd(n_x, n_y) == 1)
    figure, grid = LissajousFigure((n_x, n_y), 1.0, (0.1, 0.1)), Grid(600, 600, 0.1, 0.1)
    best, worst = (largest_gap(coverage(figure, grid, phase) > 0) for phase in ("best", "worst"))
    # Visited pixels extend up to one pixel from the path, and the largest complete rhombus may be off the centre.
    assert best == pytest.approx(figure.mesh_diameter(grid), abs=4, rel=0.06)
    assert worst == pytest.approx(2 * figure.mesh_diameter(grid), abs=4, rel=0.12)


def test_the_fill_at_any_phase_lies_between_worst_and_best() -> None:
    figure, grid = LissajousFigure((37, 20), 1.0, (0.1, 0.1)), Grid(100, 100, 0.1, 0.1)
    best, worst = (np.mean(coverage(figure, grid, phase) > 0) for phase in ("best", "worst"))
    rate = figure.path_rate(grid)
    phase_of_picture = 2 * np.pi * np.arange(round(rate)) / rate
    for phase in np.linspace(0.0, np.pi / 20, 16):
        x, y = 0.1 * np.sin(37 * phase_of_picture + phase), 0.1 * np.sin(20 * phase_of_picture)
        fill = np.mean(map_samples(x, y, x, grid).coverage > 0)
        assert worst - 0.01 <= fill <= best + 0.05  # the best figure is symmetric: some traces share pixels
    assert worst < best - 0.1


def test_the_largest_gap_is_the_largest_empty_disc() -> None:
    rng = np.random.default_rng(0)
    visited = rng.random((30, 40)) < 0.02
    rows, columns = np.indices(visited.shape)
    to_each = [np.hypot(rows - i, columns - j) for i, j in np.argwhere(visited)]
    assert largest_gap(visited) == pytest.approx(2 * np.min(to_each, axis=0).max() - 1)
    assert largest_gap(np.ones((3, 3), bool)) == 0.0
    assert largest_gap(np.zeros((3, 3), bool)) == math.inf


def test_the_gap_decreases_to_that_of_the_complete_picture() -> None:
    figure, grid = LissajousFigure((23, 17), 2.0, (0.1, 0.1)), Grid(120, 100, 0.1, 0.1)
    rate = figure.path_rate(grid)
    x, y = figure.angles(rate, PHASES["best"])
    gaps = gap_against_time(x, y, rate, grid, np.linspace(0.0, x.size / rate, 9))
    assert gaps[0] == math.inf
    assert np.all(np.diff(gaps[1:]) <= 0)
    assert gaps[-1] == largest_gap(map_samples(x, y, x, grid).coverage > 0)


@given(st.floats(500, 900), st.floats(100, 400), st.floats(1, 60), st.floats(0, 0.02))
def test_figures_lie_in_both_bands_and_repeat_at_the_frame_rate(x: float, y: float, rate: float, width: float) -> None:
    span_x, span_y = (x, x * (1 + width)), (y, y * (1 + width))
    for (n_x, n_y), frame_rate in enumerate_figures(span_x, span_y, rate):
        assert math.gcd(n_x, n_y) == 1
        assert rate <= frame_rate <= rate * (1 + MAX_RATE_EXCESS) * (1 + 1e-12)
        for n, (low, high) in ((n_x, span_x), (n_y, span_y)):
            assert low * (1 - 1e-12) <= n * frame_rate <= high * (1 + 1e-12)


def test_bands_of_a_scanner_without_a_resonance_begin_at_rest() -> None:
    figures = dict(enumerate_figures((0.0, 40.0), (0.0, 30.0), 10.0))
    assert (3, 2) in figures
    assert all(n_x >= 1 and n_y >= 1 for n_x, n_y in figures)


def test_bands_shrink_with_the_margin_and_a_message_states_the_largest_amplitude() -> None:
    band = SustainedBand("x", np.array([100.0, 101.0, 103.0]), np.array([0.1, 0.2, 0.0]), 2)
    assert band.motion_frequencies_reaching(0.15, 0.0) == pytest.approx((50.25, 50.75))
    low, high = band.motion_frequencies_reaching(0.15, 0.002)
    assert (low, high) == pytest.approx((50.25 * 1.001, 50.75 * 0.999), rel=1e-6)
    for half, margin in ((0.25, 0.0), (0.15, 0.05)):
        with pytest.raises(BadInput, match=r"sustains 0.2 rad"):
            band.motion_frequencies_reaching(half, margin)


def test_a_linear_drive_moves_the_mirror_at_the_drive_frequency() -> None:
    axis = replace(devices.load("imaging").axes["x"], drive=Drive("linear", 1e-9))
    band = find_sustained_band(axis, 10.0, 0.0)
    mechanics = axis.require_mechanics()
    assert band.drive_per_motion == 1
    assert band.amplitude_at(axis.resonance) == pytest.approx(
        1e-8 / (mechanics.b * 2 * np.pi * axis.resonance), rel=1e-4
    )


def test_a_drive_below_the_threshold_is_refused() -> None:
    with pytest.raises(BadInput, match="nothing oscillates"):
        find_sustained_band(devices.load("imaging").axes["x"], 5.0, 5.0)


@pytest.mark.slow
def test_the_simulation_of_the_first_pair_has_the_designed_amplitude_and_fill(
    tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    arguments = ["--pixels", "100x80", "--frame-rate", "60", "--fill", "0.9", "--rate", "1e6", "--json"]
    assert main(["design", "-o", str(tmp_path / "out"), *arguments]) == 0
    summary = json.loads(capsys.readouterr().out)
    assert {path.name for path in (tmp_path / "out").iterdir()} == {"summary.json", "report.html"}
    assert json.loads((tmp_path / "out" / "summary.json").read_text()) == summary
    assert (tmp_path / "out" / "report.html").read_text().count('src="data:image') == 4
    assert summary["conclusion"].startswith("Drive x at ")
    first = summary["candidates"][0]
    assert first["frame_rate"] >= 60
    assert any("skips pixels" in note for note in summary["notes"])
    device, drive = devices.load("imaging"), first["drive_hz"]
    plan = Plan({axis: Sine(drive[axis], 30.0, 30.0) for axis in "xy"}, 1 / first["frame_rate"], 1e6)
    _, truth = simulate(device, plan)
    x, y = (np.asarray(truth[f"angle_{axis}"][0], np.float64) for axis in "xy")
    for axis, angle in (("x", x), ("y", y)):
        assert np.abs(angle).max() == pytest.approx(first["amplitude_rad"][axis], rel=0.01)
    fill = fill_against_time(x, y, 1e6, Grid(100, 80, 0.18, 0.18))[1][-1]
    assert first["fill"]["worst"] - 0.01 < fill < first["fill"]["best"] + 0.01
    frequency_below_band = summary["bands"]["x"]["sustained_hz"][0] - 20.0
    with pytest.raises(BadInput, match="does not sustain"):
        simulate(
            device, replace(plan, drives={axis: Sine(frequency_below_band, 30.0, 30.0) for axis in "xy"}, settle=0.1)
        )


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--fill", "1.5"], "a fill of 1.5"),
        (["--margin", "0.5"], "a margin of 0.5"),
        (["--device", "nothing"], "there are"),
        (["--device", "chen2019", "--half-angles", "0.1,0.1"], "add the table [y]"),
        (["--volts", "5,5"], "nothing oscillates"),
        (["--half-angles", "1e-12,0.1"], "the scan visits no pixel"),
        (["--frame-rate", "0.001", "--beam-path"], "a picture at 0.001 Hz takes 1.39e+07 cycles; give a frame rate of"),
        (["--rate", "1"], "1 samples a second at 15 pictures a second; give a picture 2 to 5e+07 samples"),
    ],
)
def test_impossible_designs_are_refused_in_one_line(
    arguments: list[str], words: str, tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    assert main(["design", "-o", str(tmp_path / "out"), *arguments]) == 2
    captured = capsys.readouterr()
    assert words in captured.err
    assert captured.err.count("\n") == 1
    assert not list(tmp_path.iterdir())


def test_the_fill_at_the_worst_phase_is_below_that_at_the_best() -> None:
    requirements = ScanRequirements(Grid(200, 200, 0.18, 0.16), 30.0, 1.0, 1e6)
    _, candidates = design(devices.load("imaging"), requirements, (30.0, 30.0))
    assert all(candidate.fill["worst"] <= candidate.fill["best"] for candidate in candidates)
    fills = [candidate.fill["worst"] for candidate in candidates]
    assert len(set(fills)) > 1
    assert fills == sorted(fills, reverse=True)  # none reaches the required fill


def test_the_worst_fill_of_skipping_samples_holds_at_any_phase_and_instant() -> None:
    """361.6 samples in a cycle of x: at some phases neighbouring cycles visit the same pixels."""
    grid = Grid(400, 400, 0.18, 0.18)
    requirements = ScanRequirements(grid, 16.0, 0.65, 5e6)
    first = design(devices.load("imaging"), requirements, (30.0, 30.0))[1][0]
    (n_x, n_y), rate = first.figure.windings, first.figure.frame_rate
    fills = []
    for start in np.random.default_rng(7).random((20, 2)):
        turn = 2 * np.pi * rate * (np.arange(round(5e6 / rate)) + start[0]) / 5e6
        x = first.figure.amplitude[0] * np.sin(n_x * turn + np.pi * start[1] / n_y)
        y = first.figure.amplitude[1] * np.sin(n_y * turn)
        fills.append(np.mean(map_samples(x, y, x, grid).coverage > 0))
    assert min(fills) > first.fill["worst"] - 0.03
    assert max(fills) < first.fill["best"] + 0.03
    assert max(fills) - min(fills) > 0.1
    assert first.fill_reached(0.65) == "at the best phase"


def test_an_infinite_frame_rate_is_refused() -> None:
    with pytest.raises(BadInput, match="frame rate"):
        ScanRequirements(Grid(10, 10, 0.1, 0.1), math.inf)
