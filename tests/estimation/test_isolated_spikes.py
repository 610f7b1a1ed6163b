"""Single samples far from their neighbours are found and replaced; steps, noise and coarse sampling are no spikes."""

import numpy as np
import pytest

from estimation.filters.baselines import estimate_from_sensor
from estimation.isolated_spikes import MAX_RUN_SAMPLES, find_dropouts, find_spikes
from scanner.channel import READ_CHUNK_SAMPLES, Channel, make_channel
from scanner.device import Axis, Device
from scanner.recording import Recording
from scanner.stages import Position

RATE_HZ, FREQUENCY_HZ = 1e6, 2e3
TIME = np.arange(40_000) / RATE_HZ
SINE = np.sin(2.0 * np.pi * FREQUENCY_HZ * TIME)
NOISE = np.random.default_rng(0).standard_normal(TIME.size)
AT = np.sort(np.random.default_rng(1).choice(np.arange(9, TIME.size - 9, 3), 200, replace=False))


def with_spikes(values: np.ndarray) -> np.ndarray:
    spiked = values.copy()
    spiked[AT] = 3.0 * np.where(AT % 2, 1.0, -1.0)
    return spiked


def channel(values: np.ndarray) -> Channel:
    return make_channel("sense_x", values, unit="V", sample_rate=RATE_HZ)


def test_spikes_are_found_and_replaced_to_the_noise() -> None:
    spikes = find_spikes(channel(with_spikes(SINE + 1e-3 * NOISE)))
    np.testing.assert_array_equal(spikes.at, AT)
    assert np.abs(spikes.values - SINE[AT]).max() < 6e-3


def test_spikes_are_found_where_two_parts_of_a_long_signal_meet() -> None:
    at = READ_CHUNK_SAMPLES + np.array([-8, 0, 4, 9, 20])
    time = np.arange(READ_CHUNK_SAMPLES + 40) / RATE_HZ
    sine = np.sin(2.0 * np.pi * FREQUENCY_HZ * time)
    values = sine + 1e-3 * np.random.default_rng(2).standard_normal(time.size)
    values[at] = 3.0
    spikes = find_spikes(channel(values))
    np.testing.assert_array_equal(spikes.at, at)
    assert np.abs(spikes.values - sine[at]).max() < 6e-3


@pytest.mark.parametrize(
    "values",
    [
        SINE,
        SINE + 0.1 * NOISE,
        np.round(100.0 * SINE),
        np.sin(2.0 * np.pi * 0.3 * np.arange(4_000)),
        (TIME * 1e3) % 1.0 + 1e-4 * NOISE,
        np.where(TIME < 0.02, 0.0, 1.0) + 1e-4 * NOISE,
        np.cumsum(NOISE),
        np.zeros(100),
        np.full(100, np.nan),
        SINE[:6],
        np.clip(SINE + 1e-4 * NOISE, -0.9, 0.9),
        np.clip(SINE[::20] + 1e-4 * NOISE[::20], -0.9, 0.9),
        np.clip(SINE[::4] + 1e-2 * NOISE[::4], -0.7, 0.7),
    ],
    ids=[
        "sine",
        "noise",
        "coarse",
        "few samples a period",
        "sawtooth",
        "step",
        "walk",
        "zero",
        "missing",
        "short",
        "clipped",
        "clipped, few samples",
        "clipped for half of the time, noise",
    ],
)
def test_other_signals_have_no_spikes(values: np.ndarray) -> None:
    assert not find_spikes(channel(values)).at.size


def test_spikes_of_a_clipped_signal_are_found() -> None:
    """A spike is larger than the rail, so that the rail is not the largest value."""
    clipped = np.clip(SINE + 1e-4 * NOISE, -0.9, 0.9)
    spiked = clipped.copy()
    at = 250 + 500 * np.arange(60)  # at zero crossings
    spiked[at] = 3.0
    np.testing.assert_array_equal(find_spikes(channel(spiked)).at, at)


def test_the_sensor_is_as_accurate_as_it_states_in_spite_of_spikes() -> None:
    device = Device("lever", {"x": Axis(readout=Position(1.0, 1e-3), name="x")})
    recording = Recording.from_arrays({"sense_x": (with_spikes(SINE + 1e-3 * NOISE), "V", RATE_HZ)}, device)
    motion = estimate_from_sensor(recording, device)
    axis = motion.axes["x"]
    error = axis.phase - axis.phase.mean()  # the frequency of the reference is that of the motion, but for the noise
    error -= np.polyval(np.polyfit(axis.time, error, 1), axis.time)
    assert np.sqrt(np.mean(error**2)) < 1.5 * axis.phase_sd.max()
    assert axis.amplitude == pytest.approx(1.0, abs=1e-3)
    (note,) = motion.notes
    assert note.startswith("sense_x: 200 single samples far from the samples around, the first at ")


STARTS = np.sort(np.random.default_rng(3).choice(np.arange(20, TIME.size - 40, 40), 60, replace=False))


def with_dropouts(values: np.ndarray, length: int) -> np.ndarray:
    dropped = values.copy()
    for start in STARTS:
        dropped[start : start + length] = 0.0
    return dropped


@pytest.mark.parametrize("length", [2, 3, MAX_RUN_SAMPLES])
def test_dropouts_are_found_where_they_are_far_from_the_signal(length: int) -> None:
    runs = find_dropouts(channel(with_dropouts(SINE + 1e-3 * NOISE, length)))
    far = np.minimum(np.abs(SINE[STARTS]), np.abs(SINE[STARTS + length - 1])) > 0.03
    assert {(int(start), int(start) + length) for start in STARTS[far]} <= set(runs)
    assert {start for start, _ in runs} <= set(STARTS.tolist())


def test_dropouts_are_found_once_where_two_parts_of_a_long_signal_meet() -> None:
    time = np.arange(READ_CHUNK_SAMPLES + 60) / RATE_HZ
    values = (
        2.0 + np.sin(2.0 * np.pi * FREQUENCY_HZ * time) + 1e-3 * np.random.default_rng(2).standard_normal(time.size)
    )
    starts = READ_CHUNK_SAMPLES + np.array([-22, -6, 1, 8])
    for start in starts:
        values[start : start + 3] = 0.0
    assert find_dropouts(channel(values)) == [(start, start + 3) for start in starts]


@pytest.mark.parametrize(
    "values",
    [
        SINE,
        SINE + 0.1 * NOISE,
        np.round(100.0 * SINE),
        np.round(10.0 * SINE),
        np.round(10.0 * np.sin(2.0 * np.pi * 100.0 * TIME)),
        np.round(10.0 * np.sin(2.0 * np.pi * 400.0 * TIME) + 0.3 * NOISE),
        np.sin(2.0 * np.pi * 0.3 * np.arange(4_000)),
        np.repeat(SINE[::6], 6),
        np.repeat(SINE[::15], 15) + 1e-4 * np.resize(NOISE, 15 * SINE[::15].size),
        (TIME * 1e3) % 1.0 + 1e-4 * NOISE,
        np.interp(TIME * 1e3 % 1.0, [0.0, 0.995, 1.0], [0.0, 1.0, 0.0]) + 1e-2 * NOISE,
        np.where(TIME < 0.02, 0.0, 1.0) + 1e-4 * NOISE,
        np.convolve(np.where(TIME < 0.02, 0.0, 1.0), np.hanning(7) / 3.0, "same") + 1e-4 * NOISE,
        np.cumsum(NOISE),
        np.zeros(100),
        np.full(100, np.nan),
        np.full(100, np.inf),
        1e300 * SINE,
        SINE[:6],
        SINE[:1],
        np.clip(SINE + 1e-4 * NOISE, -0.9, 0.9),
        np.clip(SINE[::20] + 1e-4 * NOISE[::20], -0.9, 0.9),
        np.clip(SINE[::4] + 1e-2 * NOISE[::4], -0.7, 0.7),
        np.where(np.arange(TIME.size) % 37 == 5, np.nan, SINE + 1e-3 * NOISE),
    ],
)
@pytest.mark.filterwarnings("error")
def test_other_signals_have_no_dropouts(values: np.ndarray) -> None:
    assert find_dropouts(channel(values)) == []


def test_the_sensor_is_as_accurate_as_it_states_in_spite_of_dropouts() -> None:
    device = Device("lever", {"x": Axis(readout=Position(1.0, 1e-3), name="x")})
    recording = Recording.from_arrays({"sense_x": (with_dropouts(SINE + 1e-3 * NOISE, 3), "V", RATE_HZ)}, device)
    motion = estimate_from_sensor(recording, device)
    axis = motion.axes["x"]
    assert np.abs(axis.angle.read(0, TIME.size) - SINE).max() < 0.03
    assert axis.amplitude == pytest.approx(1.0, abs=1e-3)
    assert "runs of 3 samples far from the samples around, the first at" in motion.notes[0]
    assert "missing samples" in motion.notes[1]


@pytest.mark.parametrize("dtype", ["f8", "f4"])
@pytest.mark.parametrize("frame_hz", [25.0, 37.3, 1000.0])
@pytest.mark.parametrize("turn", [0.5, 0.9])
def test_rounding_of_a_ramp_is_neither_spike_nor_dropout(dtype: str, frame_hz: float, turn: float) -> None:
    cycle = np.arange(80_000) / RATE_HZ * frame_hz % 1.0
    ramp = np.where(cycle < turn, 2.0 * cycle / turn - 1.0, 1.0 - 2.0 * (cycle - turn) / (1.0 - turn))
    signal = channel((1.65 + ramp).astype(dtype) if dtype == "f4" else ramp)
    assert find_spikes(signal).at.size == 0
    assert find_dropouts(signal) == []


def test_a_spike_of_a_ramp_without_noise_is_found() -> None:
    ramp = 2.0 * (np.arange(80_000) / RATE_HZ * 25.0 % 1.0) - 1.0
    ramp[[1_234, 50_000]] += 0.1
    np.testing.assert_array_equal(find_spikes(channel(ramp)).at, [1_234, 50_000])
