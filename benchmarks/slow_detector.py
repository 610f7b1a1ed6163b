"""Pictures behind a slow detector, as a multiple of the error behind a fast one.

Every scan is the demo's (both axes on one electrode, resonances that drift, 5 MS/s, 60 ms) of one of six scenes. The
detector's low-pass is of first order, photon noise arises before it and electronic noise after it. The device states
the low-pass (term detector-lag). Both detectors record the same photons. "delay only": only the delay of the
low-pass is corrected, as in a picture of means.

The fast detector of the simulation sees the light at the sample's moment. One that collects its photons during the
sampling interval, as photon counters do, sees the mean over it: "fast, over its interval". What the slow detector saw
is at best that.
Run: python -m benchmarks.slow_detector SEED... [--photons N] [--bandwidth HZ] [--read-noise PHOTONS]
"""

from __future__ import annotations

import argparse
from dataclasses import replace

import numpy as np

from benchmarks.sample_motion import PIXELS, REST_DURATION_S, SCENES, Scan, load_light, simulate_scan
from estimation.optics.correction import correct_intensity
from phantoms.optics import Detector, detect, sample_scene
from recon.pipeline import reconstruct
from recon.steps.reconstruction import Options
from scanner.device import Device
from scanner.recording import Recording

KINDS = ("kernel", "posterior")


INTERVAL_MEAN = (0.125, 0.75, 0.125)
"""Weights of the neighbours in the mean over a sampling interval around each sample, for light linear in between."""


def record(scan: Scan, seed: int, detector: Detector, over_interval: bool = False) -> Recording:
    """The recording of a scan behind another detector, which may see the mean light over each sampling interval."""
    device, channel = scan.recording.device, scan.recording["intensity"]
    assert device is not None
    half = device.require_scan().mechanical_half_angles
    light = sample_scene(load_light(SCENES[seed % len(SCENES)]), scan.truth["x"], scan.truth["y"], *half)
    if over_interval:
        light = np.convolve(np.pad(light, 1, mode="edge"), INTERVAL_MEAN, "valid")
    rng = np.random.default_rng([seed, 3])
    return scan.recording.with_channel(replace(channel, raw=detect(light, channel.sample_rate, detector, rng)))


def measure(recording: Recording, device: Device, kind: str, scan: Scan) -> tuple[float, float]:
    """Rms error of a picture, and fraction of its 95 % intervals that hold the scene."""
    options = Options(device=device, pixels=(PIXELS, PIXELS), picture=kind)  # type: ignore[arg-type]
    result = reconstruct(recording, options, quiet=True)
    image, sd = result.picture.image, result.picture_sd
    for axis, along in (("x", 1), ("y", 0)):
        angle, true = result.motion.axes[axis].angle.read(), scan.truth[axis]
        if angle @ true[: angle.size] < 0:  # the sense signal does not determine the signs of the axes
            image, sd = np.flip(image, along), np.flip(sd, along)
    error, used = image - scan.picture, np.isfinite(image)
    held = np.mean(np.abs(error[used]) < 1.96 * sd[used])
    return float(np.sqrt(np.mean(error[used] ** 2))), float(held)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("seeds", type=int, nargs="+")
    parser.add_argument("--photons", type=float, default=100.0)
    parser.add_argument("--bandwidth", type=float, default=2e5)
    parser.add_argument("--read-noise", type=float, default=0.0)
    args = parser.parse_args()
    fast = Detector(1.0 / args.photons, args.photons, args.read_noise / args.photons)
    slow = replace(fast, bandwidth_hz=args.bandwidth)
    print("| scene | picture | fast detector | slow / fast | slow / fast, over its interval | delay only / fast "
          "| 95 % fast | 95 % slow |")  # fmt: skip
    print("|---" * 8 + "|")
    for seed in args.seeds:
        scan = simulate_scan("rest", args.photons, seed, REST_DURATION_S)
        device = scan.recording.device
        assert device is not None
        with_lag = device.with_terms({"x": {"detector-lag": {"f_c": args.bandwidth}}})
        early, late = record(scan, seed, fast), record(scan, seed, slow)
        counting = record(scan, seed, fast, over_interval=True)
        delayed = correct_intensity(late, with_lag)
        for kind in KINDS:
            best, fast_held = measure(early, device, kind, scan)
            own, held = measure(late, with_lag, kind, scan)
            counted = measure(counting, device, kind, scan)[0]
            only = measure(delayed, device, kind, scan)[0]
            print(
                f"| {SCENES[seed % len(SCENES)]} | {kind} | {best:.4f} | {own / best:.3f} | {own / counted:.3f} "
                f"| {only / best:.3f} | {100 * fast_held:.1f} | {100 * held:.1f} |",
                flush=True,
            )


if __name__ == "__main__":
    main()
