"""Feedthrough of the drives in a shared sense signal: found by the lines of the signal, and removed."""

from __future__ import annotations

import numpy as np
import pytest

from estimation.estimate import estimate
from scanner.channel import make_channel
from scanner.motion import Motion
from scanner.recording import Recording
from tests.support.simulated import imaging

DRIVES_HZ = {"x": 27680.0, "y": 6540.0}
SETTLED = slice(20_000, 80_000)


def with_feedthrough(in_phase: float, quadrature: float, axes: str = "xy") -> Recording:
    """A scan whose shared sense signal holds parts of the drives, by their rms over that of the signal."""
    recording, _ = imaging()
    sense = recording["sense"]
    values = sense.read()
    rms = values.std()
    for axis in axes:
        drive = recording[f"drive_{axis}"].read()
        change = (drive - drive.mean()) * rms / drive.std()
        rate = np.gradient(change) * sense.sample_rate / (2 * np.pi * DRIVES_HZ[axis])
        values = values + in_phase * change + quadrature * rate
    return recording.with_channel(make_channel("sense", values, unit=sense.unit, sample_rate=sense.sample_rate))


def amplitude_errors(motion: Motion) -> dict[str, float]:
    """Relative error of the amplitude of each axis."""
    truth = imaging()[1]
    return {
        axis: float(own.angle.read()[SETTLED].std() / np.asarray(truth[f"angle_{axis}"][0])[SETTLED].std()) - 1.0
        for axis, own in motion.axes.items()
    }


@pytest.mark.parametrize(("in_phase", "quadrature", "axes"), [(0.06, 0.06, "xy"), (0.2, 0.0, "xy"), (0.06, 0.0, "x")])
def test_the_amplitude_is_estimated_without_the_feedthrough(in_phase: float, quadrature: float, axes: str) -> None:
    motion = estimate(with_feedthrough(in_phase, quadrature, axes))
    for axis, error in amplitude_errors(motion).items():
        own = motion.axes[axis]
        assert own.amplitude_sd is not None
        assert abs(error) < 0.01
        assert abs(error) < 2.5 * float(np.mean(own.amplitude_sd / own.amplitude))
    assert sum(note.startswith("sense: holds a part of drive_") for note in motion.notes) == 2


def test_a_signal_without_feedthrough_is_used_as_it_is() -> None:
    motion = estimate(imaging()[0])
    assert not motion.notes
    assert max(map(abs, amplitude_errors(motion).values())) < 2e-3
    own = motion.axes["x"]
    assert own.amplitude_sd is not None
    assert np.mean(own.amplitude_sd / own.amplitude) < 3e-3
