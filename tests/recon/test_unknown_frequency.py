"""A position signal shorter than a period of its motion has no frequency, and none is stated."""

import numpy as np
import pytest

from recon.pipeline import reconstruct
from recon.report.reconstruction import reconstruction_report
from recon.report.summary import summarise
from recon.steps.reconstruction import Options
from scanner.device import Device
from scanner.recording import Recording

DEVICE = Device.from_toml(
    "".join(f'[{axis}.readout]\nkind = "position"\ngain = 1.0\noffset = 0.0\nnoise_sd = 1e-4\n' for axis in "xy")
    + "[scan]\nhalf_angle_x = 0.1\nhalf_angle_y = 0.1\n"
)
RATE, SECONDS, FAST_HZ = 1e5, 0.2, 400.0


def raster(periods: float) -> Recording:
    """A raster whose slow axis makes some periods of a triangle."""
    rng = np.random.default_rng(0)
    time = np.arange(round(RATE * SECONDS)) / RATE
    slow = 0.09 * (4.0 * np.abs((time / SECONDS * periods) % 1.0 - 0.5) - 1.0)
    fast = 0.09 * np.sin(2.0 * np.pi * FAST_HZ * time)
    light = 1.0 + np.sin(60.0 * fast) * np.cos(50.0 * slow) + 0.05 * rng.standard_normal(time.size)
    noise = 1e-4 * rng.standard_normal((2, time.size))
    return Recording.from_arrays(
        {
            "sense_x": (fast + noise[0], "V", RATE),
            "sense_y": (slow + noise[1], "V", RATE),
            "intensity": (light, "V", RATE),
        },
        DEVICE,
    )


@pytest.mark.parametrize("periods", [0.5, 0.8, 5.0])
def test_a_frequency_is_stated_only_if_the_signal_repeats(periods: float) -> None:
    result = reconstruct(raster(periods), Options(pixels=(50, 50)), quiet=True)
    summary = summarise(result)
    assert summary["x"]["frequency_hz"] == pytest.approx(FAST_HZ, rel=1e-3)
    notes = [note for note in result.notes if "frequency of y is not determined" in note]
    if periods < 1.0:
        assert summary["y"]["frequency_hz"] is None
        assert len(notes) == 1
        assert summary["y"]["amplitude_rad"] == pytest.approx(0.09, rel=0.05)  # half the range
        assert summary["y"]["within_bound"] > 0.99
        assert not any("determines no phase of y" in note for note in result.notes)
        assert "not determined</td>" in reconstruction_report(result, summary)
    else:
        assert summary["y"]["frequency_hz"] == pytest.approx(periods / SECONDS, rel=0.02)
        assert not notes


def test_the_phase_against_an_absolute_reference_gives_the_angle_back() -> None:
    axis = reconstruct(raster(5.0), Options(pixels=(50, 50)), quiet=True).motion.axes["x"]
    assert axis.reference == "absolute"
    assert axis.reference_frequency is not None
    angle = axis.angle.read()
    time = axis.angle.start + np.arange(angle.size) / axis.angle.sample_rate
    phase, amplitude = (np.interp(time, axis.time, values) for values in (axis.phase, axis.amplitude))
    rebuilt = amplitude * np.sin(2.0 * np.pi * axis.reference_frequency * time + phase)
    assert np.sqrt(np.nanmean((rebuilt - angle) ** 2)) < 0.05 * amplitude.mean()
