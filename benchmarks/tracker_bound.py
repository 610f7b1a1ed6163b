"""Phase error of the tracker against the posterior Cramer-Rao bound (docs/bound.md) and the UKF, from 40 to 0 dB.

The stiffness of both axes drifts as an integrated random walk, drawn anew for every path; several noises are laid over
each path. The tracker is not told the drift's law: it tunes its own. Run: python benchmarks/tracker_bound.py [paths]
"""

from __future__ import annotations

import json
import sys
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from estimation.estimate import estimate
from estimation.signals import reference_of, senses
from estimation.tracker.bound import phase_bound
from estimation.tracker.signal import laid_out, prepare
from estimation.tracker.step import PHASE, STATES
from estimation.tracker.track import averaged, follow, signed, starting_belief
from estimation.tracker.tuning import likely_walks, stretches, tuned_walk
from phantoms.forward import Plan, simulate
from phantoms.waveforms import Sine
from recon.score import axis_error
from scanner import devices
from scanner.device import Amdm, Device
from scanner.drift import Drift, Factor
from scanner.recording import Recording

TREND_DENSITY = 0.4  # of the stiffness's trend [1/s3]: 0.2 % in 30 ms
DURATION = 0.03
SNR_DB = (40, 30, 20, 10, 0)  # of a sample: variance of the signal over variance of the noise
NOISES = 4
OFF = {"nominal": (1.0, 1.0), "k off by 0.1 %, b by 5 %": (1.001, 1.05)}  # what the device file says of k and b
DRIVES = {"x": Sine(27680.0, 30.0, 30.0), "y": Sine(6540.0, 30.0, 30.0)}


def wandering(rng: np.random.Generator) -> Factor:
    """A stiffness whose trend walks at random."""
    step, n = 2e-5, round(DURATION / 2e-5) + 2
    trend = np.cumsum(rng.normal(0.0, np.sqrt(TREND_DENSITY * step), n))
    path = 1.0 + np.cumsum(trend) * step
    return lambda time: np.where(time > 0.0, np.interp(time, np.arange(n) * step, path), 1.0)


def device_with(shared: bool) -> Device:
    """The imaging scanner without noise or converter, its combs on one electrode or on one each."""
    device = devices.load("imaging")
    assert isinstance(device.readout, Amdm)
    readout = replace(device.readout, noise_var=0.0, bits=None)
    if shared:
        return replace(device, readout=readout)
    axes = {name: replace(axis, readout=replace(readout, b_cir=4.95)) for name, axis in device.axes.items()}
    return replace(device, axes=axes, readout=None)


def with_noise(recording: Recording, snr_db: float, rng: np.random.Generator, device: Device) -> Recording:
    """The recording with white noise on its sense signals."""
    channels = {k: (c.read(), c.unit, c.sample_rate, c.start) for k, c in recording.channels.items()}
    for name in (name for name in channels if name.startswith("sense")):
        values = channels[name][0]
        noise = rng.normal(0.0, np.std(values) * 10.0 ** (-snr_db / 20.0), values.size)
        channels[name] = (values + noise, *channels[name][1:])
    return Recording.from_arrays(channels, device)


def ratios(shared: bool, paths: int) -> dict[str, dict[str, dict[str, float]]]:
    """Error and bound [deg], their ratio, share of blocks whose 95 % interval holds the truth; by SNR and axis."""
    device = device_with(shared)
    squares: dict[tuple[int, str], list[NDArray[np.float64]]] = {}
    bounds: dict[tuple[int, str], list[NDArray[np.float64]]] = {}
    held: dict[tuple[int, str], list[NDArray[np.bool_]]] = {}
    for path in range(paths):
        rng = np.random.default_rng(path)
        drift = {axis: Drift(wandering(rng)) for axis in DRIVES}
        quiet, _ = simulate(device, Plan(DRIVES, DURATION, drift=drift))
        for sense in senses(quiet, device):
            references = {name: reference_of(quiet, device, name, sense.channel, True) for name in sense.axes}
            known = prepare(laid_out(quiet, device, sense, references))
            start, _ = signed(known, starting_belief(known, device))
            truth = follow(known, start, np.tile([1e-6, 10.0, 1e-6], (1, len(sense.axes), 1)))[0].states
            walk = np.tile([0.0, TREND_DENSITY, 0.0, 0.0], (len(sense.axes), 1))
            power = float(np.var(sense.channel.read()))
            for snr in SNR_DB:
                _, least = phase_bound(known, truth, start.P, walk, power * 10.0 ** (-snr / 10.0))
                for _ in range(NOISES):
                    noisy = with_noise(quiet, snr, rng, device)
                    (own,) = (s for s in senses(noisy, device) if s.channel.name == sense.channel.name)
                    prepared = prepare(laid_out(noisy, device, own, references))
                    begin, _ = signed(prepared, starting_belief(prepared, device))
                    parts = stretches(prepared.signal)
                    likely = likely_walks(prepared, begin, parts, tuned_walk(prepared, begin, parts))
                    found = averaged(prepared, begin, likely)
                    for i, name in enumerate(sense.axes):
                        error = found.states[:, i * STATES + PHASE] - truth[:, i * STATES + PHASE]
                        error = (error + np.pi / 2) % np.pi - np.pi / 2
                        squares.setdefault((snr, name), []).append(error**2)
                        bounds.setdefault((snr, name), []).append(least[:, i] ** 2)
                        within = np.abs(error) < 1.96 * found.sds[:, i * STATES + PHASE]
                        held.setdefault((snr, name), []).append(within)
    out: dict[str, dict[str, dict[str, float]]] = {}
    for (snr, name), values in squares.items():
        rmse, least = (float(np.rad2deg(np.sqrt(np.mean(v)))) for v in (values, bounds[snr, name]))
        share = float(np.mean(held[snr, name]))
        told = {"rmse_deg": rmse, "bound_deg": least, "ratio": rmse / least, "held": share}
        out.setdefault(f"{snr} dB", {})[name] = told
    return out


def against_ukf(paths: int) -> dict[str, dict[str, dict[str, float]]]:
    """Phase errors of UKF and tracker on the same recordings, both axes on one electrode [deg]; by device and axis."""
    device = devices.load("imaging")
    squares: dict[tuple[str, str, str], list[float]] = {}
    for path in range(paths):
        drift = {axis: Drift(wandering(np.random.default_rng(path))) for axis in DRIVES}
        recording, truth = simulate(device, Plan(DRIVES, DURATION, drift=drift), seed=path)
        for told, factors in OFF.items():
            for method in ("ukf", "tracker"):
                motion = estimate(recording, miscalibrated(device, *factors), method)
                for name, axis in motion.axes.items():
                    error = axis_error(axis, truth[f"angle_{name}"][0], axis.angle.sample_rate, axis.angle.start)
                    squares.setdefault((told, name, method), []).append(error.phase_rmse**2)
    out: dict[str, dict[str, dict[str, float]]] = {}
    for told in OFF:
        for name in DRIVES:
            ukf, own = (float(np.rad2deg(np.sqrt(np.mean(squares[told, name, m])))) for m in ("ukf", "tracker"))
            out.setdefault(told, {})[name] = {"ukf_deg": ukf, "tracker_deg": own, "ratio": ukf / own}
    return out


def miscalibrated(device: Device, k: float, b: float) -> Device:
    """The device with every axis's stiffness and damping multiplied."""
    axes = {}
    for name, axis in device.axes.items():
        own = axis.require_mechanics()
        axes[name] = replace(axis, mechanics=replace(own, k=k * own.k, b=b * own.b))
    return replace(device, axes=axes)


def figures(paths: int) -> dict[str, float]:
    """The worst point, the mean share that the intervals hold, and the least gain on the UKF."""
    points = [
        point for shared in (True, False) for by_axis in ratios(shared, paths).values() for point in by_axis.values()
    ]
    nominal, off = (min(axis["ratio"] for axis in by_axis.values()) for by_axis in against_ukf(paths).values())
    return {
        "tracker.rmse_over_crb": max(point["ratio"] for point in points),
        "tracker.held_by_95_percent": float(np.mean([point["held"] for point in points])),
        "tracker.ukf_rmse_over_own": nominal,
        "tracker.ukf_rmse_over_own_miscalibrated": off,
    }


def main() -> None:
    paths = int(sys.argv[1]) if len(sys.argv) > 1 else 8
    told = {"shared": ratios(True, paths), "separate": ratios(False, paths), "UKF": against_ukf(paths)}
    print(json.dumps(told, indent=1))


if __name__ == "__main__":
    main()
