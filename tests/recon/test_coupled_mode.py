"""A scan whose amplitude vanishes repeatedly, because a coupled mode takes the energy: phase and sign are followed."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.signal import hilbert

import lissajous
from benchmarks.blind.generator import BlindRecording, Case, generate_recording, write
from estimation.estimate import estimate
from estimation.optics.selection import diagnose_optics
from recon.steps.sign_after_rest import find_rests, follow_signs
from scanner.recording import Recording

MODE = {"x": {"mode-coupling": {"g": 0.2786, "f2": 6934.417, "Q2": 113.4, "s": 0.00106}}}
"""The mode of this recording as the diagnosis finds it."""

PIXEL = 0.18 / 200
"""Of a picture of 400 pixels over the field [rad]."""

CASE = Case("blind-003", "one", "imaging", ("mode-coupling",), "proportional", 2714847646)


@pytest.fixture(scope="module")
def scan(tmp_path_factory: pytest.TempPathFactory) -> tuple[BlindRecording, Path]:
    """The recording and its file."""
    blind, path = generate_recording(CASE), tmp_path_factory.mktemp("mode") / "scan.h5"
    write(blind, path)
    return blind, path


@pytest.mark.slow
@pytest.mark.parametrize("stated", [False, True], ids=["nominal device", "device with the mode"])
def test_phase_and_sign_are_followed_through_rest(scan: tuple[BlindRecording, Path], stated: bool) -> None:
    """The picture cannot replace the sense signal there: the device file describes another motion."""
    blind, path = scan
    with Recording.open(path) as recording:
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


@pytest.mark.slow
def test_a_wrong_sign_after_rest_is_no_motion_of_the_sample(scan: tuple[BlindRecording, Path]) -> None:
    with Recording.open(scan[1]) as recording:
        device, intensity = recording.device.with_terms(MODE), recording["intensity"]
        right, _ = follow_signs(estimate(recording, device), device, intensity, recording.start)  # else by chance
        axis = right.axes["x"]
        turned = axis.advanced(np.where(axis.time < find_rests(axis)[-1], 0.0, np.pi))
        wrong = replace(right, axes={**right.axes, "x": turned})
        followed, notes = follow_signs(wrong, device, intensity, recording.start)
        assert ["was changed" in note for note in notes] == [True]
        assert [finding.effect for finding in diagnose_optics(wrong, intensity, device).findings] == ["sample-motion"]
        assert not diagnose_optics(followed, intensity, device).findings
