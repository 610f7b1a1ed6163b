"""Signals of the motion that are swapped, doubled or at a wrong rate are named before a picture is made of them."""

from __future__ import annotations

import numpy as np
import pytest

from estimation.estimate import check_finite, estimate
from estimation.signals import phase_reference
from recon.pipeline import reconstruct
from recon.steps.preparation import prepare
from recon.steps.reconstruction import Options
from scanner.angle_tracks import SampledAngle
from scanner.channel import make_channel
from scanner.device import Device
from scanner.device_templates import KnownAxis, new_device
from scanner.errors import BadInput
from scanner.motion import AxisMotion, Motion
from scanner.recording import Recording
from tests.support.simulated import imaging, with_sense

RATE = 1e5
TIME = np.arange(20_000) / RATE
DEVICE = Device.from_toml(new_device("electromagnetic", {"x": KnownAxis(2000.0), "y": KnownAxis(835.0)}))


def scan(frequency_x: float, frequency_y: float, rate: float = RATE, light: int = TIME.size) -> Recording:
    rng = np.random.default_rng(2)
    channels = {
        f"sense_{axis}": (np.sin(2 * np.pi * frequency * TIME) + rng.normal(0, 1e-3, TIME.size), "V", rate)
        for axis, frequency in (("x", frequency_x), ("y", frequency_y))
    }
    return Recording.from_arrays({**channels, "intensity": (rng.poisson(20, light).astype(float), "", rate)}, DEVICE)


def test_swapped_sensors_without_a_drive_are_named() -> None:
    with pytest.raises(BadInput, match=r"sense_x: and sense_y are swapped: they show x at 83"):
        prepare(scan(835.0, 2000.0))


def test_a_time_column_in_the_wrong_unit_is_named() -> None:
    with pytest.raises(BadInput, match=r"as if the sample rate were 0\.001 times the true one"):
        prepare(scan(2000.0, 835.0, 1e-3 * RATE))


def test_one_column_for_both_axes_is_named() -> None:
    recording = scan(2000.0, 835.0)
    same = {name: (recording["sense_x"].read(), "V", RATE) for name in ("sense_x", "sense_y")}
    light = {"intensity": (recording["intensity"].read(), "", RATE)}
    with pytest.raises(BadInput, match="sense_y hold the same samples; check the mapping"):
        prepare(Recording.from_arrays(same | light, DEVICE))


def test_an_intensity_that_covers_half_the_recording_is_noted() -> None:
    assert not prepare(scan(2000.0, 835.0)).clock_notes
    (note,) = prepare(scan(2000.0, 835.0, light=TIME.size // 2)).clock_notes
    assert "intensity: covers 50% of the recording" in note


def test_a_channel_without_meaning_changes_neither_duration_nor_clock() -> None:
    recording = scan(2000.0, 835.0)
    channels = {name: (each.read(), each.unit, RATE) for name, each in recording.channels.items()}
    longer = Recording.from_arrays(channels | {"temperature": (np.full(90, 21.0), "degC", 1.0, -30.0)}, DEVICE)
    assert (longer.start, longer.end) == (recording.start, recording.end)
    assert not prepare(longer).clock_notes


def driven_scan(gain: float = 1.0, rate: float = RATE, dead_from: int = TIME.size) -> Recording:
    """A scan whose x axis lags its drive by 90 degrees, with a sensor of ``gain`` recorded at ``rate``."""
    recording = scan(2000.0, 835.0)
    x = -gain * np.cos(2 * np.pi * 2000.0 * TIME) * (np.arange(TIME.size) < dead_from)
    channels = {name: (recording[name].read(), recording[name].unit, RATE) for name in ("sense_y", "intensity")}
    channels |= {"drive_x": (np.sin(2 * np.pi * 2000.0 * TIME), "V", RATE), "sense_x": (x, "V", rate)}
    return Recording.from_arrays(channels, DEVICE)


@pytest.mark.parametrize("noise", [0.0, 5e-3])
def test_a_drive_that_was_off_is_refused_with_its_other_name(noise: float) -> None:
    decay = driven_scan()
    volts = noise * np.random.default_rng(1).standard_normal(TIME.size)
    dead = decay.with_channel(make_channel("drive_x", volts, unit="V", sample_rate=RATE))
    with pytest.raises(BadInput, match="if the drive was off, as in a free decay, name the channel bias_x"):
        phase_reference(dead, DEVICE, "x")
    channels = {each: (decay[each].read(), decay[each].unit, RATE) for each in ("sense_x", "sense_y", "intensity")}
    free = Recording.from_arrays(channels | {"bias_x": (volts, "V", RATE)}, DEVICE)
    assert phase_reference(free, DEVICE, "x", free["sense_x"]).kind == "absolute"


def test_an_inverted_sensor_is_noted_where_the_drive_shows_it() -> None:
    assert not prepare(driven_scan()).unknown_entries
    (note,) = prepare(driven_scan(-1.0)).unknown_entries
    assert "sense_x: the motion leads drive_x by 90°" in note
    assert "--flip-x" in note


@pytest.mark.parametrize(
    ("gain", "flip", "sign"),
    [(1.0, False, "known: sense_x"), (-1.0, False, "ambiguous"), (-1.0, True, "known: --flip-x")],
)
def test_a_sign_that_the_drive_contradicts_is_ambiguous_unless_the_user_states_it(
    gain: float, flip: bool, sign: str
) -> None:
    motion = reconstruct(driven_scan(gain), Options(pixels=(20, 20), flips={"x": flip}), quiet=True).motion
    assert motion.axes["x"].sign == sign
    assert motion.axes["y"].sign == "known: sense_y"


def test_a_sensor_at_twice_the_rate_of_its_drive_is_named() -> None:
    with pytest.raises(BadInput, match=r"sense_x: moves at 4000.*, 2 times the 2000.* Hz of drive_x; check the sample"):
        prepare(driven_scan(rate=2 * RATE))


def test_a_sensor_in_place_of_the_intensity_is_named() -> None:
    recording = scan(2000.0, 835.0)
    channels = {name: (recording[name].read(), "V", RATE) for name in ("sense_x", "sense_y")}
    with pytest.raises(BadInput, match="sense_x: and intensity hold the same samples"):
        prepare(Recording.from_arrays(channels | {"intensity": channels["sense_x"]}, DEVICE))


def test_misspelt_channels_are_noted_with_the_nearest_name() -> None:
    recording = scan(2000.0, 835.0)
    channels = {name: (each.read(), each.unit, RATE) for name, each in recording.channels.items()}
    (note,) = prepare(Recording.from_arrays(channels | {"drve_x": (TIME, "V", RATE)}, DEVICE)).unknown_entries
    assert note.endswith("drve_x: a channel of this name is not used; is it drive_x?")
    channels["intesity"] = channels.pop("intensity")
    with pytest.raises(BadInput, match="intesity; is it intensity"):
        prepare(Recording.from_arrays(channels, DEVICE))


def test_a_sensor_that_dies_states_an_unknown_phase() -> None:
    motion = estimate(driven_scan(dead_from=TIME.size // 2), DEVICE, "sensor").axes["x"]
    assert motion.phase_sd.max() == pytest.approx(np.pi / np.sqrt(3.0))
    assert np.ptp(motion.amplitude) < 1e-3 * motion.amplitude[0]
    assert motion.phase_sd[: motion.time.size // 3].max() < 0.01


def test_an_estimator_that_diverges_is_refused_in_one_line() -> None:
    unknown = np.full(3, np.nan)
    motion = AxisMotion(TIME[:3], unknown, unknown, unknown, unknown, SampledAngle(unknown, RATE))
    with pytest.raises(BadInput, match="tracker diverges: the signal of x does not fit the device; check units"):
        check_finite(Motion({"x": motion}, "tracker"), scan(2000.0, 835.0))


def test_a_signal_of_both_axes_in_the_wrong_unit_is_refused_in_one_line() -> None:
    """The tracker either diverges or follows drive and picture without the signal, by errors of rounding."""
    millivolts = with_sense(imaging()[0], lambda values: 1000.0 * values)
    with pytest.raises(
        BadInput, match=r"the signal of x (does not fit the device|is 6\d\d times the largest).*; check units"
    ):
        reconstruct(millivolts, Options(), quiet=True)
