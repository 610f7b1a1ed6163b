"""Phase from edge times: standard deviation against its bound, coverage, and the mean of six half-periods beside it.

    python -m benchmarks.sync_edges

A mirror moves at 5 kHz. In the first case its frequency walks at random, which has a Cramer-Rao bound (the inverse of
the Bayesian information matrix of phase and frequency at all edges, computed here without the estimator). In the second
its frequency drifts by -0.1 % with a time constant of 25 ms, as one that warms up. One edge in 100 is missing, one in
100 is repeated; for the mean of six half-periods, none is. The third case is the demo's scan, a mirror with combs whose
third harmonic displaces the edges, with the recorded drive and the device file.
"""

from __future__ import annotations

import numpy as np

from estimation.sync.edge_phase import phase_from_edges
from estimation.sync.motion import axis_motion_from_edges
from phantoms.experiment import Experiment, simulate_experiment
from phantoms.sync import SyncDetector, sync_edges
from recon.evaluation import evaluate_axis
from scanner.arrays import Array
from scanner.edges import Edges, make_edges

AMPLITUDE_RAD, FREQUENCY_HZ, RATE_HZ, DURATION_S, JITTER_S = 0.1, 5000.0, 1e6, 0.1, 5e-8
WALK_RAD_S = 30.0
"""Standard deviation of the walk of the angular frequency [rad/s] after one second."""
ANGLE_RAD = 0.02
SEEDS = range(91_400, 91_460)
DEMO_SEEDS = range(91_500, 91_510)


def walking_phase(rng: np.random.Generator) -> Array:
    rate = np.cumsum(rng.normal(0.0, WALK_RAD_S / np.sqrt(RATE_HZ), round(DURATION_S * RATE_HZ)))
    return rng.uniform(0, 2 * np.pi) + np.cumsum(2 * np.pi * FREQUENCY_HZ + rate) / RATE_HZ


def drifting_phase(rng: np.random.Generator) -> Array:
    time = np.arange(round(DURATION_S * RATE_HZ)) / RATE_HZ
    drift = -1e-3 * (time - 0.025 * (1.0 - np.exp(-time / 0.025)))
    return rng.uniform(0, 2 * np.pi) + 2 * np.pi * FREQUENCY_HZ * (time + drift)


def bound(time: Array, side: Array, jitter: float, walk: float) -> Array:
    """Bound of the phase's standard deviation at every edge [rad], with unknown asymmetry.

    Args:
        time: of the edges [s]. side: 1 or -1 by the kind of edge.
        jitter: of an edge [rad]. walk: density of the frequency's walk [rad2/s3].
    """
    n = time.size
    information = np.zeros((2 * n + 1, 2 * n + 1))
    for k, step in enumerate(np.diff(time)):
        at = slice(2 * k, 2 * k + 4)
        F = np.array([[-1.0, -step, 1.0, 0.0], [0.0, -1.0, 0.0, 1.0]])
        Q = walk * np.array([[step**3 / 3, step**2 / 2], [step**2 / 2, step]])
        information[at, at] += F.T @ np.linalg.solve(Q, F)
    for k in range(n):
        h = np.zeros(2 * n + 1)
        h[2 * k], h[-1] = 1.0, side[k]
        used = [2 * k, 2 * n]
        information[np.ix_(used, used)] += np.outer(h[used], h[used]) / jitter**2
    scale = 1.0 / np.sqrt(np.diag(information))
    covariance = np.linalg.inv(information * np.outer(scale, scale)) * np.outer(scale, scale)
    return np.sqrt(np.diag(covariance)[: 2 * n : 2])


def six_half_periods(edges: Edges, time: Array, phase: Array) -> float:
    """Error of the phase a quarter period after each edge, by the mean of the six half-periods before [rad rms].

    The detector is taken to be in the centre: each edge is a multiple of half a period.
    """
    half = (edges.times[6:] - edges.times[:-6]) / 6.0
    at = edges.times[6:-1] + 0.5 * half[:-1]
    true = np.interp(at, time, phase)
    error = 0.5 * np.pi - (true - np.interp(edges.times[6:-1], time, phase))
    anchored = np.interp(edges.times[6:-1], time, phase)
    error += np.pi * np.round(anchored / np.pi) - anchored
    return float(np.sqrt(np.mean(error**2)))


def demo_scan() -> None:
    """Print the errors of both axes of the demo's scan."""
    errors: dict[str, list[float]] = {axis: [] for axis in "xy"}
    stated, inside = {axis: [] for axis in "xy"}, {axis: [] for axis in "xy"}
    for seed in DEMO_SEEDS:
        recording, truth = simulate_experiment(Experiment(duration=0.06), seed)
        for axis in "xy":
            angle, attrs = truth[f"angle_{axis}"]
            rate, rng = attrs["sample_rate"], np.random.default_rng(seed)
            times = sync_edges(angle, rate, SyncDetector(ANGLE_RAD, jitter=JITTER_S, missing=0.01, doubled=0.01), rng)
            edges = make_edges(f"sync_{axis}", times, {"unit": "s", "angle": ANGLE_RAD})
            clock = (rate, 0.0, angle.size)
            motion, _, _ = axis_motion_from_edges(recording, recording.device, edges, clock)
            error = evaluate_axis(motion, angle, rate, 0.0)
            sd = np.interp(error.time, motion.time, motion.phase_sd)
            errors[axis].append(float(np.mean(error.phase**2)))
            stated[axis].append(float(np.mean(sd**2)))
            inside[axis].append(float(np.mean(np.abs(error.phase) < 1.96 * sd)))
    for axis in "xy":
        rms, sd = (np.rad2deg(np.sqrt(np.mean(each[axis]))) for each in (errors, stated))
        print(f"demo, {axis}: phase {rms:.5f} deg rms, stated {sd:.5f} deg, {np.mean(inside[axis]):.1%} within")


def main() -> None:
    time = np.arange(round(DURATION_S * RATE_HZ)) / RATE_HZ
    for name, motion in (("random walk", walking_phase), ("drift", drifting_phase)):
        squares, inside, claimed, frequency, bounds = [], [], [], [], []
        others: dict[float, list[float]] = {ANGLE_RAD: [], 0.0: []}
        for seed in SEEDS:
            rng = np.random.default_rng(seed)
            phase = motion(rng)
            angle = AMPLITUDE_RAD * np.sin(phase)
            detector = SyncDetector(ANGLE_RAD, jitter=JITTER_S, missing=0.01, doubled=0.01)
            edges = make_edges("sync_x", sync_edges(angle, RATE_HZ, detector, rng), {"unit": "s", "angle": ANGLE_RAD})
            found = phase_from_edges(edges)
            error = found.phase - np.interp(found.time, time, phase)
            error -= 2 * np.pi * np.round(np.median(error) / (2 * np.pi))
            squares.append(np.mean(error**2))
            claimed.append(np.mean(found.phase_sd**2))
            inside.append(np.mean(np.abs(error) < 1.96 * found.phase_sd))
            true_frequency = np.interp(found.time, time, np.gradient(phase, time)) / (2 * np.pi)
            frequency.append(np.mean((found.frequency - true_frequency) ** 2))
            for angle_rad, errors in others.items():
                crossed = sync_edges(angle, RATE_HZ, SyncDetector(angle_rad, jitter=JITTER_S), rng)
                plain = make_edges("sync_x", crossed, {"unit": "s", "event": "both-edges"})
                errors.append(six_half_periods(plain, time, phase))
            if motion is walking_phase and seed == SEEDS[0]:
                side = 2.0 * found.numbered.kind[: found.time.size] - 1.0
                jitter = 2 * np.pi * FREQUENCY_HZ * JITTER_S
                bounds.append(np.mean(bound(found.time, side, jitter, WALK_RAD_S**2) ** 2))
        rms = np.sqrt(np.mean(squares))
        print(
            f"{name}: phase {np.rad2deg(rms):.5f} deg rms, stated {np.rad2deg(np.sqrt(np.mean(claimed))):.5f} deg, "
            f"{np.mean(inside):.1%} within the 95 % interval; frequency {np.sqrt(np.mean(frequency)):.4f} Hz rms"
        )
        for angle_rad, errors in others.items():
            other = np.sqrt(np.mean(np.square(errors)))
            print(
                f"  six half-periods, detector at {angle_rad} rad: {np.rad2deg(other):.5f} deg, {other / rms:.1f} times"
            )
        if bounds:
            print(f"  bound {np.rad2deg(np.sqrt(bounds[0])):.5f} deg, ratio {rms / np.sqrt(bounds[0]):.3f}")
    demo_scan()


if __name__ == "__main__":
    main()
