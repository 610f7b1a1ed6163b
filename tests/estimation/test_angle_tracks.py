"""Every angle track satisfies the protocol of ``scanner.motion``, method by method."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from estimation.optics.correction import BeamAngle
from estimation.reference import absolute_reference
from estimation.tracker.angle_synthesis import PhasorAngle, PhasorMotion
from scanner import angle_tracks
from scanner.angle_tracks import AngleTrack, ChannelAngle, SampledAngle
from scanner.channel import make_channel
from scanner.device import Device
from scanner.motion import AxisMotion

RATE, START, SIZE = 1e5, 0.01, 5000
FREQUENCY, AMPLITUDE = 700.0, 0.1
BENT = Device.from_toml("[x]\n[x.terms.field-distortion]\nc3 = 0.5\n")


def sampled() -> AngleTrack:
    time = START + np.arange(SIZE) / RATE
    return SampledAngle(AMPLITUDE * np.sin(2 * np.pi * FREQUENCY * time), RATE, START)


def synthesised() -> AngleTrack:
    knots = np.linspace(0.0, 0.1, 11)
    zero, log_amplitude = np.zeros(knots.size), np.full(knots.size, np.log(AMPLITUDE))
    harmonics = np.tile([-1j, 0.0, 0.0], (knots.size, 1))
    reference = absolute_reference(FREQUENCY, knots[0], knots[-1])
    motion = PhasorMotion(reference, knots, zero, zero, log_amplitude, zero, harmonics)
    return PhasorAngle(motion, RATE, START, SIZE)


def of_a_channel() -> AngleTrack:
    time = START + np.arange(SIZE) / RATE
    raw = 5.0 * AMPLITUDE * np.sin(2 * np.pi * FREQUENCY * time) - 1.0
    return ChannelAngle(make_channel("angle_x", raw, unit="rad", sample_rate=RATE, start=START, gain=0.2, offset=0.2))


def not_advanced() -> AngleTrack:
    return sampled().advanced(np.array([0.0, 1.0]), np.zeros(2), np.full(2, FREQUENCY))


def beam_of_samples() -> AngleTrack:
    return BeamAngle(sampled(), BENT, "x", START)


def beam_of_phasors() -> AngleTrack:
    return BeamAngle(synthesised(), BENT, "x", START)


TRACKS = [sampled, of_a_channel, not_advanced, synthesised, beam_of_samples, beam_of_phasors]


def expected(make: Callable[[], AngleTrack], time: np.ndarray) -> np.ndarray:
    angle = AMPLITUDE * np.sin(2 * np.pi * FREQUENCY * time)
    return angle * (1.0 + 0.5 * angle**2) if make in (beam_of_samples, beam_of_phasors) else angle


@pytest.mark.parametrize("make", TRACKS)
def test_a_track_has_a_clock_and_any_part_of_it_can_be_read(make: Callable[[], AngleTrack]) -> None:
    track = make()
    assert (track.sample_rate, track.start, track.size) == (RATE, START, SIZE)
    time = START + np.arange(SIZE) / RATE
    np.testing.assert_allclose(track.read(), expected(make, time), atol=1e-9)
    np.testing.assert_allclose(track.read(1000, 1700), track.read()[1000:1700], atol=1e-9)
    np.testing.assert_allclose(track.read(SIZE - 10), track.read()[-10:], atol=1e-9)
    assert track.read(SIZE, SIZE + 5).size == 0


@pytest.mark.parametrize("make", TRACKS)
def test_a_negated_track_has_the_opposite_sign_and_the_same_clock(make: Callable[[], AngleTrack]) -> None:
    track = make()
    negated = track.negated()
    assert (negated.sample_rate, negated.start, negated.size) == (RATE, START, SIZE)
    np.testing.assert_allclose(negated.read(), -track.read(), atol=1e-9)
    np.testing.assert_allclose(negated.negated().read(), track.read(), atol=1e-9)
    still = np.zeros(2)
    axis = AxisMotion(still, still, still, still, still, track).negated()
    np.testing.assert_allclose(axis.angle.read(), -track.read(), atol=1e-9)


@pytest.mark.parametrize("make", TRACKS)
def test_phasors_equal_those_of_the_angle_or_are_absent(make: Callable[[], AngleTrack]) -> None:
    track = make()
    phasors = track.phasors()
    assert (phasors is None) == (make is not synthesised)
    if phasors is None:
        return
    assert phasors.size == SIZE
    time = np.array([0.0, START, 0.2])
    np.testing.assert_allclose(np.sin(phasors.phase(time)), expected(make, time) / AMPLITUDE, atol=1e-9)
    segments = phasors.cut_segments(300, 301)
    first = np.sum(segments.harmonics[0, 0] * segments.first_phasor[0]).real
    np.testing.assert_allclose(first, track.read(300, 301), atol=1e-9)
    assert abs(segments.step_phasor[0]) == pytest.approx(1.0)
    assert segments.harmonic_steps.shape == segments.harmonics.shape
    np.testing.assert_allclose(phasors.delayed(50 / RATE).read(100, 200), track.read(50, 150), atol=1e-9)


@pytest.mark.parametrize("make", TRACKS)
def test_an_advanced_track_reads_the_motion_later(make: Callable[[], AngleTrack]) -> None:
    knots = np.linspace(0.0, 0.1, 11)
    lead = 0.1 + 2.0 * knots  # rad
    advanced = make().advanced(knots, lead, np.full(knots.size, FREQUENCY))
    time = START + np.arange(SIZE) / RATE
    later = time + (0.1 + 2.0 * time) / (2.0 * np.pi * FREQUENCY)
    np.testing.assert_allclose(advanced.read()[5:-500], expected(make, later)[5:-500], atol=1e-5 * AMPLITUDE)
    twice = make().advanced(knots, 0.5 * lead, np.full(knots.size, FREQUENCY))
    again = twice.advanced(knots, 0.5 * lead, np.full(knots.size, FREQUENCY))
    np.testing.assert_allclose(again.read()[5:-500], advanced.read()[5:-500], atol=1e-4 * AMPLITUDE)
    np.testing.assert_allclose(again.negated().read(), -again.read(), atol=1e-9)


@pytest.mark.parametrize("lead_samples", [-3.7, -1.0, 0.0, 0.4, 2.0])
def test_an_advanced_track_is_read_in_parts(lead_samples: float, monkeypatch: pytest.MonkeyPatch) -> None:
    turn = np.full(2, lead_samples / RATE * 2 * np.pi * FREQUENCY)
    track = sampled().advanced(np.array([0.0, 1.0]), turn, np.full(2, FREQUENCY))
    whole = track.read()
    inner = slice(5, -5)  # beyond the ends there are no samples to interpolate
    time = START + (np.arange(SIZE) + lead_samples) / RATE
    np.testing.assert_allclose(whole[inner], expected(sampled, time)[inner], atol=1e-4 * AMPLITUDE)
    monkeypatch.setattr(angle_tracks, "SAMPLES_AT_ONCE", 777)
    np.testing.assert_allclose(track.read(), whole, atol=1e-12)
    np.testing.assert_allclose(track.read(1, 3), whole[1:3], atol=1e-12)
    np.testing.assert_allclose(track.read(SIZE - 1), whole[-1:], atol=1e-12)
    assert track.read(7, 7).size == 0


def test_an_advanced_track_is_read_where_its_frequency_is_zero() -> None:
    knots = np.array([START, START + 0.02, START + 0.03, START + 0.05])
    lead, frequency = np.full(4, 0.1), np.array([FREQUENCY, FREQUENCY, 0.0, 0.0])
    with np.errstate(divide="ignore"):
        angle = sampled().advanced(knots, lead, frequency).read()
    later = START + np.arange(SIZE) / RATE + 0.1 / (2.0 * np.pi * FREQUENCY)
    np.testing.assert_allclose(angle[5:2000], expected(sampled, later)[5:2000], atol=1e-5 * AMPLITUDE)
    assert np.nanmax(np.abs(angle)) < 2.0 * AMPLITUDE
