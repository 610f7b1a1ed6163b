"""The tracker where the sense signal leaves its rails, against the bound with rails (docs/bound.md).

chen2019's comb behind its transimpedance readout, clipped throughout, and the imaging scanner's x axis, clipped for six
milliseconds of thirty. Run: python benchmarks/clipped.py [noises of each]
"""

from __future__ import annotations

import json
import sys
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from benchmarks.tracker_bound import DRIVES, device_with, wandering
from estimation.signals import reference_of, senses
from estimation.tracker import track
from estimation.tracker.bound import UNBOUNDED, phase_bound
from estimation.tracker.signal import laid_out, prepare
from estimation.tracker.step import PHASE
from estimation.tracker.track import follow, signed, starting_belief
from estimation.tracker.tuning import densities
from phantoms.forward import Plan, simulate
from phantoms.waveforms import Sine
from scanner import devices
from scanner.device import Device, Drive, Transimpedance
from scanner.drift import Drift
from scanner.laws import capacitance_slope, transimpedance_voltage
from scanner.recording import Recording

Array = NDArray[np.float64]

RAILS = (0.5, 0.2, 0.1, 0.05, 0.02, 0.0)  # of the signal's peak; 0 is a comparator
AMPLITUDE, RATE = 0.15, 5e5  # rad, Hz: chen2019's
DURATION, DENSITY = 0.2, 0.01  # s; of the stiffness's trend [1/s3]
WALK = np.array([[1e-9, DENSITY, 1e-8]])  # the process as it is, for the bound
CLIPPED = slice(60_000, 90_000)  # samples of the imaging scanner's
INSIDE = (0.0125, 0.0175)  # s: blocks that are clipped as a whole


def transimpedance_world() -> tuple[Device, Recording]:
    """chen2019's axis under a linear torque and a constant bias, and its recording without noise or rails."""
    axis = devices.load("chen2019").axis("x")
    readout, comb = axis.require_readout(), axis.require_capacitance()
    assert isinstance(readout, Transimpedance)
    drive = Drive("linear", AMPLITUDE * axis.require_mechanics().k / axis.quality)
    device = replace(
        devices.load("chen2019"), axes={"x": replace(axis, drive=drive, readout=replace(readout, bits=None))}
    )
    rng, step = np.random.default_rng(5), 2e-5
    trend = np.cumsum(rng.normal(0.0, np.sqrt(DENSITY * step), round(DURATION / step) + 2))
    path = 1.0 + np.cumsum(trend) * step
    drift = Drift(lambda time: np.where(time > 0.0, np.interp(time, np.arange(path.size) * step, path), 1.0))
    plan = Plan({"x": Sine(axis.resonance, 1.0)}, DURATION, sample_rate=RATE, settle=0.4, drift={"x": drift})
    recording, truth = simulate(device, plan)
    angle = truth["angle_x"][0].astype(np.float64)
    slope = capacitance_slope(angle, comb.C0, comb.theta0, comb.theta_th)
    signal = transimpedance_voltage(slope, np.gradient(angle, 1.0 / RATE), readout.R_s, readout.V_bias)
    return device, with_signal(recording, device, "sense_x", signal)


def with_signal(recording: Recording, device: Device, name: str, values: Array) -> Recording:
    """The recording with other samples of one channel."""
    channels = {k: (c.read(), c.unit, c.sample_rate, c.start) for k, c in recording.channels.items()}
    return Recording.from_arrays({**channels, name: (values, *channels[name][1:])}, device)


def clipped(signal: Array, rail: float) -> Array:
    """The signal between two rails; its sign for none."""
    return np.clip(signal, -rail, rail) if rail > 0.0 else np.sign(signal)


def told(error: Array, sd: Array) -> dict[str, float]:
    """Root mean square of errors and deviations [deg], and the share that 95 % intervals hold."""
    rmse, claimed = (float(np.rad2deg(np.sqrt(np.mean(each**2)))) for each in (error, sd))
    return {"rmse_deg": rmse, "sd_deg": claimed, "held": float(np.mean(np.abs(error) < 1.96 * sd))}


def between_rails(noises: int) -> dict[str, dict[str, float]]:
    """Phase errors of recordings that are clipped throughout, and their bounds, by rail."""
    device, quiet = transimpedance_world()
    signal = quiet["sense_x"].read()
    (sense,) = senses(quiet, device)
    reference = reference_of(quiet, device, "x", sense.channel, True)
    known = prepare(laid_out(quiet, device, sense, {"x": reference}))
    start, _ = signed(known, starting_belief(known, device))
    states = follow(known, start, WALK[None])[0].states
    true = states[:, PHASE] + known.signal.psi[:, 0] - reference.phase(known.time)
    noise_sd = device.axis("x").require_readout().noise_sd
    out = {}
    for rail in RAILS:
        limit = rail * float(np.abs(signal).max())
        errors, sds = [], []
        for seed in range(noises):
            noisy = signal + np.random.default_rng(seed).normal(0.0, noise_sd, signal.size)
            axis = track(with_signal(quiet, device, "sense_x", clipped(noisy, limit)), device).axes["x"]
            errors.append((axis.phase - true + np.pi / 2) % np.pi - np.pi / 2)
            sds.append(axis.phase_sd)
        bounds = {
            key: float(np.rad2deg(np.sqrt(np.mean(bound[1] ** 2))))
            for key, rails in (("bound_deg", (-limit, limit)), ("unclipped_bound_deg", UNBOUNDED))
            for bound in [phase_bound(known, states, start.P, densities(WALK), noise_sd**2, rails)]
        }
        found = told(np.array(errors), np.array(sds))
        out[f"{rail:g}"] = {**found, **bounds, "ratio": found["rmse_deg"] / bounds["bound_deg"]}
    return out


def in_a_stretch(drifts: int, noises: int, sd: float = 0.01386) -> dict[str, dict[str, float]]:
    """Phase errors of the imaging scanner's x axis, six milliseconds of it clipped to the middle 70 % of the values."""
    device = device_with(False)
    device = replace(device, axes={"x": device.axis("x")}, scan=None)
    errors, sds, time = [], [], np.empty(0)
    for seed in range(drifts):
        rng = np.random.default_rng(seed)
        plan = Plan({"x": DRIVES["x"]}, 0.03, drift={"x": Drift(wandering(rng))})
        quiet, _ = simulate(device, plan)
        signal = quiet["sense_x"].read()
        exact = track(quiet, device).axes["x"].phase
        for _ in range(noises):
            noisy = signal + rng.normal(0.0, sd, signal.size)
            noisy[CLIPPED] = np.clip(noisy[CLIPPED], *np.quantile(noisy, [0.15, 0.85]))
            axis = track(with_signal(quiet, device, "sense_x", noisy), device).axes["x"]
            errors.append((axis.phase - exact + np.pi / 2) % np.pi - np.pi / 2)
            sds.append(axis.phase_sd)
            time = axis.time
    error, claimed = np.array(errors), np.array(sds)
    inside = (time > INSIDE[0]) & (time < INSIDE[1])
    return {"whole scan": told(error, claimed), "clipped": told(error[:, inside], claimed[:, inside])}


def main() -> None:
    noises = int(sys.argv[1]) if len(sys.argv) > 1 else 40
    print(json.dumps({"stretch": in_a_stretch(noises // 2, 2), "rails": between_rails(noises)}, indent=1))


if __name__ == "__main__":
    main()
