"""The tracker with readouts that differ slightly from the device file."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from scipy.signal import lfilter

from estimation.tracker import track
from scanner.arrays import Array
from scanner.recording import Recording
from tests.support.simulated import noisy, quiet, with_sense
from tests.support.tracks import track_errors

RATE_HZ = 5e6


def fluttering_gain(sense: Array) -> Array:
    """A gain that changes by 1 % at 130 Hz."""
    time = np.arange(sense.size) / RATE_HZ
    return sense.mean() + (sense - sense.mean()) * (1.0 + 0.01 * np.sin(2.0 * np.pi * 130.0 * time + 1.0))


def amplifier_pole(sense: Array) -> Array:
    """A first-order pole at 300 kHz, which removes most of the white noise but none of it at the motion's harmonics."""
    decay = np.exp(-2.0 * np.pi * 300e3 / RATE_HZ)
    return np.asarray(lfilter([1.0 - decay], [1.0, -decay], sense - sense[0])) + sense[0]


def errors_deg(recording: Recording) -> dict[str, tuple[float, float]]:
    """Scatter of the phase error and root mean square of its stated standard deviation by axis [degrees]."""
    motion = track(recording, recording.device)
    errors = {}
    for name, axis in motion.axes.items():
        error, _ = track_errors(axis, quiet()[1][f"angle_{name}"][0])
        errors[name] = float(np.degrees(np.std(error))), float(np.degrees(np.sqrt(np.mean(axis.phase_sd**2))))
    return errors


@pytest.mark.parametrize("change", [fluttering_gain, amplifier_pole])
def test_readout_imperfections_do_not_increase_the_phase_error(change: Callable[[Array], Array]) -> None:
    stated = errors_deg(noisy(3))
    changed = errors_deg(with_sense(noisy(3), change))
    for axis in "xy":
        scatter, sd = changed[axis]
        assert scatter < 2.0 * stated[axis][1]  # without a drifting gain and a free noise level: 4 to 25 times
        assert scatter < 1.5 * sd
