"""Errors of a reconstructed imaging scan against the true motion: phase, size of the field, and the picture."""

from __future__ import annotations

import json
import subprocess
from collections.abc import Mapping
from math import pi
from pathlib import Path

import h5py
import numpy as np
from numpy.typing import NDArray

from benchmarks.blind.imaging import HALF_ANGLE, picture

Array = NDArray[np.float64]

BLOCK_S = 1e-3
"""Length of a block in which phase and amplitude are compared: several cycles, and short against every drift [s]."""
PIXELS = 400
EDGE_BLOCKS = 1
"""Blocks at both ends that do not count: a smoother is least certain there."""


def block_phasors(angle: Array, sample_rate: float, frequency: float) -> Array:
    """Complex amplitudes in blocks of :data:`BLOCK_S`, (blocks,)."""
    size = round(BLOCK_S * sample_rate)
    count = len(angle) // size
    turn = np.exp(-2j * pi * frequency * np.arange(count * size) / sample_rate)
    blocks = (angle[: count * size] * turn).reshape(count, size)
    return 2 * (blocks * np.hanning(size)).mean(axis=1) / np.hanning(size).mean()


def main_frequency(angle: Array, sample_rate: float) -> float:
    """Frequency of the strongest line [Hz]."""
    spectrum = np.abs(np.fft.rfft(angle * np.hanning(len(angle))))
    return float(np.argmax(spectrum) * sample_rate / len(angle))


def motion_errors(estimate: Array, truth: Array, sample_rate: float) -> dict[str, float]:
    """Root-mean-square phase error [deg], ratio of amplitudes, and the sign of the estimate.

    The sign, which a symmetric capacitance cannot determine, is taken from the truth.
    """
    frequency = main_frequency(truth, sample_rate)
    inner = slice(EDGE_BLOCKS, -EDGE_BLOCKS)
    z, true = (block_phasors(values, sample_rate, frequency)[inner] for values in (estimate, truth))
    sign = 1.0 if np.real(np.vdot(true, z)) > 0 else -1.0
    phase = np.angle(sign * z * np.conj(true))
    return {
        "phase_deg": float(np.degrees(np.sqrt(np.mean(phase**2)))),
        "field": float(np.median(np.abs(z) / np.abs(true))),
        "sign": sign,
    }


def mean_picture(x: Array, y: Array, light: Array) -> Array:
    """Mean light of every pixel of the field, (PIXELS, PIXELS), NaN where the beam never was."""
    columns, rows = (np.floor((v / HALF_ANGLE + 1) / 2 * PIXELS).astype(int) for v in (x, y))
    inside = (columns >= 0) & (columns < PIXELS) & (rows >= 0) & (rows < PIXELS)
    pixel = rows[inside] * PIXELS + columns[inside]
    count = np.bincount(pixel, minlength=PIXELS**2)
    total = np.bincount(pixel, light[inside], minlength=PIXELS**2)
    with np.errstate(invalid="ignore"):
        return (total / count).reshape(PIXELS, PIXELS)


def picture_error(made: Array) -> float:
    """Root-mean-square difference of a picture from the target, over the visited pixels."""
    centres = ((np.arange(PIXELS) + 0.5) / PIXELS * 2 - 1) * HALF_ANGLE
    x, y = np.meshgrid(centres, centres)
    return float(np.sqrt(np.nanmean((made - picture(x, y)) ** 2)))


def score_motion(
    estimates: Mapping[str, Array], truths: Mapping[str, Array], light: Array, sample_rate: float
) -> dict[str, float]:
    """Larger phase error [deg] and worse field of both axes, and the picture's error over that of the true motion."""
    errors = {axis: motion_errors(estimates[axis], truths[axis], sample_rate) for axis in "xy"}
    x, y = (errors[axis]["sign"] * estimates[axis] for axis in "xy")
    best = picture_error(mean_picture(truths["x"], truths["y"], light))
    return {
        "phase_deg": max(e["phase_deg"] for e in errors.values()),
        "field": max((e["field"] for e in errors.values()), key=lambda ratio: abs(ratio - 1)),
        "picture": picture_error(mean_picture(x, y, light)) / best,
    }


def reconstruct_with_both(
    recording: Path, angles: Path, out: Path, command: list[str], timeout: float
) -> dict[str, dict[str, float]]:
    """Reconstruct a scan with the nominal and the improved device; the errors also go to ``out/imaging.json``."""
    with np.load(angles) as file:
        truths = {axis: file[axis].astype(float) for axis in "xy"}
    with h5py.File(recording) as file:
        intensity = file["channels/intensity"]
        light, light_start = intensity[:].astype(float), float(intensity.attrs.get("start", 0.0))
    results: dict[str, dict[str, float]] = {}
    for name, device in (("nominal", []), ("improved", ["--device", str(out / "device.toml")])):
        folder = out / f"reconstructed-{name}"
        options = ["--json", "--allow-outside"]  # with the true motion, too, about half of the samples lie outside
        arguments = [*command, "reconstruct", str(recording), "-o", str(folder), *device, *options]
        try:
            process = subprocess.run(arguments, capture_output=True, text=True, timeout=timeout, check=False)
        except subprocess.TimeoutExpired:
            continue
        if process.returncode == 0:
            with h5py.File(folder / "motion.h5") as file:
                rate, start = (float(file["x/angle"].attrs[key]) for key in ("sample_rate", "start"))
                estimates = {axis: file[f"{axis}/angle"][:].astype(float) for axis in "xy"}
            first = round((start - light_start) * rate)  # the motion may be known for a part of the scan alone
            part = slice(first, first + estimates["x"].size)
            of_part = {axis: angle[part] for axis, angle in truths.items()}
            results[name] = score_motion(estimates, of_part, light[part], rate)
    (out / "imaging.json").write_text(json.dumps(results))
    return results
