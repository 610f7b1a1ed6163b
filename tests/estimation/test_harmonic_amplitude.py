"""Amplitude by the harmonics of a capacitive signal, against the amplitude that was estimated."""

from dataclasses import replace

import numpy as np
import pytest

from estimation.harmonic_amplitude import AmplitudeCheck, check_amplitudes
from recon.quality.amplitude_check import compare_with_signal, describe_amplitude_contradictions
from scanner import devices
from scanner.angle_tracks import SampledAngle
from scanner.arrays import Array
from scanner.device import Device
from scanner.harmonics import capacitance_harmonics, readout_response
from scanner.motion import AxisMotion, Motion
from scanner.recording import Recording

IMAGING = devices.load("imaging")
RATE, DURATION = 2e6, 0.06
FREQUENCIES = {"x": 13_840.0, "y": 3_270.0}
AMPLITUDES = {"x": 0.17, "y": 0.15}


def motion(scale: float = 1.0) -> Motion:
    """Two steady axes, with amplitudes that are ``scale`` times the true ones."""
    time = np.linspace(0.0, DURATION, 100)
    axes = {
        name: AxisMotion(
            time=time,
            phase=np.zeros_like(time),
            amplitude=np.full_like(time, scale * AMPLITUDES[name]),
            frequency=np.full_like(time, frequency),
            phase_sd=np.full_like(time, 1e-3),
            angle=SampledAngle(np.zeros(2), RATE),
        )
        for name, frequency in FREQUENCIES.items()
    }
    return Motion(axes, "tracker")


def signal(device: Device, feedthrough: float = 0.0, seed: int = 1, duration: float = DURATION) -> Array:
    """Shared sense signal of steady motions, by its harmonics, with white noise; feedthrough at twice the frequency of
    x, relative to the signal there."""
    time = np.arange(round(duration * RATE)) / RATE
    total = device.readout.noise_sd * np.random.default_rng(seed).standard_normal(time.size)  # type: ignore[union-attr]
    for name, frequency in FREQUENCIES.items():
        axis = device.sensed_axis(name)
        harmonics = capacitance_harmonics(AMPLITUDES[name], axis.capacitance)  # type: ignore[arg-type]
        lines = harmonics * readout_response(axis.readout, frequency * np.arange(harmonics.size))  # type: ignore[arg-type]
        if name == "x":
            lines[2] *= 1.0 + feedthrough
        turn = 2 * np.pi * frequency * time + 0.7
        total += np.real(sum(line * np.exp(1j * n * turn) for n, line in enumerate(lines)))
    return np.asarray(total)


def checks(values: Array, device: Device = IMAGING, scale: float = 1.0) -> dict[str, AmplitudeCheck]:
    recording = Recording.from_arrays({"sense": (values, "V", RATE)}, device)
    return check_amplitudes(recording, device, motion(scale))


def test_a_right_amplitude_agrees_with_size_and_shape() -> None:
    for check in checks(signal(IMAGING)).values():
        assert check.error_sd == 0.0
        for each in check:
            assert each.ratio == pytest.approx(1.0, abs=0.01)


def test_the_noise_is_stated() -> None:
    """Without tolerances, the deviations of the amplitude by size and by shape are as large as stated."""
    exact = replace(
        IMAGING,
        axes={name: replace(axis, tolerance={"C0": 0.0, "theta0": 0.0}) for name, axis in IMAGING.axes.items()},
        shared_tolerance={"a_cir": 0.0, "lpf_hz": 0.0},
    )
    ratios = [
        each.difference / each.sd
        for seed in range(10)
        for check in checks(signal(exact, seed=seed), exact).values()
        for each in check
    ]
    assert 0.6 < np.sqrt(np.mean(np.square(ratios))) < 1.6


@pytest.mark.parametrize("scale", [0.8, 0.9, 1.1])
def test_a_wrong_amplitude_contradicts_and_its_error_is_stated(scale: float) -> None:
    for check in checks(signal(IMAGING), scale=scale).values():
        assert check.size.contradicts
        assert check.error_sd == pytest.approx(abs(1.0 / scale - 1.0), rel=0.4)


def test_the_shape_does_not_depend_on_the_gain() -> None:
    other = replace(IMAGING, readout=replace(IMAGING.readout, a_cir=1.3 * IMAGING.readout.a_cir))  # type: ignore[union-attr, type-var]
    for check in checks(signal(other)).values():
        assert check.size.difference > 0.2
        assert not check.shape.contradicts


def test_feedthrough_contradicts_in_its_axis() -> None:
    found = checks(signal(IMAGING, feedthrough=0.2))
    assert found["x"].error_sd > 0.1
    assert found["y"].error_sd == 0.0
    (line,) = describe_amplitude_contradictions(found)
    assert line.startswith("x: the sense signal contradicts the device")


def test_what_cannot_be_compared_is_left_out() -> None:
    assert checks(signal(IMAGING, duration=0.03)) == {}  # too few periods
    stated = IMAGING.with_terms({"x": {"sensor-cubic": {"c3": 1.0}}})
    assert set(checks(signal(IMAGING), stated)) == {"y"}  # a term changes the harmonics
    by_picture = replace(motion(), estimator="picture")
    recording = Recording.from_arrays({"sense": (signal(IMAGING), "V", RATE)}, IMAGING)
    assert compare_with_signal(recording, IMAGING, by_picture) == {}


@pytest.mark.parametrize("before", [0.0, 1e-9])
def test_a_part_at_rest_has_no_weight(before: float) -> None:
    values, estimated = signal(IMAGING), motion()
    moving = estimated.axes["x"]
    at_rest = moving.time < 0.45 * DURATION  # the change is between the middles of two blocks
    axes = {**estimated.axes, "x": replace(moving, amplitude=np.where(at_rest, before, moving.amplitude))}
    recording = Recording.from_arrays({"sense": (values, "V", RATE)}, IMAGING)
    found = check_amplitudes(recording, IMAGING, replace(estimated, axes=axes))
    if before:
        assert found["x"].size.ratio == pytest.approx(1.0, abs=0.01)
    else:
        assert "x" not in found  # too few blocks with a motion
