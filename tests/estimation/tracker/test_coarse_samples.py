"""The angle of a motion between its knots, at sample rates at which a segment lasts for many periods."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from estimation.estimate import estimate
from estimation.reference import absolute_reference
from estimation.tracker.angle_synthesis import SEGMENT_SAMPLES, PhasorAngle, PhasorMotion
from recon.imaging.gridding import accumulate_samples
from recon.imaging.intensity_gridding import grid_intensity
from recon.imaging.picture import Grid
from scanner.channel import make_channel
from scanner.device import Axis, Device
from scanner.motion import AxisMotion, Motion
from scanner.recording import Recording
from scanner.stages import Drive, Mechanics, Position

F0_HZ, QUALITY, AMPLITUDE_RAD, VOLTAGE_V, INERTIA, NOISE_SD_V = 2000.0, 100.0, 0.1, 5.0, 1e-12, 0.002
RATE = 2 * np.pi * F0_HZ


def stopped_drive(periods: int, samples_per_period: int) -> tuple[Recording, np.ndarray]:
    """A steady oscillation and a free decay from 0.6 of the recording on, and the exact angle [rad]."""
    k, fs = INERTIA * RATE**2, samples_per_period * F0_HZ
    drive = Drive("linear", torque_per_volt=k * AMPLITUDE_RAD / QUALITY / VOLTAGE_V)
    readout = Position(gain=1.0 / AMPLITUDE_RAD, noise_sd=NOISE_SD_V)
    axis = Axis(Mechanics(INERTIA, INERTIA * RATE / QUALITY, k), drive=drive, readout=readout, name="x")
    time = np.arange(periods * samples_per_period) / fs
    loss = RATE / (2 * QUALITY)
    free, after = np.sqrt(RATE**2 - loss**2), time - round(0.6 * periods) / F0_HZ
    on, decay = after < 0.0, np.exp(-loss * np.maximum(after, 0.0))
    falling = -AMPLITUDE_RAD * decay * (np.cos(free * after) + loss / free * np.sin(free * after))
    angle = np.where(on, -AMPLITUDE_RAD * np.cos(RATE * time), falling)
    sense = readout.gain * angle + NOISE_SD_V * np.random.default_rng(0).normal(size=time.size)
    voltage = np.where(on, VOLTAGE_V * np.sin(RATE * time), 0.0)
    channels = {"drive_x": (voltage, "V", fs), "sense_x": (sense, "V", fs)}
    return Recording.from_arrays(channels, Device("stopped", {"x": axis})), angle


@pytest.mark.parametrize("samples_per_period", [12, 25, 50])
def test_the_angle_follows_a_decay_within_a_segment_of_many_periods(samples_per_period: int) -> None:
    """With 12 samples a period the angle near the stop was 9 % of the amplitude off, with 50 samples 4 %."""
    recording, angle = stopped_drive(150, samples_per_period)
    error = estimate(recording, recording.device, "tracker").axes["x"].angle.read() - angle
    assert np.abs(error).max() < 0.01 * AMPLITUDE_RAD


def decaying(rate: float, size: int, amplitude: float, frequency: float) -> PhasorAngle:
    """A motion whose amplitude stays for half of the time and decays by exp(-300 t) then."""
    time = np.linspace(0.0, size / rate, 101)
    fall = np.where(time > 0.5 * time[-1], -300.0, 0.0)
    log = np.log(amplitude) + fall * (time - 0.5 * time[-1])
    zero, lines = np.zeros(time.size), np.tile([-1j, 1e-3, 1e-5], (time.size, 1))
    reference = absolute_reference(frequency, time[0], time[-1])
    return PhasorAngle(PhasorMotion(reference, time, zero, zero, log, fall, lines), rate, 0.0, size)


def test_a_picture_of_coarse_samples_has_the_pixels_of_the_angles() -> None:
    rate, size = 24e3, 6000
    x, y = decaying(rate, size, 0.17, 2000.0), decaying(rate, size, 0.15, 1370.0)
    time, values, grid = np.arange(size) / rate, np.arange(float(size)), Grid(200, 200, 0.18, 0.18)
    exact = [each.motion.angle(time) for each in (x, y)]
    expected = accumulate_samples(*exact, values, grid)
    still = np.zeros(2)
    beam = Motion(
        {name: AxisMotion(still, still, still, still, still, each) for name, each in (("x", x), ("y", y))}, ""
    )
    picture = grid_intensity(beam, make_channel("intensity", values, unit="V", sample_rate=rate), grid, [])
    differ = np.count_nonzero(picture.coverage != expected[1])
    assert differ < 0.002 * size  # a line is used where it is within 1e-4 of the amplitude
    for first, stop in ((0, 700), (2900, 3300), (5000, size)):
        parts = [each.read(first, stop) for each in (x, y)]
        for part, whole in zip(parts, exact, strict=True):
            assert np.abs(part - whole[first:stop]).max() < 1e-4


def test_segments_of_fine_samples_are_lines() -> None:
    fine = decaying(5e6, 1 << 17, 0.17, 14_000.0)
    middle = fine.size // 2
    assert fine.is_in_segments(0, middle - SEGMENT_SAMPLES * 10)
    assert fine.is_in_segments(middle + SEGMENT_SAMPLES * 10, fine.size)
    assert_array_equal(fine.read(100, 100), np.empty(0))
