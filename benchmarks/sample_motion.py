"""Pictures of samples that move, with and without ``--sample-motion``, against frame-by-frame phase correlation.

    python -m benchmarks.sample_motion SCANS [--first SEED] [--photons N] [--duration S] [--motions A;B] [--rest]

Every scan is the demo's (both axes on one electrode, resonances that drift, 5 MS/s) of one of six scenes, of 0.2 s and
256 x 256 pixels. The sample moves by 10 pixels peak to peak in a random direction; a vibration has the stated size,
and "drift + vibration, 500 Hz, 3 px" moves by both. The error of a motion is taken over
all samples, without its mean; the error of a picture is that of the means of its pixels against the scene, over that
with the motion known. Phase correlation registers mean pictures of ``FRAME_S``, holes filled with the mean, with
``skimage.registration.phase_cross_correlation`` against the mean of the earlier frames. ``sd`` is the stated standard
deviation of the displacement, root mean square over the scan, both axes together; ``left`` that of a motion that is
stated as not followed. Seconds are processor time of the whole reconstruction. With --rest the samples are at
rest at 10, 100 or 1000 photons, the scans last 0.06 s, and those reported as moving are counted.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from estimation.estimate import default_estimator
from phantoms.experiment import Experiment, simulate_experiment
from phantoms.optics import Detector, blur_by_spot, detect, sample_scene
from phantoms.targets import TISSUES, make_target
from recon.imaging.gridding import map_samples
from recon.pipeline import correct_sample_motion, estimate_motion, reconstruct
from recon.steps.preparation import prepare
from recon.steps.reconstruction import Options, Reconstruction
from scanner.arrays import Array
from scanner.recording import Recording

SCENES = (*TISSUES, "camera", "coins")
PIXELS = 256
DURATION_S = 0.2
PEAK_TO_PEAK_PX = 10.0
REST_DURATION_S = 0.06
"""Duration of scans at rest: that of the demo."""

REST_PHOTONS = (10.0, 100.0, 1000.0)
"""Photons of scans at rest: by turns for every six scans."""

FRAME_S = 0.01
"""Length of a frame for phase correlation: half of the pixels are visited in it."""

MOTIONS = ("drift", "breathing, 5 Hz", "three jumps", "vibration, 1 kHz, 1 px")


@dataclass(frozen=True)
class Scan:
    """A recording of a moving sample: its displacement (2, n) [px], and the light of the scene on the pixels."""

    recording: Recording
    displacement: Array
    truth: dict[str, Array]
    picture: Array


def displacement(kind: str, time_s: Array, rng: np.random.Generator) -> Array:
    """Displacement of the sample at each time, shape (2, n) [px]; motions that are joined by " + " are added."""
    first, *others = kind.split(" + ")
    if others:
        return sum((displacement(each, time_s, rng) for each in others), displacement(first, time_s, rng))
    angle, phase = rng.uniform(0.0, 2.0 * np.pi, 2)
    direction = np.array([[np.cos(angle)], [np.sin(angle)]])
    fraction = time_s / time_s[-1]
    if kind == "rest":
        return np.zeros((2, time_s.size))
    if kind == "drift":
        return PEAK_TO_PEAK_PX * direction * (fraction - 0.5)
    if kind == "three jumps":
        times, sizes = np.sort(rng.uniform(0.05, 0.95, 3)), np.array([1.0, -0.6, 0.4])
        steps = (fraction > times[:, None]) * sizes[:, None]
        return PEAK_TO_PEAK_PX * direction * steps.sum(axis=0)
    _, frequency, *stated = kind.split(", ")
    number, unit = frequency.split()
    hertz = float(number) * (1e3 if unit == "kHz" else 1.0)
    size = float(stated[0].removesuffix(" px")) if stated else PEAK_TO_PEAK_PX
    return 0.5 * size * direction * np.sin(2.0 * np.pi * hertz * time_s + phase)


def load_light(name: str) -> Array:
    """The light of a scene under the demo's spot."""
    experiment = Experiment()
    if name in TISSUES:
        light = make_target(name)
    else:
        from skimage import data, transform

        image = np.asarray(getattr(data, name)(), float)
        side = min(image.shape)
        light = transform.resize(image[:side, :side] / 255.0, (1600, 1600), order=1)
    return blur_by_spot(light, experiment.spot_um, experiment.field_um, experiment.field_um)


def simulate_scan(kind: str, photons: float, seed: int, duration: float = DURATION_S) -> Scan:
    rng = np.random.default_rng([seed, 2])
    experiment = Experiment(duration=duration)
    recording, truth = simulate_experiment(experiment, seed)
    view = experiment.device.require_scan()
    half = view.mechanical_half_angles
    angles = {axis: np.asarray(truth[f"angle_{axis}"][0], float) for axis in "xy"}  # type: ignore[index]
    moved = displacement(kind, np.arange(angles["x"].size) / experiment.sample_rate, rng)
    light = load_light(SCENES[seed % len(SCENES)])
    places = (angles[axis] - shift * 2.0 * h / PIXELS for axis, shift, h in zip("xy", moved, half, strict=True))
    detector = Detector(gain=1.0 / photons, photons_per_sample=photons)
    intensity = detect(sample_scene(light, *places, *half), experiment.sample_rate, detector, rng)
    side = light.shape[0] // PIXELS
    trimmed = light[: side * PIXELS, : side * PIXELS]
    if light.shape[0] % PIXELS:
        import cv2

        trimmed = cv2.resize(light, (PIXELS, PIXELS), interpolation=cv2.INTER_AREA)
        side = 1
    picture = trimmed.reshape(PIXELS, side, PIXELS, side).mean(axis=(1, 3))
    return Scan(recording.with_channel(replace(recording["intensity"], raw=intensity)), moved, angles, picture)


def register_frames(x: Array, y: Array, result: Reconstruction) -> Array:
    """Displacement of the samples by phase correlation of successive mean pictures, shape (2, n) [px]."""
    from skimage.registration import phase_cross_correlation

    intensity, grid = result.intensity.read(), result.picture.grid
    edges = np.arange(0, intensity.size + 1, round(FRAME_S * result.intensity.sample_rate))
    middles, shifts, reference = 0.5 * (edges[1:] + edges[:-1]), [], np.zeros((PIXELS, PIXELS))
    for k, (first, stop) in enumerate(pairwise(edges)):
        image = map_samples(x[first:stop], y[first:stop], intensity[first:stop], grid).image.astype(float)
        image = np.where(np.isfinite(image), image, np.nanmean(image))
        shift = np.zeros(2)
        if k:
            shift = phase_cross_correlation(reference / k, image, upsample_factor=20)[0]  # moves image onto reference
        shifts.append(-shift[::-1])
        reference += np.roll(image, np.round(shift).astype(int), (0, 1))
    index = np.arange(intensity.size)
    return np.stack([np.interp(index, middles, each) for each in np.array(shifts).T])


def estimated_motion(result: Reconstruction, size: int) -> Array:
    """Displacement of the samples by ``--sample-motion``, shape (2, n) [px]."""
    motion = result.sample_motion
    if motion is None or not motion.moving:
        return np.zeros((2, size))
    return motion.at(np.arange(size))


def centred(values: Array) -> Array:
    return values - values.mean(axis=1, keepdims=True)


def measure_scan(kind: str, photons: float, seed: int, duration: float) -> dict[str, float]:
    """Errors of motion [px] and of pictures by method."""
    scan = simulate_scan(kind, photons, seed, duration)
    start = time.process_time()
    result = reconstruct(scan.recording, Options(pixels=(PIXELS, PIXELS), sample_motion=True), quiet=True)
    seconds = time.process_time() - start
    intensity, grid, truth = result.intensity.read(), result.picture.grid, centred(scan.displacement)
    mirror = [result.motion.axes[axis].angle.read() for axis in "xy"]
    # The sense signal does not determine the signs of the axes.
    signs = [np.sign(angle @ scan.truth[axis]) for axis, angle in zip("xy", mirror, strict=True)]
    mirror = [sign * angle for sign, angle in zip(signs, mirror, strict=True)]
    pixel = np.array(grid.pixel_angle)
    offset = scan.displacement.mean(axis=1)  # no sample determines it; taken out for the comparison with the scene
    own = [sign * result.beam.axes[axis].angle.read() for sign, axis in zip(signs, "xy", strict=True)]

    def picture_error(motion: Array, angles: list[Array]) -> float:
        x, y = (
            angle - (shift + mean) * size
            for angle, shift, mean, size in zip(angles, motion, offset, pixel, strict=True)
        )
        image = map_samples(x, y, intensity, grid).image
        used = np.isfinite(image)
        used[:12] = used[-12:] = used[:, :12] = used[:, -12:] = False  # other parts of the sample move into the edge
        return float(np.sqrt(np.mean((image - scan.picture)[used] ** 2)))

    true_mirror = [scan.truth[axis] for axis in "xy"]
    correlated = centred(register_frames(*mirror, result))
    found = centred(np.array(signs)[:, None] * estimated_motion(result, intensity.size))
    corrected = [angle + shift * size for angle, shift, size in zip(own, found, pixel, strict=True)]
    known = picture_error(truth, true_mirror)
    row = {"moving": float(result.sample_motion is not None and result.sample_motion.moving), "known": known}
    methods = {
        "none": (np.zeros_like(truth), mirror), "correlation": (correlated, mirror), "own": (found, corrected)
    }  # fmt: skip
    for name, (motion, angles) in methods.items():
        row[f"{name} px"] = float(np.sqrt(np.mean(np.sum((motion - truth) ** 2, axis=0))))
        row[f"{name} picture"] = picture_error(motion, angles) / known
    if result.sample_motion is not None and row["moving"]:
        at = np.round(result.sample_motion.sample).astype(int)
        error = found[:, at] - truth[:, at]
        row["within 95 %"] = float(np.mean(np.abs(error.T) < 1.96 * result.sample_motion.sd))
        row["sd px"] = float(np.sqrt(2.0 * np.mean(result.sample_motion.sd**2)))
    row["left px"] = float(np.hypot(*result.sample_motion.left)) if result.sample_motion is not None else 0.0
    row["vibrations"] = float(len(result.sample_motion.vibrations)) if result.sample_motion is not None else 0.0
    row["seconds"] = seconds
    return row


def measure_rest(seed: int) -> tuple[bool, float, float]:
    """Whether a sample at rest is reported as moving, gain of the log likelihood, and motion stated as left [px]."""
    photons = REST_PHOTONS[seed // len(SCENES) % len(REST_PHOTONS)]
    scan = simulate_scan("rest", photons, seed, REST_DURATION_S)
    options = Options(pixels=(PIXELS, PIXELS), sample_motion=True)
    prepared = prepare(scan.recording, None)
    estimated = estimate_motion(
        prepared, replace(options, estimator=default_estimator(prepared.recording, prepared.device))
    )
    motion = correct_sample_motion(estimated, options).sample_motion
    return (motion.moving, motion.gain, float(np.hypot(*motion.left))) if motion is not None else (False, 0.0, 0.0)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("scans", type=int)
    parser.add_argument("--first", type=int, default=0, help="seed of the first scan")
    parser.add_argument("--photons", type=float, default=100.0)
    parser.add_argument("--duration", type=float, default=DURATION_S, help="of scans of moving samples [s]")
    parser.add_argument("--rest", action="store_true", help="samples at rest")
    parser.add_argument("--motions", default=";".join(MOTIONS))
    parser.add_argument("--verbose", action="store_true")
    arguments = parser.parse_args()
    seeds = range(arguments.first, arguments.first + arguments.scans)
    if arguments.rest:
        found = []
        for seed in seeds:
            found.append(measure_rest(seed))
            if arguments.verbose:
                print(seed, found[-1], flush=True)
        gains = np.sort([gain for _, gain, _ in found])
        print(f"at rest: {sum(moving for moving, _, _ in found)} of {len(found)} reported as moving")
        print(f"motion that is left is stated in {sum(left > 0.0 for _, _, left in found)}")
        print(f"gains of the log likelihood: median {np.median(gains):.2g}, largest {gains[-3:].round(2)}")
        return
    for kind in arguments.motions.split(";"):
        rows = []
        for seed in seeds:
            rows.append(measure_scan(kind, arguments.photons, seed, arguments.duration))
            if arguments.verbose:
                print(kind, SCENES[seed % len(SCENES)], {k: round(v, 3) for k, v in rows[-1].items()}, flush=True)
        print(f"{kind}, {arguments.photons:g} photons: {sum(row['moving'] for row in rows):.0f} of {len(rows)} moving")
        for key in dict.fromkeys(name for row in rows for name in row):
            values = np.array([row.get(key, np.nan) for row in rows])
            print(f"  {key:20s} median {np.nanmedian(values):.4g}, largest {np.nanmax(values):.4g}", flush=True)


if __name__ == "__main__":
    main()
