"""A scan whose amplitude vanishes repeatedly, because a coupled mode takes the energy: phase and sign are followed."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.signal import hilbert

import lissajous
from benchmarks.blind.generator import Case, generate_recording, write
from scanner.recording import Recording

MODE = {"x": {"mode-coupling": {"g": 0.2786, "f2": 6934.417, "Q2": 113.4, "s": 0.00106}}}
"""The mode of this recording as the diagnosis finds it."""

PIXEL = 0.18 / 200
"""Of a picture of 400 pixels over the field [rad]."""

CASE = Case("blind-003", "one", "imaging", ("mode-coupling",), "proportional", 2714847646)


@pytest.mark.slow
@pytest.mark.parametrize("stated", [False, True], ids=["nominal device", "device with the mode"])
def test_phase_and_sign_are_followed_through_rest(tmp_path: Path, stated: bool) -> None:
    """The picture cannot replace the sense signal there: the device file describes another motion."""
    blind = generate_recording(CASE)
    write(blind, tmp_path / "scan.h5")
    with Recording.open(tmp_path / "scan.h5") as recording:
        device = recording.device.with_terms(MODE if stated else {})
        result = lissajous.reconstruct(recording, device, allow_outside=True)
    true = hilbert(blind.true_angles()["x"])
    axis = result.motion.axes["x"]
    ratio = hilbert(axis.angle.read())[: true.size] / true
    moving = np.abs(true) > 0.5 * np.sqrt(np.mean(np.abs(true) ** 2))
    moving[:5000] = moving[-5000:] = False  # the ends of the Hilbert transform
    sign = np.sign(ratio[moving].real)
    assert abs(sign.mean()) > 0.999
    displacement = np.abs(true[moving] * np.angle(ratio[moving] * sign)) / PIXEL
    assert np.mean(displacement < 1.0) > 0.9
    assert not any("does not show" in note for note in result.notes)
