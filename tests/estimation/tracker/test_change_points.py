"""Drives that switch within a block, and the intervals of the tracker there."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.short_recordings import linear_device
from benchmarks.switches import phase_errors_at_blocks
from estimation.reference import PhaseReference, drive_reference
from estimation.tracker import track
from estimation.tracker.averaged_dynamics import axis_parameters
from estimation.tracker.change_points import block_pieces, drive_shares, with_switches
from estimation.tracker.drive_blocks import demodulate_drive
from phantoms.forward import Plan, simulate
from phantoms.waveforms import Constant, Sequence, Waveform
from scanner.channel import make_channel
from scanner.stages import Amdm
from tests.support.simulated import DRIVES, own_electrodes, with_sense

STOPS = Sequence(((DRIVES["x"], 0.01), (Constant(0.0), 0.004), (DRIVES["x"], 0.016)))
STEPS = Sequence(((DRIVES["x"], 0.0123), (replace(DRIVES["x"], frequency=DRIVES["x"].frequency + 25.0), 0.0177)))


@pytest.mark.parametrize(("drive", "most"), [(STOPS, 0.12), (STEPS, 0.06)], ids=["stop and start", "frequency step"])
def test_intervals_cover_the_truth_where_a_drive_switches(drive: Waveform, most: float) -> None:
    device = replace(own_electrodes(), axes={"x": own_electrodes().axis("x")}, scan=None)
    axis = device.axis("x")
    assert isinstance(axis.readout, Amdm)
    silent = replace(device, axes={"x": replace(axis, readout=replace(axis.readout, noise_var=0.0, bits=None))})
    recording, truth = simulate(silent, Plan({"x": drive}, 0.03))
    scores = []
    for seed in range(8):
        rng = np.random.default_rng(seed)
        noisy = with_sense(recording, lambda y, rng=rng: y + rng.normal(0.0, 0.01386, y.size), device)
        motion = track(noisy, device).axes["x"]
        error = phase_errors_at_blocks(motion, truth["angle_x"][0].astype(float))[1:-1]
        assert np.rad2deg(np.abs(error).max()) < most
        scores.append(error / motion.phase_sd[1:-1])
    near = np.abs(motion.time[1:-1] - 0.0135) < 0.005
    assert np.mean(np.abs(scores) < 1.96) > 0.91
    assert np.sqrt(np.mean(np.square(scores)[:, near])) < 1.3


def test_reference_has_the_frequency_step_and_phase_jump_of_the_drive() -> None:
    knots = np.arange(200) * 1e-4
    truth = np.where(knots < 0.01, 0.0, 1.0 + 30.0 * (knots - 0.01))
    reference = with_switches(PhaseReference("drive", 1e3, knots, truth), np.array([0.00997]))
    time = np.array([0.0099, 0.00996, 0.00998, 0.0102])
    slow = reference.phase(time) - 2 * np.pi * 1e3 * time
    assert np.allclose(slow, np.where(time < 0.00997, 0.0, 1.0 + 30.0 * (time - 0.01)), atol=1e-6)


@pytest.mark.parametrize("noise", [0.0, 0.06])
@pytest.mark.parametrize("at", [0.0155, 0.0158, 0.016, 0.017])
def test_a_phase_jump_is_found_within_and_between_blocks(at: float, noise: float) -> None:
    rate, width = 1e6, 1e-3
    time = np.arange(40_000) / rate
    volts = np.sin(2 * np.pi * 2000.0 * time + (time >= at))
    volts += noise * np.random.default_rng(7).standard_normal(time.size)
    drive = make_channel("drive_x", volts, unit="V", sample_rate=rate)
    axis = linear_device().axis("x")
    law = axis_parameters(axis, axis.require_readout())
    found = demodulate_drive(drive, drive_reference(drive, "drive"), width * (np.arange(40) + 0.5), width, law)
    nearest = 2e-6 + 2e-4 * noise
    assert np.abs(found.switches - at).min() < nearest
    error = found.reference.phase(time) - 2 * np.pi * 2000.0 * time - (time >= at)
    assert np.abs(error[np.abs(time - at) > nearest]).max() < 1e-3 + 0.3 * noise


def test_block_with_a_switch_uses_the_piece_with_its_middle() -> None:
    starts = np.array([0, 100, 200])
    cut = block_pieces(starts, 100, 1.0, 0.0, np.array([129.5, 270.5]))
    assert cut.tolist() == [[0, 100], [30, 100], [0, 71]]
    assert drive_shares(np.array([49.5, 149.5, 249.5]), np.array([129.5])) == pytest.approx([0.8, 0.5, 0.5])
