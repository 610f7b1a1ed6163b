"""The phase of a recorded drive: noise and coarse samples of the voltage do not move it, sweeps and jumps do."""

import numpy as np
import pytest

from estimation.knot_smoother import smooth_knots
from estimation.reference import drive_reference
from scanner.channel import Channel
from scanner.recording import Recording

RATE = 1e6
FREQUENCY = 27_660.0
TIME = np.arange(30_000) / RATE


def _drive(volts: np.ndarray) -> Channel:
    return Recording.from_arrays({"drive_x": (volts, "V", RATE)})["drive_x"]


def _steady_error(volts: np.ndarray) -> float:
    """Standard deviation of half the drive's phase from that of a steady tone [degrees]."""
    error = drive_reference(_drive(volts), "half-drive").phase(TIME) - np.pi * FREQUENCY * TIME
    return float(np.degrees(np.std(error)))


def test_noise_of_the_drive_does_not_move_the_reference() -> None:
    """Single blocks of four cycles have 0.2° in noise of 4 % of the voltage, and 0.6° between edges of 1 us."""
    noise = np.random.default_rng(1).standard_normal(TIME.size)
    sine = np.sin(2 * np.pi * FREQUENCY * TIME)
    assert _steady_error(34.0 * (1.0 + sine) + 3.0 * noise) < 0.05
    assert _steady_error(60.0 * (sine > 0.0)) < 0.05


@pytest.mark.parametrize("noise", [0.0, 1e-6, 1e-2])
@pytest.mark.parametrize("shape", ["jump", "step of frequency", "sweep"])
def test_jumps_and_sweeps_remain(shape: str, noise: float) -> None:
    time = 1.4e-4 * np.arange(3000)
    late = time - time[1500]
    phase = {"jump": 1.5 * (late > 0.0), "step of frequency": 300.0 * np.maximum(late, 0.0), "sweep": 2e4 * time**2}
    exact = 20.0 * time + phase[shape]
    smooth = smooth_knots(time, exact + noise * np.random.default_rng(2).standard_normal(time.size))
    assert np.abs(smooth - exact).max() <= 4.6 * noise + 1e-9  # no knot is worse than its noise
    assert np.std(smooth - exact) <= 1.01 * noise + 1e-9


def test_uneven_knots() -> None:
    """A line is returned as it is although knots are missing, as where the drive was off."""
    time = np.delete(1.4e-4 * np.arange(300), np.s_[100:150])
    noise = 0.02 * np.random.default_rng(3).standard_normal(time.size)
    assert np.abs(smooth_knots(time, 5.0 - 3e3 * time + noise) - (5.0 - 3e3 * time)).max() < 0.02
