"""Segments in which a signal of a resonant motion stands at one value are found, whatever the type and the chunks."""

import numpy as np
import pytest

from estimation.complete_diagnosis import diagnose_with_optics
from estimation.device_fit.predict import predict
from estimation.filters.baselines import estimate_from_sensor
from estimation.held_samples import find_held_runs, held_while_driven, slowest_motions, without_held_samples
from scanner.channel import READ_CHUNK_SAMPLES, Channel, make_channel
from scanner.device import Axis, Device
from scanner.errors import BadInput
from scanner.recording import Recording
from scanner.stages import Drive, Mechanics, Position

RATE_HZ, FREQUENCY_HZ = 1e6, 1e3
SAMPLES = 3 * READ_CHUNK_SAMPLES
RUNS = [(0, 1_000), (READ_CHUNK_SAMPLES - 600, READ_CHUNK_SAMPLES + 600), (SAMPLES - 1_500, SAMPLES)]


def held(dtype: type = np.float64) -> Channel:
    """A sine of 1000 samples a period that stands still three times, and once for less than a period."""
    values = np.round(1000.0 * np.sin(2.0 * np.pi * FREQUENCY_HZ / RATE_HZ * (np.arange(SAMPLES) + 0.3)))
    for first, stop in [*RUNS, (50_000, 50_999)]:
        values[first:stop] = 3000.0
    return make_channel("sense_x", values.astype(dtype), unit="V", sample_rate=RATE_HZ, gain=1e-3)


@pytest.mark.parametrize("dtype", [np.float64, np.float32, np.int16])
def test_runs_of_a_period_are_found_also_across_chunks_and_at_both_ends(dtype: type) -> None:
    channel = held(dtype)
    assert find_held_runs(channel, FREQUENCY_HZ) == RUNS
    missing = np.isnan(without_held_samples(channel, FREQUENCY_HZ).read())
    assert np.flatnonzero(np.diff(missing, prepend=False, append=False)).reshape(-1, 2).tolist() == [
        list(run) for run in RUNS
    ]
    part = without_held_samples(channel, FREQUENCY_HZ).read(READ_CHUNK_SAMPLES, READ_CHUNK_SAMPLES + 1_000)
    assert np.isnan(part[:600]).all()
    np.testing.assert_array_equal(part[600:], channel.read(READ_CHUNK_SAMPLES + 600, READ_CHUNK_SAMPLES + 1_000))


def test_missing_samples_are_no_held_ones() -> None:
    channel = make_channel("sense_x", np.full(5_000, np.nan), unit="V", sample_rate=RATE_HZ)
    assert find_held_runs(channel, FREQUENCY_HZ) == []


def test_a_channel_that_moves_is_returned_as_it_is() -> None:
    values = np.sin(2.0 * np.pi * FREQUENCY_HZ / RATE_HZ * np.arange(5_000))
    channel = make_channel("sense_x", values, unit="V", sample_rate=RATE_HZ)
    assert without_held_samples(channel, FREQUENCY_HZ) is channel


def lever_recording(drive_V: float) -> Recording:
    """A lever at its resonance of 1 kHz whose sensor stands still for 2 ms."""
    rate = 2.0 * np.pi * FREQUENCY_HZ
    mechanics = Mechanics(1e-10, 1e-10 * rate / 50.0, 1e-10 * rate**2)
    lever = Axis(mechanics, drive=Drive("linear", 1e-8), readout=Position(1.0, 1e-3), name="x")
    time = np.arange(20_000) / RATE_HZ
    sensed = np.sin(rate * time)
    sensed[8_000:10_000] = sensed[8_000]
    channels = {"drive_x": (drive_V * np.cos(rate * time), "V", RATE_HZ), "sense_x": (sensed, "V", RATE_HZ)}
    return Recording.from_arrays(channels, Device("lever", {"x": lever}))


def test_a_signal_that_stands_still_under_a_drive_is_not_diagnosed() -> None:
    with pytest.raises(BadInput, match=r"sense_x.*stands at one value from 0.008 to 0.01 s while the axis is driven"):
        diagnose_with_optics([lever_recording(1.0)])


def test_equal_values_without_a_drive_are_those_of_a_motion_below_the_resolution() -> None:
    recording = lever_recording(0.0)
    assert recording.device is not None
    assert held_while_driven(recording, recording.device) is None


def test_a_prediction_is_not_compared_with_samples_of_a_sensor_that_stands_still_under_a_drive() -> None:
    driven, free = (lever_recording(drive_V) for drive_V in (1.0, 0.0))
    assert driven.device is not None
    predicted = predict(driven, driven.device)["sense_x"]
    assert predicted.left_out == 2_000
    assert np.isnan(predicted.measured[8_000:10_000]).all()
    others = np.r_[0:8_000, 10_000:20_000]
    difference = (predicted.values - driven["sense_x"].read())[others]
    assert predicted.rmse == pytest.approx(np.sqrt(np.nanmean(difference**2)))
    assert predict(free, driven.device)["sense_x"].left_out == 0


def test_the_sensor_counts_held_samples_neither_in_phase_nor_in_amplitude() -> None:
    recording = lever_recording(1.0)
    assert recording.device is not None
    motion = estimate_from_sensor(recording, recording.device)
    lever = motion.axes["x"]
    np.testing.assert_allclose(lever.amplitude, 1.0, rtol=1e-6)
    np.testing.assert_allclose(lever.phase - lever.phase[0], 0.0, atol=1e-6)
    assert lever.known.tolist() == [True, True, False, True, True]  # blocks of 4 ms
    assert lever.phase_sd[lever.known].max() < 1e-3
    assert np.isnan(lever.angle.read()[8_000:10_000]).all()
    assert motion.notes == (
        "sense_x: 2000 samples (0.1 of all) at which it stands at one value are left out of phase, amplitude and "
        "picture",
    )


def test_a_sensor_that_stands_still_throughout_is_refused() -> None:
    recording = lever_recording(1.0)
    sensed = recording["sense_x"].read()
    sensed[4_000:] = sensed[4_000]
    held = recording.with_channel(make_channel("sense_x", sensed, unit="V", sample_rate=RATE_HZ))
    assert recording.device is not None
    with pytest.raises(
        BadInput, match="sense_x: stands at one value, or lacks samples, in nearly all of the recording"
    ):
        estimate_from_sensor(held, recording.device)


@pytest.mark.parametrize(("equal", "expected"), [(7, False), (8, True)])
@pytest.mark.parametrize("at", [0, 500, READ_CHUNK_SAMPLES - 3, READ_CHUNK_SAMPLES + 90])
def test_only_channels_with_equal_samples_in_a_row_are_searched(equal: int, expected: bool, at: int) -> None:
    values = np.arange(READ_CHUNK_SAMPLES + 100) % 1000
    values[at : at + equal] = 2000
    recording = Recording.from_arrays({"angle_x": (values.astype(float), "rad", 1e6)})
    device = Device("stage", {"x": Axis(drive=Drive("linear", 1.0, frequency=1000.0), name="x")})
    assert slowest_motions(recording, device) == ({"angle_x": 1000.0} if expected else {})
