"""An amplifier that changes its range during a scan is named; what a mirror can do is not."""

import numpy as np
import pytest

from recon.quality.gain_steps import describe_gain_steps
from scanner.device import Device
from scanner.recording import Recording

RATE, FREQUENCY, QUALITY = 5e5, 2000.0, 100.0
TIME = np.arange(30_000) / RATE
DEVICE = Device.from_toml(
    f"[x.mechanics]\nJ = 1e-10\nb = {1e-10 * 2 * np.pi * FREQUENCY / QUALITY}\n"
    f"k = {1e-10 * (2 * np.pi * FREQUENCY) ** 2}\n"
)
TIME_CONSTANT_S = QUALITY / (np.pi * FREQUENCY)


def lines(amplitude: np.ndarray, noise: float = 1e-3, frequency: float = 1.001 * FREQUENCY) -> list[str]:
    volts = amplitude * np.sin(2 * np.pi * frequency * TIME) + noise * np.random.default_rng(1).standard_normal(
        TIME.size
    )
    return describe_gain_steps(Recording.from_arrays({"sense_x": (volts, "V", RATE)}, DEVICE), DEVICE)


@pytest.mark.parametrize("factor", [0.1, 0.5, 0.95, 2.0, 10.0])
def test_a_step_of_the_gain_is_stated_with_its_factor(factor: float) -> None:
    (line,) = lines(np.where(TIME < 0.0253, 1.0, factor))
    assert line.startswith("sense_x: its amplitude changes by the factor ")
    assert float(line.split("factor ")[1].split(" ")[0]) == pytest.approx(factor, rel=0.01)
    assert float(line.split(" at ")[1].split(" s")[0]) == pytest.approx(0.0253, abs=1.5e-3)


def test_few_samples_a_period_suffice() -> None:
    volts = np.where(TIME < 0.0253, 1.0, 0.5) * np.sin(2 * np.pi * FREQUENCY * TIME)
    assert (
        len(describe_gain_steps(Recording.from_arrays({"sense_x": (volts[::90], "V", RATE / 90)}, DEVICE), DEVICE)) == 1
    )


def test_there_are_as_many_lines_as_steps() -> None:
    assert len(lines(np.where((TIME > 0.02) & (TIME < 0.04), 0.5, 1.0))) == 2


LATE = np.maximum(TIME - 0.03, 0.0)


@pytest.mark.parametrize(
    "amplitude",
    [
        np.ones(TIME.size),
        np.exp(-LATE / TIME_CONSTANT_S),
        1.0 - np.exp(-TIME / TIME_CONSTANT_S),
        1.0 + 2.0 * (1.0 - np.exp(-LATE / TIME_CONSTANT_S)),
        np.cos(2 * np.pi * 30.0 * TIME),
        1.0 + 0.5 * np.sin(2 * np.pi * 60.0 * TIME),
        np.where((TIME > 0.02) & (TIME < 0.025), np.nan, 1.0),
        np.where((TIME > 0.02) & (TIME < 0.0201), 0.0, 1.0),
        np.where(TIME > 0.03, 0.0, 1.0),
    ],
    ids=["steady", "decay", "start", "drive rises", "beat", "modulated", "gap", "spike", "signal is lost"],
)
def test_changes_that_a_mirror_or_a_lost_signal_shows_are_no_steps(amplitude: np.ndarray) -> None:
    for noise in (1e-4, 1e-2):
        assert not lines(amplitude, noise)


def test_an_axis_of_low_quality_may_change_at_once() -> None:
    damped = Device.from_toml("[x.mechanics]\nJ = 1e-10\nb = 1e-6\nk = 0.0158\n")
    volts = np.where(TIME < 0.0253, 1.0, 0.5) * np.sin(2 * np.pi * FREQUENCY * TIME)
    assert not describe_gain_steps(Recording.from_arrays({"sense_x": (volts, "V", RATE)}, damped), damped)
