"""The recording: reading and writing, slices in time, common clocks, and channels that cannot be used."""

from __future__ import annotations

from math import inf, nan, pi
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from scanner.channel import READ_CHUNK_SAMPLES
from scanner.clock import Clock, on_clock
from scanner.device import Device
from scanner.errors import BadInput, ChannelMissing
from scanner.recording import Recording
from scanner.signal_check import check_signal
from scanner.truth import read_truth

STAGE = 'name = "stage"\n[x.readout]\nkind = "position"\ngain = 2.0\nnoise_sd = 0.1\n'


def ramp(rate: float, start: float, n: int) -> tuple[np.ndarray, str, float, float]:
    """A channel whose value is its time."""
    return start + np.arange(n) / rate, "V", rate, start


@pytest.fixture
def stored(tmp_path: Path) -> Path:
    """A small recording on disk."""
    path = tmp_path / "rec.h5"
    channels = {"sense_x": ramp(1000.0, 0.0, 50), "intensity": (np.arange(80.0).reshape(40, 2), "count", 500.0, 0.01)}
    Recording.from_arrays(channels, Device.from_toml(STAGE), "bench", notes="warm").write(path)
    return path


def test_a_boolean_intensity_is_0_and_1(tmp_path: Path) -> None:
    """The output of a photon counter's discriminator."""
    light = np.random.default_rng(1).random((30, 2)) < 0.3
    path = tmp_path / "rec.h5"
    Recording.from_arrays({"intensity": (light.astype(float), "count", 1e3)}, Device.from_toml(STAGE)).write(path)
    with h5py.File(path, "a") as file:
        stated = dict(file["channels/intensity"].attrs)
        del file["channels/intensity"]
        file["channels/intensity"] = light
        file["channels/intensity"].attrs.update(stated)
    with Recording.open(path) as recording:
        np.testing.assert_array_equal(recording["intensity"].read(5, 20), light[5:20].astype(float))
        assert recording["intensity"].shape == light.shape
        np.testing.assert_array_equal(recording.slice(0.01, 0.02)["intensity"].read(), light[10:20].astype(float))


samples = hnp.arrays(
    st.sampled_from([np.int8, np.int16, np.uint16, np.int32, np.float32, np.float64]), st.integers(1, 40)
)
clocks = st.tuples(st.floats(0.1, 1e7), st.floats(-10, 10))


@settings(deadline=None)  # the machine may be busy
@given(st.dictionaries(st.sampled_from(["sense_x", "drive_y", "temperature"]), st.tuples(samples, clocks), min_size=1))
def test_write_and_open_give_the_same_recording(tmp_path_factory: pytest.TempPathFactory, made: dict) -> None:
    path = tmp_path_factory.mktemp("rec") / "a.h5"
    recording = Recording.from_arrays({name: (values, "V", *clock) for name, (values, clock) in made.items()})
    recording.write(path)
    with Recording.open(path) as back:
        assert set(back.channels) == set(made)
        for name, (values, (rate, start)) in made.items():
            channel = back[name]
            assert (channel.unit, channel.sample_rate, channel.start, channel.shape) == ("V", rate, start, values.shape)
            assert channel.raw.dtype == values.dtype
            np.testing.assert_array_equal(channel.read(), values.astype(float))
    assert [entry.name for entry in path.parent.iterdir()] == ["a.h5"]


def test_recording_has_the_stored_name_device_and_channels(stored: Path) -> None:
    with Recording.open(stored) as recording:
        assert (recording.name, recording.notes, recording.path) == ("bench", "warm", stored)
        assert recording.device == Device.from_toml(STAGE)
        assert (recording.start, recording.end, recording.duration) == (0.0, 0.09, 0.09)
        assert "sense_x" in recording
        assert "sense" not in recording
        assert recording["intensity"].shape == (40, 2)
        np.testing.assert_array_equal(recording["intensity"].read(3, 5), [[6, 7], [8, 9]])
        np.testing.assert_allclose(recording["sense_x"].time(48), [0.048, 0.049])
    assert Recording.from_arrays({"sense": ramp(1, 0, 2)}).device is None


def test_error_of_a_missing_channel_lists_the_present_ones(stored: Path) -> None:
    with Recording.open(stored) as recording, pytest.raises(ChannelMissing) as caught:
        recording.require("drive_x", "the model needs it")
    assert str(caught.value).endswith(
        "rec.h5: drive_x: is not in the recording and the model needs it; it holds intensity, sense_x"
    )
    with pytest.raises(KeyError):
        Recording.from_arrays({"sense": ramp(1, 0, 2)})["sense_x"]


def test_integers_are_stored_and_scaled_on_reading(tmp_path: Path) -> None:
    path = tmp_path / "adc.h5"
    with h5py.File(path, "w") as file:
        file.attrs.update({"format": "lissajous-recording", "version": np.array([1])})
        dataset = file.create_dataset("channels/angle_x", data=np.array([0, 10, 20], np.int16))
        dataset.attrs.update({"unit": np.bytes_("deg"), "sample_rate": 5, "gain": 0.5, "offset": 1.0})
    with Recording.open(path) as recording:
        angle = recording["angle_x"]
        assert angle.unit == "rad"
        np.testing.assert_allclose(angle.read(), np.radians([1.0, 6.0, 11.0]))
        recording.slice(0.2, 1.0).write(tmp_path / "cut.h5")
    with h5py.File(tmp_path / "cut.h5") as file:
        dataset = file["channels/angle_x"]
        np.testing.assert_array_equal(dataset[:], np.array([10, 20], np.int16))
        np.testing.assert_allclose(dataset.attrs["gain"], 0.5 * pi / 180)
        assert dataset.attrs["unit"] == "rad"


def test_scaled_floats_are_written_in_their_unit(tmp_path: Path) -> None:
    # gain and offset belong to integer data: another reader of the form may not look for them on floats
    Recording.from_arrays({"sense_x": (np.array([1.5, 2.5]), "mV", 1.0, 0.0)}).write(tmp_path / "a.h5")
    with h5py.File(tmp_path / "a.h5") as file:
        assert set(file["channels/sense_x"].attrs) == {"unit", "sample_rate", "start"}
        np.testing.assert_allclose(file["channels/sense_x"][:], [0.0015, 0.0025])


@given(st.floats(1, 1e6), st.floats(-2, 2), st.integers(1, 60), st.floats(-0.2, 1.2), st.floats(-0.2, 1.2))
def test_slice_has_the_samples_of_its_interval(rate: float, start: float, n: int, a: float, b: float) -> None:
    recording = Recording.from_arrays({"sense": ramp(rate, start, n)})
    t0, t1 = sorted((start + a * n / rate, start + b * n / rate))
    time = recording["sense"].read()
    eps = 2e-6 / rate  # a sample that close to a cut may fall on either side
    sure = time[(time >= t0 + eps) & (time < t1 - eps)]
    try:
        cut = recording.slice(t0, t1)["sense"]
        read = cut.read()
        np.testing.assert_allclose(cut.time(), read, atol=1e-9)
    except BadInput:
        read = np.zeros(0)
    assert set(sure) <= set(read)
    assert set(read) <= set(time[(time >= t0 - eps) & (time < t1 + eps)])


def test_slice_includes_a_sample_at_its_start_and_slices_can_be_nested() -> None:
    recording = Recording.from_arrays({"sense": ramp(1e6, 0.0, 1000)})
    cuts = [recording.slice(i * 1e-4, (i + 1) * 1e-4)["sense"].size for i in range(10)]
    assert cuts == [100] * 10
    inner = recording.slice(2e-4, 8e-4).slice(3e-4, 4e-4)["sense"]
    np.testing.assert_array_equal(inner.read(), recording["sense"].read(300, 400))
    np.testing.assert_array_equal(inner.read(-2), recording["sense"].read(398, 400))
    assert recording.slice(-inf, inf)["sense"].size == 1000
    with pytest.raises(BadInput, match=r"holds nothing from 2 s to 3 s; it runs from 0 s to 0.001 s"):
        recording.slice(2, 3)


def test_reading_reads_no_more_of_the_file_than_requested(stored: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    sizes = []
    plain = h5py.Dataset.__getitem__

    def spy(self: h5py.Dataset, index: slice) -> np.ndarray:
        values = plain(self, index)
        sizes.append(len(values))
        return values

    monkeypatch.setattr(h5py.Dataset, "__getitem__", spy)
    with Recording.open(stored) as recording:
        cut = recording.slice(0.01, 0.03)["sense_x"]
        assert sizes == []
        cut.read(2, 5)
        on_clock(recording.slice(0.012, 0.02), ["sense_x", "intensity"])
    assert sizes[0] == 3
    assert sum(sizes[1:]) <= 8 + 4


def test_reading_gives_a_fresh_array() -> None:
    values = np.zeros(3)
    recording = Recording.from_arrays({"sense": (values, "V", 1.0, 0.0)})
    recording["sense"].read()[:] = 7.0
    np.testing.assert_array_equal(recording["sense"].read(), values)
    with pytest.raises(TypeError):
        recording.channels["sense"] = None  # type: ignore[index]


@settings(deadline=None)
@given(
    st.lists(st.tuples(st.floats(100, 1e4), st.floats(-0.1, 0.1), st.integers(20, 300)), min_size=1, max_size=3),
    st.none() | st.floats(100, 1e4),
)
def test_ramp_of_time_on_a_common_clock_is_the_time(made: list, rate: float | None) -> None:
    names = ["sense_x", "sense_y", "drive_x"][: len(made)]
    recording = Recording.from_arrays({name: ramp(*channel) for name, channel in zip(names, made, strict=True)})
    first = max(start for _, start, _ in made)
    last = min(start + (n - 1) / channel_rate for channel_rate, start, n in made)
    if last < first:
        with pytest.raises(BadInput, match="no time in common"):
            on_clock(recording, names, rate)
        return
    try:
        clock, values = on_clock(recording, names, rate)
    except BadInput:
        assert last - first < 1 / (
            rate or max(channel_rate for channel_rate, _, _ in made)
        )  # no tick of the clock falls in so short a time
        return
    fuzz = 1e-5 / clock.rate
    assert clock.rate == (rate or max(channel_rate for channel_rate, _, _ in made))
    assert first - fuzz <= clock.time[0] < first + 1 / clock.rate
    assert last - 1 / clock.rate < clock.time[-1] + fuzz <= last + 2 * fuzz
    for name in names:
        np.testing.assert_allclose(values[name], clock.time, atol=1e-9 + fuzz)


def test_channels_of_one_clock_are_not_interpolated() -> None:
    rng = np.random.default_rng(1)
    sense, drive, slow = rng.normal(size=100), rng.normal(size=100), rng.normal(size=(20, 2))
    channels = {
        "sense_x": (sense, "V", 1e6, 0.3),
        "drive_x": (drive, "V", 1e6, 0.3 + 17e-6),
        "intensity": (slow, "", 2e5, 0.3 + 17e-6),
    }
    recording = Recording.from_arrays(channels)
    clock, values = on_clock(recording, ["sense_x", "drive_x"])
    assert clock == Clock(pytest.approx(0.3 + 17e-6), 1e6, 83)
    np.testing.assert_array_equal(values["sense_x"], sense[17:])
    np.testing.assert_array_equal(values["drive_x"], drive[:83])
    _, values = on_clock(recording, ["drive_x", "intensity"])
    np.testing.assert_allclose(values["intensity"][::5], slow, atol=1e-9)
    np.testing.assert_allclose(values["intensity"][2], 0.6 * slow[0] + 0.4 * slow[1])


@pytest.mark.parametrize("rates", [(1e6, 1e6), (1e6, 2.5e5)])
@pytest.mark.parametrize("lag", [0.3, -0.4, 7.25])
def test_common_clock_is_that_of_the_fastest_channel(rates: tuple, lag: float) -> None:
    sense, drive = ramp(rates[0], 0.1, 100), ramp(rates[1], 0.1 + lag / rates[0], 20)
    noise = np.random.default_rng(2).normal(size=100)
    recording = Recording.from_arrays({"sense_x": (noise, *sense[1:]), "drive_x": drive})
    clock, values = on_clock(recording, ["sense_x", "drive_x"])
    first = max(0, int(np.ceil(lag)))
    np.testing.assert_array_equal(values["sense_x"], noise[first : first + clock.size])
    np.testing.assert_allclose(values["drive_x"], clock.time, rtol=0, atol=1e-12)


def test_error_of_channels_without_common_time_states_their_times() -> None:
    recording = Recording.from_arrays({"sense_x": ramp(10, 0, 5), "drive_x": ramp(10, 3, 5)})
    with pytest.raises(BadInput, match=r"no time in common: sense_x 0 to 0.5 s, drive_x 3 to 3.5 s"):
        on_clock(recording, ["sense_x", "drive_x"])


@pytest.mark.parametrize(("rate", "start"), [(1e6, 1.7e9), (1e6, 1e8), (5e6, 1e18), (1e3, -1e300)])
def test_a_start_that_rounds_the_times_of_samples_is_refused(rate: float, start: float) -> None:
    with pytest.raises(BadInput, match=r"samples\); state start from the beginning of the measurement"):
        Recording.from_arrays({"sense_x": (np.arange(10.0), "V", rate, start)})


def test_a_slow_channel_may_count_seconds_since_1970() -> None:
    recording = Recording.from_arrays({"amplitude_x": (np.arange(10.0), "V", 1e3, 1.7e9)})
    assert recording.start == 1.7e9


def test_truth_is_read_by_read_truth_only(tmp_path: Path) -> None:
    path = tmp_path / "sim.h5"
    truth = {
        "x": {"phase": np.arange(3.0), "angle": (np.ones(4), {"sample_rate": 5e6, "start": 0.0})},
        "seed": 7,
        "scene": "usaf",
    }
    Recording.from_arrays({"sense": ramp(1, 0, 2)}).write(path, truth)
    back = read_truth(path)
    assert back is not None
    np.testing.assert_array_equal(back["x"]["phase"], np.arange(3.0))
    np.testing.assert_array_equal(back["x"]["angle"][0], np.ones(4))
    assert (back["x"]["angle"][1], back["seed"], back["scene"]) == ({"sample_rate": 5e6, "start": 0.0}, 7, "usaf")
    with Recording.open(path) as recording:
        assert not [name for name in (*recording.channels, *recording.attrs) if "truth" in name]
        recording.write(tmp_path / "copy.h5")
    assert read_truth(tmp_path / "copy.h5") is None


def test_failed_write_does_not_change_the_existing_file(stored: Path) -> None:
    before = stored.read_bytes()
    with Recording.open(stored) as recording:
        with pytest.raises(TypeError):
            recording.write(stored, truth={"bad": object()})
        with pytest.raises(BadInput, match="the folder to write into does not exist"):
            recording.write(stored.parent / "none" / "a.h5")
        with pytest.raises(BadInput, match="is a folder, not a file"):
            recording.write(stored.parent)
    assert [entry.name for entry in stored.parent.iterdir()] == ["rec.h5"]
    assert stored.read_bytes() == before


@pytest.mark.parametrize("at", [0, 5, READ_CHUNK_SAMPLES - 1, READ_CHUNK_SAMPLES, READ_CHUNK_SAMPLES + 7])
@pytest.mark.parametrize("bad", [nan, inf, -inf])
def test_error_of_a_sample_that_is_not_finite_states_its_time(at: int, bad: float) -> None:
    values = np.sin(np.arange(READ_CHUNK_SAMPLES + 10.0)).astype(np.float32)
    values[[at, -1]] = bad
    signal = Recording.from_arrays({"sense_x": (values, "V", 1e6, 2.0)})["sense_x"]
    with pytest.raises(BadInput) as caught:
        check_signal(signal)
    assert str(caught.value) == (
        f"sense_x: sample {at} at {2 + at / 1e6:.9g} s is not finite, nor is 1 other of {values.size}; "
        "cut the recording there or repair the sample"
    )


def test_constant_signal_is_refused_unless_it_is_allowed() -> None:
    recording = Recording.from_arrays(
        {
            "bias_x": (np.full(READ_CHUNK_SAMPLES + 5, 10.0), "V", 1e6, 0.0),
            "sense_x": (np.repeat([1.0, 1.5], [READ_CHUNK_SAMPLES, 1]), "V", 1e6, 0.0),
            "intensity": (np.array([[1.0, 2.0], [1.0, 2.5]]), "", 1.0, 0.0),
        }
    )
    with pytest.raises(BadInput) as caught:
        check_signal(recording["bias_x"])
    assert str(caught.value) == "bias_x: is constant, 10 V; check that it was connected"
    check_signal(recording["bias_x"], constant_ok=True)
    check_signal(recording["sense_x"])
    check_signal(recording["intensity"])


def test_a_recording_whose_edge_lists_are_empty_lasts_as_long_as_its_channels() -> None:
    edges = (np.array([0.1, 0.2]), "s", {"event": "turn"})
    recording = Recording.from_arrays({"temperature": (np.arange(100.0), "K", 100.0), "sync_x": edges})
    assert (recording.start, recording.end) == (0.1, 0.2)
    later = recording.slice(0.5, 0.9)
    assert (later.start, later.end) == pytest.approx((0.5, 0.9))


def test_a_part_of_a_recording_keeps_the_origin_of_the_whole() -> None:
    recording = Recording.from_arrays({"sense": ramp(1e3, 0.5, 100), "intensity": ramp(1e3, 0.4, 100)})
    assert recording.origin == recording.start == 0.4
    assert recording.part(0.45, 0.5).part(0.46, 0.47).origin == 0.4
    assert recording.part(0.45, 0.5).slice(0.46, 0.47).origin == pytest.approx(0.46)  # a recording by itself
    without = recording.without_channel("intensity")
    assert (without.start, without.origin) == (0.5, 0.4)


def test_a_missing_channel_is_reported_beside_the_edges_that_are_there() -> None:
    recording = Recording.from_arrays(
        {"intensity": (np.ones(10), "V", 1e3), "sync_x": (np.arange(3.0) / 1e3, "s", {"event": "both-edges"})}
    )
    with pytest.raises(BadInput, match=r"it holds intensity, sync_x$"):
        recording.require("drive_x")


@pytest.mark.parametrize("limits", [("a", 0.1), (None, 0.1), (0.0, [0.1]), (0.05, nan), (nan, 0.1)])
def test_limits_of_a_slice_that_are_no_numbers_are_refused(limits: Any) -> None:
    recording = Recording.from_arrays({"sense_x": (np.zeros(100), "V", 1000.0, 0.0)})
    for cut in (recording.slice, recording.part):
        with pytest.raises(BadInput, match=r"give a number|holds nothing from"):
            cut(*limits)
    assert recording.slice(0.05, np.inf)["sense_x"].size == 50
