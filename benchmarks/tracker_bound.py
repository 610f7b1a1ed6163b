"""Phase error of the tracker compared with its posterior Cramer-Rao bound and with the UKF, from 40 to 0 dB.

The stiffness of both axes drifts as an integrated random walk. Each drift gets several realisations of noise. The
tracker estimates the density of the random walk; the bound is computed with the true one. docs/explanation/tracker.md
has the results. Run: python -m benchmarks.tracker_bound [drifts]
"""

from __future__ import annotations

import json
import sys
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from estimation.estimate import estimate
from estimation.signals import phase_reference, sense_channels
from estimation.tracker.block_tracking import average_over_noise, track_blocks
from estimation.tracker.cramer_rao import phase_sd_bounds
from estimation.tracker.initial_state import choose_signs, initial_estimate
from estimation.tracker.observations import BlockObservations, demodulate_blocks, lay_out_blocks
from estimation.tracker.process_noise import (
    noise_posterior,
    tune_process_noise,
    tuning_parts,
    with_offset_density,
)
from estimation.tracker.state_space import AXIS_STATES, PHASE
from phantoms.forward import Plan, simulate
from phantoms.waveforms import Sine
from recon.evaluation import evaluate_axis
from scanner import devices
from scanner.arrays import Array
from scanner.device import Device
from scanner.drift import Drift, Factor
from scanner.recording import Recording
from scanner.stages import Amdm

STIFFNESS_RATE_DENSITY = 0.4
"""Spectral density of the stiffness's rate [1/s^3]: a drift of 0.2 % in 30 ms, as of a scanner that warms up."""

DURATION_S = 0.03
"""Length of a recording: some 70 blocks of the faster axis."""

DRIFT_STEP_S = 2e-5
"""Time step of the simulated random walk: well below the length of a block."""

SNR_DB = (40, 30, 20, 10, 0)
"""Signal-to-noise ratios of a sample: variance of the signal over variance of the noise."""

NOISES_PER_DRIFT = 4
"""Realisations of noise for each drift: a simulation takes longer than a track."""

SEPARATE_READOUT_OFFSET_V = 4.95
"""Offset of a readout that has one comb: it centres the signal in the converter's range."""

NOISE_FREE_DENSITIES = (1e-6, 10.0, 1e-6, 1e-8)
"""Process noise of the track of a noise-free recording, see ``process_noise``: large, so that it follows the drift."""

DEVICE_FILE_ERRORS = {"nominal": (1.0, 1.0), "k off by 0.1 %, b by 5 %": (1.001, 1.05)}
"""Factors of stiffness and damping in the device file that the estimators use, by the name of the case."""

DRIVES = {"x": Sine(27680.0, 30.0, 30.0), "y": Sine(6540.0, 30.0, 30.0)}
"""The demo's drives, near twice the resonances [V]."""

Points = dict[str, dict[str, dict[str, float]]]


def draw_stiffness_drift(rng: np.random.Generator) -> Factor:
    """Factor of the stiffness over time, whose rate is a random walk."""
    n = round(DURATION_S / DRIFT_STEP_S) + 2
    rate = np.cumsum(rng.normal(0.0, np.sqrt(STIFFNESS_RATE_DENSITY * DRIFT_STEP_S), n))
    factor = 1.0 + np.cumsum(rate) * DRIFT_STEP_S
    return lambda time: np.where(time > 0.0, np.interp(time, np.arange(n) * DRIFT_STEP_S, factor), 1.0)


def noise_free_device(shared: bool) -> Device:
    """The imaging scanner without noise or converter, its combs on one shared electrode or on separate ones."""
    device = devices.load("imaging")
    assert isinstance(device.readout, Amdm)
    readout = replace(device.readout, noise_var=0.0, bits=None)
    if shared:
        return replace(device, readout=readout)
    separate = replace(readout, b_cir=SEPARATE_READOUT_OFFSET_V)
    axes = {name: replace(axis, readout=separate) for name, axis in device.axes.items()}
    return replace(device, axes=axes, readout=None)


def add_white_noise(recording: Recording, snr_db: float, rng: np.random.Generator, device: Device) -> Recording:
    """The recording with white noise on its sense signals."""
    channels = {k: (c.read(), c.unit, c.sample_rate, c.start) for k, c in recording.channels.items()}
    for name in (name for name in channels if name.startswith("sense")):
        values = channels[name][0]
        noise = rng.normal(0.0, np.std(values) * 10.0 ** (-snr_db / 20.0), values.size)
        channels[name] = (values + noise, *channels[name][1:])
    return Recording.from_arrays(channels, device)


def wrap_half_turn(phase: Array) -> Array:
    """Phase errors modulo pi [rad], in [-pi/2, pi/2): theta and -theta make the same sense signal."""
    return (phase + np.pi / 2) % np.pi - np.pi / 2


def track_phase(observations: BlockObservations, device: Device) -> tuple[Array, Array]:
    """Tracked phases and their standard deviations, each of shape (blocks, axes) [rad]."""
    start, _ = choose_signs(observations, initial_estimate(observations, device))
    parts = tuning_parts(observations.signal)
    densities, offset_density = tune_process_noise(observations, start, parts)
    observations, parts = observations.with_offset_density(offset_density), with_offset_density(parts, offset_density)
    posterior = noise_posterior(observations, start, parts, densities)
    track = average_over_noise(observations, start, posterior)
    phases = [axis * AXIS_STATES + PHASE for axis in range(len(observations.parameters))]
    return track.states[:, phases], track.sds[:, phases]


def compare_with_bound(shared: bool, drifts: int) -> Points:
    """Phase error and its bound [deg], their ratio, and the coverage of the 95 % intervals, by SNR and axis.

    Args:
        shared: whether both combs are on one electrode.
        drifts: number of drifts.
    """
    device = noise_free_device(shared)
    squares: dict[tuple[int, str], list[Array]] = {}
    bounds: dict[tuple[int, str], list[Array]] = {}
    covered: dict[tuple[int, str], list[NDArray[np.bool_]]] = {}
    for seed in range(drifts):
        rng = np.random.default_rng(seed)
        drift = {axis: Drift(draw_stiffness_drift(rng)) for axis in DRIVES}
        quiet, _ = simulate(device, Plan(DRIVES, DURATION_S, drift=drift))
        for sense in sense_channels(quiet, device):
            references = {name: phase_reference(quiet, device, name, sense.channel, True) for name in sense.axes}
            exact = demodulate_blocks(lay_out_blocks(quiet, device, sense, references))
            start, _ = choose_signs(exact, initial_estimate(exact, device))
            densities = np.tile(NOISE_FREE_DENSITIES, (1, len(sense.axes), 1))
            truth = track_blocks(exact, start, densities)[0].states
            true_densities = np.tile([0.0, STIFFNESS_RATE_DENSITY, 0.0, 0.0], (len(sense.axes), 1))
            power = float(np.var(sense.channel.read()))
            for snr in SNR_DB:
                noise_var = power * 10.0 ** (-snr / 10.0)
                _, bound = phase_sd_bounds(exact, truth, start.covariance, true_densities, noise_var)
                for _ in range(NOISES_PER_DRIFT):
                    noisy = add_white_noise(quiet, snr, rng, device)
                    (noisy_sense,) = (s for s in sense_channels(noisy, device) if s.channel.name == sense.channel.name)
                    observations = demodulate_blocks(lay_out_blocks(noisy, device, noisy_sense, references))
                    phase, sd = track_phase(observations, device)
                    for i, name in enumerate(sense.axes):
                        error = wrap_half_turn(phase[:, i] - truth[:, i * AXIS_STATES + PHASE])
                        squares.setdefault((snr, name), []).append(error**2)
                        bounds.setdefault((snr, name), []).append(bound[:, i] ** 2)
                        covered.setdefault((snr, name), []).append(np.abs(error) < 1.96 * sd[:, i])
    points: Points = {}
    for (snr, name), values in squares.items():
        rmse, bound_deg = (float(np.rad2deg(np.sqrt(np.mean(v)))) for v in (values, bounds[snr, name]))
        coverage = float(np.mean(covered[snr, name]))
        point = {"rmse_deg": rmse, "bound_deg": bound_deg, "ratio": rmse / bound_deg, "held": coverage}
        points.setdefault(f"{snr} dB", {})[name] = point
    return points


def compare_with_ukf(drifts: int) -> Points:
    """Phase errors of UKF and tracker on the same recordings [deg] and their ratio, by device file and axis.

    Both axes are on one electrode.
    """
    device = devices.load("imaging")
    squares: dict[tuple[str, str, str], list[float]] = {}
    for seed in range(drifts):
        drift = {axis: Drift(draw_stiffness_drift(np.random.default_rng(seed))) for axis in DRIVES}
        recording, truth = simulate(device, Plan(DRIVES, DURATION_S, drift=drift), seed=seed)
        for case, factors in DEVICE_FILE_ERRORS.items():
            for method in ("ukf", "tracker"):
                motion = estimate(recording, scale_mechanics(device, *factors), method)
                for name, axis in motion.axes.items():
                    error = evaluate_axis(axis, truth[f"angle_{name}"][0], axis.angle.sample_rate, axis.angle.start)
                    squares.setdefault((case, name, method), []).append(error.phase_rmse**2)
    points: Points = {}
    for case in DEVICE_FILE_ERRORS:
        for name in DRIVES:
            ukf, tracker = (float(np.rad2deg(np.sqrt(np.mean(squares[case, name, m])))) for m in ("ukf", "tracker"))
            points.setdefault(case, {})[name] = {"ukf_deg": ukf, "tracker_deg": tracker, "ratio": ukf / tracker}
    return points


def scale_mechanics(device: Device, k: float, b: float) -> Device:
    """The device with every axis's stiffness multiplied by ``k`` and its damping by ``b``."""
    axes = {}
    for name, axis in device.axes.items():
        mechanics = axis.require_mechanics()
        axes[name] = replace(axis, mechanics=replace(mechanics, k=k * mechanics.k, b=b * mechanics.b))
    return replace(device, axes=axes)


def summarise_benchmark(drifts: int) -> dict[str, float]:
    """Largest ratio to the bound, mean coverage of the 95 % intervals, and least ratio of the UKF's error."""
    points = [
        point
        for shared in (True, False)
        for by_axis in compare_with_bound(shared, drifts).values()
        for point in by_axis.values()
    ]
    nominal, miscalibrated = (
        min(axis["ratio"] for axis in by_axis.values()) for by_axis in compare_with_ukf(drifts).values()
    )
    return {
        "tracker.rmse_over_crb": max(point["ratio"] for point in points),
        "tracker.held_by_95_percent": float(np.mean([point["held"] for point in points])),
        "tracker.ukf_rmse_over_own": nominal,
        "tracker.ukf_rmse_over_own_miscalibrated": miscalibrated,
    }


def main() -> None:
    drifts = int(sys.argv[1]) if len(sys.argv) > 1 else 8
    results = {
        "shared": compare_with_bound(True, drifts),
        "separate": compare_with_bound(False, drifts),
        "UKF": compare_with_ukf(drifts),
    }
    print(json.dumps(results, indent=1))


if __name__ == "__main__":
    main()
