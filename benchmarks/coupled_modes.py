"""Pictures of scans with a coupled mode that the device file does not state.

    python -m benchmarks.coupled_modes SCANS [--first SEED]

Every scan is an imaging scan of the blind benchmark with a coupled mode in x, with one kind of noise after the other.
The mode takes the energy of x and returns it, so that the amplitude vanishes in most scans. Prints for each the
smallest amplitude of x over its root mean square, the phase error, the size of the field over the true one, the error
of the picture over that with the true motion, and the notes on signs.
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path

import numpy as np

from benchmarks.blind.generator import Case, generate_recording, write
from benchmarks.blind.imaging_score import score_motion
from benchmarks.blind.noise import KINDS
from recon.pipeline import reconstruct
from recon.steps.reconstruction import Options
from scanner.recording import Recording


def measure_scan(seed: int, noise: str) -> tuple[float, dict[str, float], list[str]]:
    """Smallest relative amplitude of x, errors as of ``score_motion``, and notes of one scan."""
    blind = generate_recording(Case("scan", "one", "imaging", ("mode-coupling",), noise, seed))
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "scan.h5"
        write(blind, path)
        with Recording.open(path) as recording:
            result = reconstruct(recording, Options(allow_outside=True), quiet=True)
    amplitude = result.motion.axes["x"].amplitude
    angles = {name: axis.angle.read() for name, axis in result.motion.axes.items()}
    scores = score_motion(angles, blind.true_angles(), blind.channels["intensity"], blind.scenario.sample_rate)
    return (
        float(amplitude.min() / np.sqrt(np.mean(amplitude**2))),
        scores,
        [note for note in result.notes if "nearly rests" in note],
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("scans", type=int)
    parser.add_argument("--first", type=int, default=0, help="seed of the first scan")
    arguments = parser.parse_args()
    for i in range(arguments.scans):
        noise = list(KINDS)[i % len(KINDS)]
        smallest, scores, notes = measure_scan(arguments.first + i, noise)
        print(
            f"{arguments.first + i} {noise:12s} smallest amplitude {smallest:.2f}, phase {scores['phase_deg']:.3f}°, "
            f"field {scores['field']:.3f}, picture {scores['picture']:.2f}",
            *notes,
            sep="; ",
            flush=True,
        )


if __name__ == "__main__":
    main()
