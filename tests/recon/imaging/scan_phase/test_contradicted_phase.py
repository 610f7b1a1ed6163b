"""A start of the intensity that is stated wrong by more than the registration reaches."""

import numpy as np
import pytest

from lissajous import Device, Recording
from phantoms.optics import sample_scene
from phantoms.targets import make_target
from recon.pipeline import reconstruct
from recon.report.picture_conclusion import conclude_reconstruction
from recon.report.summary import summarise
from recon.steps.reconstruction import Options

RATE_HZ, DELAY_S = 1e6, 40e-6
FREQUENCY_HZ = {"x": 4137.0, "y": 911.0}
DEVICE = "".join(f'[{axis}.readout]\nkind = "position"\ngain = 1.0\nnoise_sd = 1e-4\n' for axis in "xy")


@pytest.mark.parametrize("sense_only", [False, True])
def test_the_phase_sd_contains_a_start_that_is_stated_wrong(sense_only: bool) -> None:
    """40 µs are 59.6° of x, which the standard deviation of its phase has to contain."""
    rng, time = np.random.default_rng(3), np.arange(60_000) / RATE_HZ
    angles = {axis: 0.1 * np.sin(2 * np.pi * f * time + 0.4) for axis, f in FREQUENCY_HZ.items()}
    scene = make_target("immunohistochemistry", (256, 256))
    light = sample_scene(scene / scene.max(), 10 * angles["x"], 10 * angles["y"], 1.0, 1.0)
    channels: dict[str, tuple] = {"intensity": (rng.poisson(100.0 * light).astype(float), "counts", RATE_HZ, DELAY_S)}
    for axis, angle in angles.items():
        channels[f"sense_{axis}"] = (angle + rng.normal(0.0, 1e-4, time.size), "V", RATE_HZ)
    device = Device.from_toml(f"{DEVICE}[scan]\nhalf_angle_x = 0.1\nhalf_angle_y = 0.1\n")
    result = reconstruct(Recording.from_arrays(channels, device), Options(sense_only=sense_only), quiet=True)
    summary = summarise(result)
    assert any(limit.startswith("x: forward and backward half-periods disagree") for limit in result.limits)
    assert summary["x"]["phase_sd_deg"] == pytest.approx(360.0 * FREQUENCY_HZ["x"] * DELAY_S, rel=0.1)
    assert summary["x"]["within_bound"] < 0.05
    assert not any("determines no phase of x" in note for note in result.notes)
    assert "--sense-only" not in conclude_reconstruction(summary)
