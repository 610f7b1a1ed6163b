"""Whether the harmonics of the sense signal, and the drive, determine a delay that the device file does not state.

    python -m benchmarks.delay_from_harmonics SCANS [--first SEED]

A delay shifts the nth harmonic by n times the shift of the first, as a motion that is late does. Only the averaged
dynamics distinguish both: they relate the phase against the drive to the change of the amplitude. The likelihood of the
tracker is compared for sense signals shifted in time, with the damping as tuned, and with a damping that may change by
5 % in a scan. The delay is drawn from its prior. Prints the error of the posterior mean and the stated standard
deviation, each rms.
"""

from __future__ import annotations

import argparse
from dataclasses import replace

import numpy as np

from benchmarks.readout_errors import IMPERFECTIONS, with_sense
from benchmarks.tracker_bound import DRIVES
from estimation.signals import phase_reference, sense_channels
from estimation.tracker.block_tracking import average_over_noise
from estimation.tracker.initial_state import RELATIVE_DAMPING_SD
from estimation.tracker.observations import lay_out_blocks
from estimation.tracker.process_noise import INITIAL_DENSITIES, noise_posterior, tuning_parts, with_offset_density
from estimation.tracker.track import tune_section
from phantoms.forward import InitialState, Plan, simulate
from recon.imaging.scan_phase.readout_phase import UNDESCRIBED_DELAY_SD_S
from scanner import devices
from scanner.device import AXES, Device
from scanner.drift import Drift, exponential
from scanner.recording import Recording

DURATION_S = 0.04
DRIFT_TIME_S = 0.025
FREE_DAMPING_DENSITY = RELATIVE_DAMPING_SD**2 / DURATION_S
"""Density of a damping that may change by its tolerance during a scan [1/s]."""

DAMPING = 2
"""Column of the damping's density."""

SMALL_AMPLITUDE_RAD = 0.05
"""Amplitude at the beginning of a scan in which the mirror starts: a third of the steady one."""

HALVINGS = 4
"""Times at which the interval next to the most probable delay is halved: from half a microsecond to 0.03 µs."""

CASES = {
    "steady": (0.0, False, None),
    "steady, damping changes by 1 %": (0.01, False, None),
    "mirror starts": (0.0, True, None),
    "mirror starts, damping changes by 3 %": (0.03, True, None),
    "mirror starts, curved characteristic": (0.0, True, "curve"),
    "mirror starts, gain follows the level": (0.0, True, "level"),
}
"""Change of the damping, whether the mirror starts, and an imperfection of the readout, by case."""


def log_likelihood(recording: Recording, device: Device, delay: float, min_damping_density: float) -> float:
    """Log-likelihood of a recording whose sense signal is late by ``delay`` [s].

    Args:
        min_damping_density: least density of the damping's random walk [1/s].
    """
    channel = recording["sense"]
    recording = recording.with_channel(replace(channel, start=channel.start - delay))
    (sense,) = sense_channels(recording, device)
    references = {name: phase_reference(recording, device, name, sense.channel, True) for name in sense.axes}
    layout = lay_out_blocks(recording, device, sense, references)
    densities = np.tile(INITIAL_DENSITIES, (len(AXES), 1))
    section = tune_section(layout, (0, layout.starts.size), device, None, densities, False)
    densities = section.tuning.densities.copy()
    densities[:, DAMPING] = np.maximum(densities[:, DAMPING], min_damping_density)
    parts = with_offset_density(tuning_parts(section.observations.signal), section.tuning.offset_density)
    posterior = noise_posterior(section.observations, section.prior, parts, densities)
    return float(average_over_noise(section.observations, section.prior, posterior).log_likelihood)


def delay_posterior(recording: Recording, device: Device, min_damping_density: float) -> tuple[float, float]:
    """Mean and standard deviation of the delay [s]; arguments as for :func:`log_likelihood`."""
    found: dict[float, float] = {}

    def evaluate(delays: list[float]) -> None:
        for delay in delays:
            prior = -0.5 * (delay / UNDESCRIBED_DELAY_SD_S) ** 2
            found[delay] = log_likelihood(recording, device, delay, min_damping_density) + prior

    evaluate((UNDESCRIBED_DELAY_SD_S * np.arange(-4.0, 5.0)).tolist())
    for _ in range(HALVINGS):
        delays = sorted(found)
        at = delays.index(max(found, key=lambda delay: found[delay]))
        near = [delays[k] for k in (at - 1, at + 1) if 0 <= k < len(delays)]
        evaluate([0.5 * (delays[at] + other) for other in near])
    fine = np.linspace(min(found), max(found), 4001)
    weight = np.interp(fine, sorted(found), [found[delay] for delay in sorted(found)])
    weight = np.exp(weight - weight.max())
    mean = float(np.average(fine, weights=weight))
    return mean, float(np.sqrt(np.average((fine - mean) ** 2, weights=weight)))


def simulate_scan(seed: int, case: str) -> tuple[Recording, float]:
    """A recording of the case whose sense signal is late, and its delay [s]."""
    damping, starts, imperfection = CASES[case]
    rng = np.random.default_rng([31, seed])
    delay = float(rng.normal(0.0, UNDESCRIBED_DELAY_SD_S))
    drift = {
        name: Drift(
            exponential(float(rng.uniform(-0.002, 0.002)), DRIFT_TIME_S),
            exponential(float(rng.choice([-1.0, 1.0])) * damping, DRIFT_TIME_S),
        )
        for name in AXES
    }
    start = {name: InitialState(SMALL_AMPLITUDE_RAD, 0.0) for name in AXES} if starts else None
    recording, _ = simulate(devices.load("imaging"), Plan(DRIVES, DURATION_S, drift=drift), seed=seed, start=start)
    if imperfection is not None:
        sense, drive = recording["sense"], recording["drive_x"].read()
        recording = with_sense(recording, IMPERFECTIONS[imperfection](sense.read(), drive, sense.sample_rate, rng))
    channel = recording["sense"]
    return recording.with_channel(replace(channel, start=channel.start + delay)), delay


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scans", type=int, help="number of scans of each case")
    parser.add_argument("--first", type=int, default=0, help="seed of the first scan")
    args = parser.parse_args()
    device = devices.load("imaging")
    print("| case | damping as tuned: error, stated sd [µs] | damping may change by 5 % |\n|---|---|---|")
    for case in CASES:
        cells = []
        scans = [simulate_scan(seed, case) for seed in range(args.first, args.first + args.scans)]
        for density in (0.0, FREE_DAMPING_DENSITY):
            found = [(*delay_posterior(recording, device, density), true) for recording, true in scans]
            mean, sd, true = 1e6 * np.array(found).T
            cells.append(f"{np.sqrt(np.mean((mean - true) ** 2)):.2f}, {np.sqrt(np.mean(sd**2)):.2f}")
        print(f"| {case} | {' | '.join(cells)} |", flush=True)


if __name__ == "__main__":
    main()
