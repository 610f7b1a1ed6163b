"""Phase error of the tracker on clipped sense signals, compared with the bound that takes the rails into account.

Two cases: comb and transimpedance readout of chen2019, clipped throughout, and the x axis of the imaging scanner, of
which 6 ms of 30 ms are clipped. docs/explanation/tracker.md has the results.
Run: python -m benchmarks.clipped [noises per case]
"""

from __future__ import annotations

import json
import sys
from dataclasses import replace

import numpy as np

from benchmarks.tracker_bound import DRIFT_STEP_S, DRIVES, draw_stiffness_drift, noise_free_device, wrap_half_turn
from estimation.signals import phase_reference, sense_channels
from estimation.tracker import track
from estimation.tracker.block_tracking import track_blocks
from estimation.tracker.cramer_rao import NO_RAILS, phase_sd_bounds
from estimation.tracker.initial_state import choose_signs, initial_estimate
from estimation.tracker.observations import demodulate_blocks, lay_out_blocks
from estimation.tracker.state_space import PHASE
from phantoms.forward import Plan, simulate
from phantoms.waveforms import Sine
from scanner import devices
from scanner.arrays import Array
from scanner.device import Device
from scanner.drift import Drift
from scanner.laws import capacitance_slope, transimpedance_voltage
from scanner.recording import Recording
from scanner.stages import Drive, Transimpedance

RAIL_FRACTIONS = (0.5, 0.2, 0.1, 0.05, 0.02, 0.0)
"""Rails, as fractions of the signal's peak; 0 is a comparator."""

AMPLITUDE_RAD, SAMPLE_RATE_HZ = 0.15, 5e5
"""Amplitude and sample rate of chen2019 [rad, Hz]."""

DURATION_S = 0.2
"""Length of the recordings with a transimpedance readout [s]: 25 blocks of its slow axis."""

SETTLE_S = 0.4
"""Time before the recording in which the motion becomes steady [s]."""

STIFFNESS_RATE_DENSITY = 0.01
"""Spectral density of the stiffness's rate [1/s^3]: a drift of 0.5 % in the recording."""

DENSITIES = np.array([[1e-9, STIFFNESS_RATE_DENSITY, 1e-8, 1e-8]])
"""Process noise that is simulated, for the bound; all but the stiffness's rate are nearly zero, shape (1, 4)."""

SEGMENT_NOISE_SD_V = 0.01386
"""Noise of the imaging scanner's sense signal [V]: that of its readout."""

SEGMENT_DURATION_S = 0.03
"""Length of the recordings that are clipped in a segment [s]."""

CLIPPED_SAMPLES = slice(60_000, 90_000)
"""Samples of the imaging scanner that are clipped: 12 to 18 ms."""

CLIPPED_QUANTILES = (0.15, 0.85)
"""Quantiles of the signal that are the rails of the segment."""

CLIPPED_BLOCKS_S = (0.0125, 0.0175)
"""Middles of the blocks of which all samples are in the clipped segment [s]."""


def simulate_transimpedance() -> tuple[Device, Recording]:
    """Device and recording of chen2019's axis under a linear torque and a constant bias, without noise or rails."""
    axis = devices.load("chen2019").axis("x")
    readout, comb = axis.require_readout(), axis.require_capacitance()
    assert isinstance(readout, Transimpedance)
    drive = Drive("linear", AMPLITUDE_RAD * axis.require_mechanics().k / axis.quality)
    device = replace(
        devices.load("chen2019"), axes={"x": replace(axis, drive=drive, readout=replace(readout, bits=None))}
    )
    rng, step = np.random.default_rng(5), DRIFT_STEP_S
    rate = np.cumsum(rng.normal(0.0, np.sqrt(STIFFNESS_RATE_DENSITY * step), round(DURATION_S / step) + 2))
    factor = 1.0 + np.cumsum(rate) * step
    drift = Drift(lambda time: np.where(time > 0.0, np.interp(time, np.arange(factor.size) * step, factor), 1.0))
    plan = Plan(
        {"x": Sine(axis.resonance, 1.0)}, DURATION_S, sample_rate=SAMPLE_RATE_HZ, settle=SETTLE_S, drift={"x": drift}
    )
    recording, truth = simulate(device, plan)
    angle = truth["angle_x"][0].astype(np.float64)
    slope = capacitance_slope(angle, comb.C0, comb.theta0, comb.theta_th)
    signal = transimpedance_voltage(slope, np.gradient(angle, 1.0 / SAMPLE_RATE_HZ), readout.R_s, readout.V_bias)
    return device, with_signal(recording, device, "sense_x", signal)


def with_signal(recording: Recording, device: Device, name: str, values: Array) -> Recording:
    """The recording with the samples of one channel replaced by ``values``."""
    channels = {k: (c.read(), c.unit, c.sample_rate, c.start) for k, c in recording.channels.items()}
    return Recording.from_arrays({**channels, name: (values, *channels[name][1:])}, device)


def clip_signal(signal: Array, rail: float) -> Array:
    """The signal limited to [-rail, rail]; a comparator's output, its sign, for a rail of zero."""
    return np.clip(signal, -rail, rail) if rail > 0.0 else np.sign(signal)


def summarise_errors(error: Array, sd: Array) -> dict[str, float]:
    """Root mean square of phase errors and of their stated sds [deg], and the coverage of the 95 % intervals."""
    rmse, stated = (float(np.rad2deg(np.sqrt(np.mean(values**2)))) for values in (error, sd))
    return {"rmse_deg": rmse, "sd_deg": stated, "held": float(np.mean(np.abs(error) < 1.96 * sd))}


def track_between_rails(noises: int) -> dict[str, dict[str, float]]:
    """Phase errors of recordings that are clipped throughout, and their bounds, by rail; ``noises`` recordings each."""
    device, quiet = simulate_transimpedance()
    signal = quiet["sense_x"].read()
    (sense,) = sense_channels(quiet, device)
    reference = phase_reference(quiet, device, "x", sense.channel, True)
    exact = demodulate_blocks(lay_out_blocks(quiet, device, sense, {"x": reference}))
    start, _ = choose_signs(exact, initial_estimate(exact, device))
    states = track_blocks(exact, start, DENSITIES[None])[0].states
    true_phase = states[:, PHASE] + exact.signal.psi[:, 0] - reference.phase(exact.time)
    noise_sd = device.axis("x").require_readout().noise_sd
    results = {}
    for rail in RAIL_FRACTIONS:
        limit = rail * float(np.abs(signal).max())
        errors, sds = [], []
        for seed in range(noises):
            noisy = signal + np.random.default_rng(seed).normal(0.0, noise_sd, signal.size)
            axis = track(with_signal(quiet, device, "sense_x", clip_signal(noisy, limit)), device).axes["x"]
            errors.append(wrap_half_turn(axis.phase - true_phase))
            sds.append(axis.phase_sd)
        bounds = {
            key: float(np.rad2deg(np.sqrt(np.mean(bound[1] ** 2))))
            for key, rails in (("bound_deg", (-limit, limit)), ("unclipped_bound_deg", NO_RAILS))
            for bound in [phase_sd_bounds(exact, states, start.covariance, DENSITIES, noise_sd**2, rails)]
        }
        summary = summarise_errors(np.array(errors), np.array(sds))
        results[f"{rail:g}"] = {**summary, **bounds, "ratio": summary["rmse_deg"] / bounds["bound_deg"]}
    return results


def track_clipped_segment(drifts: int, noises: int) -> dict[str, dict[str, float]]:
    """Phase errors of the imaging scanner's x axis, of which CLIPPED_SAMPLES are clipped to the CLIPPED_QUANTILES.

    Args:
        drifts: number of drifts.
        noises: recordings of each drift.

    Returns:
        ``summarise_errors`` of the whole scan and of the clipped blocks.
    """
    device = noise_free_device(False)
    device = replace(device, axes={"x": device.axis("x")}, scan=None)
    errors, sds, time = [], [], np.empty(0)
    for seed in range(drifts):
        rng = np.random.default_rng(seed)
        plan = Plan({"x": DRIVES["x"]}, SEGMENT_DURATION_S, drift={"x": Drift(draw_stiffness_drift(rng))})
        quiet, _ = simulate(device, plan)
        signal = quiet["sense_x"].read()
        exact = track(quiet, device).axes["x"].phase
        for _ in range(noises):
            noisy = signal + rng.normal(0.0, SEGMENT_NOISE_SD_V, signal.size)
            noisy[CLIPPED_SAMPLES] = np.clip(noisy[CLIPPED_SAMPLES], *np.quantile(noisy, CLIPPED_QUANTILES))
            axis = track(with_signal(quiet, device, "sense_x", noisy), device).axes["x"]
            errors.append(wrap_half_turn(axis.phase - exact))
            sds.append(axis.phase_sd)
            time = axis.time
    error, sd = np.array(errors), np.array(sds)
    inside = (time > CLIPPED_BLOCKS_S[0]) & (time < CLIPPED_BLOCKS_S[1])
    return {"whole scan": summarise_errors(error, sd), "clipped": summarise_errors(error[:, inside], sd[:, inside])}


def main() -> None:
    noises = int(sys.argv[1]) if len(sys.argv) > 1 else 40
    print(
        json.dumps({"segment": track_clipped_segment(noises // 2, 2), "rails": track_between_rails(noises)}, indent=1)
    )


if __name__ == "__main__":
    main()
