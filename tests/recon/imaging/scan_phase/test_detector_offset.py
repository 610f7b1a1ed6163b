"""Edges of one direction beside the centre: the picture shows phase and amplitude, or the phase is unknown."""

from __future__ import annotations

import numpy as np
import pytest

import lissajous
from recon.imaging.scan_phase.detector_offset import fit_offset
from recon.steps.reconstruction import Reconstruction
from scanner.device import Device
from scanner.recording import Recording

RATE_HZ, SAMPLES, HALF_RAD = 1e6, 60_000, 0.08
FREQUENCIES_HZ = {"x": 1870.0, "y": 733.0}
TIME = np.arange(SAMPLES) / RATE_HZ
PHASES = {
    axis: 2 * np.pi * frequency * TIME + start
    for (axis, frequency), start in zip(FREQUENCIES_HZ.items(), (0.4, 1.9), strict=True)
}


def scan(place: float, fall: float, contrast: float = 1.0) -> Reconstruction:
    """Reconstruct a scan whose amplitude falls exponentially by ``fall``, with upward edges at ``place`` of the field.

    Args:
        contrast: of the spots of the scene against its background.
    """
    rng = np.random.default_rng(881301)
    envelope = (1.0 - fall) ** (TIME / TIME[-1])
    x, y = (0.97 * envelope * np.sin(PHASES[axis]) for axis in "xy")
    scene = np.full(SAMPLES, 0.2)
    for _ in range(60):
        column, row, size = *rng.uniform(-0.95, 0.95, 2), rng.uniform(0.02, 0.06)
        scene += contrast * rng.uniform(0.3, 1.0) * np.exp(-((x - column) ** 2 + (y - row) ** 2) / (2 * size**2))
    channels: dict[str, tuple] = {"intensity": (rng.poisson(300.0 * scene) / 300.0, "V", RATE_HZ)}
    for axis, angle in (("x", x), ("y", y)):
        beyond = angle - place
        at = np.flatnonzero((beyond[:-1] < 0.0) & (beyond[1:] >= 0.0))
        times = (at - beyond[at] / (beyond[at + 1] - beyond[at])) / RATE_HZ + rng.normal(0.0, 2e-8, at.size)
        channels[f"sync_{axis}"] = times, "s", {"event": "zero-crossing-up"}
    field = f"[x]\n[y]\n[scan]\nhalf_angle_x = {HALF_RAD}\nhalf_angle_y = {HALF_RAD}\n"
    return lissajous.reconstruct(Recording.from_arrays(channels, Device.from_toml(field)), pixels=(120, 120))


def phase_errors(result: Reconstruction, axis: str) -> tuple[np.ndarray, np.ndarray]:
    """Phase of the reconstructed angle less the true phase about each time of the motion, and its stated sd [deg]."""
    motion = result.motion.axes[axis]
    angle, reach = motion.angle.read(), round(RATE_HZ / FREQUENCIES_HZ[axis])
    errors, sds = [], []
    for time, sd in zip(motion.time[1:-1], motion.phase_sd[1:-1], strict=True):
        part = slice(max(round(time * RATE_HZ) - reach, 0), round(time * RATE_HZ) + reach)
        known = np.isfinite(angle[part])
        design = np.column_stack([np.sin(PHASES[axis][part]), np.cos(PHASES[axis][part])])
        sine, cosine = np.linalg.lstsq(design[known], angle[part][known], rcond=None)[0]
        errors.append(np.degrees(np.arctan2(cosine, sine)))
        sds.append(np.degrees(sd))
    return np.array(errors), np.array(sds)


@pytest.mark.parametrize(("place", "fall"), [(0.4, 0.3), (0.65, 0.3), (0.2, 0.5)])
def test_the_picture_shows_phase_and_amplitude_of_a_falling_motion(place: float, fall: float) -> None:
    result = scan(place, fall)
    for axis in "xy":
        error, sd = phase_errors(result, axis)
        assert np.abs(error).max() < 0.5
        assert np.sqrt(np.mean((error / sd) ** 2)) < 2.5
        amplitude = result.motion.axes[axis].amplitude
        assert amplitude[-1] / amplitude[0] == pytest.approx(1.0 - fall, rel=0.2)
        assert any(line.startswith(f"sync_{axis}: the picture shows") for line in result.notes)


def test_a_phase_that_rests_on_the_stated_event_is_named() -> None:
    result = scan(0.4, 0.3, contrast=0.0)
    for axis in "xy":
        [line] = [line for line in result.notes if line.startswith(f"sync_{axis}: the phase of {axis} rests on event")]
        assert "because the picture determines none" in line


def test_a_constant_offset_is_left_to_the_phase_of_the_readout() -> None:
    result = scan(0.1, 0.0)
    assert not any("detector" in line for line in result.notes)
    assert all(np.ptp(axis.amplitude) == 0.0 for axis in result.motion.axes.values())
    assert all(np.abs(phase_errors(result, axis)[0]).max() < 0.1 for axis in "xy")


def test_the_fit_states_the_amplitude_only_where_the_offset_is_significant() -> None:
    rng = np.random.default_rng(881302)
    time, at = np.linspace(0.0, 1.0, 12), np.linspace(-0.05, 1.05, 30)
    grows = fit_offset(time, np.arcsin(0.3 / (1.0 - 0.4 * time)) + rng.normal(0.0, 4e-3, 12), at)
    assert grows is not None
    assert grows.relative_amplitude is not None
    assert np.abs(grows.relative_amplitude * (1.0 + 0.02) - (1.0 - 0.4 * at)).max() < 0.05
    crosses = fit_offset(time, 0.2 * (time - 0.5) + rng.normal(0.0, 4e-3, 12), at)
    assert crosses is not None
    assert crosses.relative_amplitude is None
    assert fit_offset(time, 0.3 + rng.normal(0.0, 4e-3, 12), at) is None
