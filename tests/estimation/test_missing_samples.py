"""Missing samples of a position signal: short gaps are interpolated to the noise, long ones have no angle."""

import numpy as np
import pytest

from estimation.filters.baselines import estimate_from_sensor
from estimation.missing_samples import MAX_FILLED_GAP_PERIODS, fill_missing
from scanner.channel import make_channel
from scanner.device import Axis, Device
from scanner.errors import BadInput
from scanner.motion import Motion
from scanner.recording import Recording
from scanner.stages import Position

RATE_HZ, FREQUENCY_HZ, NOISE_SD = 1e6, 2e3, 1e-3
TIME = np.arange(40_000) / RATE_HZ
SINE = np.sin(2.0 * np.pi * FREQUENCY_HZ * TIME + 0.4)
NOISE = np.random.default_rng(0).normal(0.0, NOISE_SD, TIME.size)


def motion_of(values: np.ndarray) -> Motion:
    device = Device("lever", {"x": Axis(readout=Position(1.0, NOISE_SD), name="x")})
    return estimate_from_sensor(Recording.from_arrays({"sense_x": (values, "V", RATE_HZ)}, device), device)


def without(*gaps: tuple[int, int]) -> np.ndarray:
    values = SINE + NOISE
    for first, stop in gaps:
        values[first:stop] = np.nan
    return values


@pytest.mark.parametrize(("samples_a_period", "gap"), [(20, 1), (100, 6), (500, 31), (500, 2)])
def test_the_polynomial_is_as_accurate_as_its_docstring_says(samples_a_period: int, gap: int) -> None:
    assert gap <= MAX_FILLED_GAP_PERIODS * samples_a_period
    for phase in np.linspace(0.0, 2 * np.pi, 20):
        sine = np.sin(2 * np.pi * np.arange(200) / samples_a_period + phase)
        values = sine.copy()
        values[100 : 100 + gap] = np.nan
        filled = fill_missing(make_channel("sense_x", values, unit="V", sample_rate=RATE_HZ), gap)
        assert (filled.filled, filled.left_out, filled.at.tolist()) == (gap, [], list(range(100, 100 + gap)))
        assert np.abs(filled.values - sine[filled.at]).max() < 5e-5


def test_scattered_missing_samples_change_the_motion_by_less_than_the_noise() -> None:
    lost = np.unique(np.random.default_rng(1).integers(0, TIME.size, 2000))
    values = SINE + NOISE
    values[lost] = np.nan
    motion = motion_of(values)
    error = motion.axes["x"].angle.read() - SINE
    assert np.std(error[lost[5:-5]]) < 2.0 * NOISE_SD
    assert any(f"interpolated {lost.size} missing samples (4.9%)" in note for note in motion.notes)
    assert motion.axes["x"].phase_sd.max() < 1e-3


def test_a_long_gap_has_no_angle_and_leaves_the_rest_as_it_is() -> None:
    motion = motion_of(without((20_000, 26_000), (5, 8), (30_000, 30_001)))
    angle = motion.axes["x"].angle.read()
    assert np.isnan(angle[20_000:26_000]).all()
    assert np.isfinite(np.delete(angle, np.s_[20_000:26_000])).all()
    assert np.abs(np.delete(angle, np.s_[20_000:26_000]) - np.delete(SINE, np.s_[20_000:26_000])).max() < 8 * NOISE_SD
    assert [note.split("; ")[0] for note in motion.notes] == [
        "sense_x: interpolated 4 missing samples (0.01%) in short gaps from the samples around",
        "sense_x: left out 6000 missing samples (15%) in 1 gap too long to interpolate",
    ]


def test_gaps_at_the_ends_are_not_extrapolated() -> None:
    angle = motion_of(without((0, 2), (39_999, 40_000))).axes["x"].angle.read()
    assert np.isnan(angle[[0, 1, -1]]).all()
    assert np.isfinite(angle[2:-1]).all()


def test_a_ramp_without_a_frequency_keeps_its_samples_beside_a_gap() -> None:
    ramp = np.linspace(-1.0, 1.0, TIME.size) + NOISE
    ramp[[700, 20_000]] = np.nan
    ramp[30_000:30_010] = np.nan
    angle = motion_of(ramp).axes["x"].angle.read()
    assert np.isnan(angle).sum() == 10
    assert angle[700] == pytest.approx(ramp[699], abs=8 * NOISE_SD)


def test_a_signal_with_a_gap_in_every_part_is_refused() -> None:
    gaps = [(first, first + 300) for first in range(0, TIME.size, 1000)]
    with pytest.raises(BadInput, match="sense_x: stands at one value, or lacks samples, in nearly all"):
        motion_of(without(*gaps))


@pytest.mark.parametrize("first", range(20_000, 20_500, 50))
def test_samples_beside_a_long_gap_are_no_spikes(first: int) -> None:
    """The corner of the straight line through a gap was one: good samples were replaced, with advice on the cable."""
    values = SINE + 0.02 * NOISE
    values[first : first + 6_100] = np.nan
    assert [note.split(": ")[1][:8] for note in motion_of(values).notes] == ["left out"]
