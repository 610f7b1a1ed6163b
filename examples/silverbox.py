"""A measured oscillator with a cubic spring: a diagnosis of one multisine, tested on nine others.

    python examples/silverbox.py DATA OUT

DATA contains multisine.npz, part of the Silverbox benchmark. One of its ten multisines is diagnosed against a linear
device. The improved device, and devices with only some of its terms, then predict the other nine open loop. The test
record of the benchmark, the arrowhead, is not in the file.
"""

from __future__ import annotations

import sys
from itertools import pairwise
from pathlib import Path

import numpy as np
from effect_contributions import findings_text, nested_fits

from estimation.device_fit.predict import Predicted, predict
from estimation.diagnosis.diagnose import diagnose
from estimation.diagnosis.improvement import improved_device
from recon.io.convert import convert_file
from scanner.arrays import Array
from scanner.recording import Recording

MAPPING = Path(__file__).with_suffix(".toml")
FITTED_MULTISINE = 2
MAX_PAUSE_VOLTAGE = 0.015
"""Largest drive voltage in the pause between two multisines [V]."""


def multisines(recording: Recording) -> list[Recording]:
    """The multisines, each from the middle of the pause before it to the middle of the pause after it."""
    drive = recording["drive_x"]
    driven = np.flatnonzero(np.abs(drive.read()) > MAX_PAUSE_VOLTAGE)
    gaps = np.flatnonzero(np.diff(driven) > 60)
    boundaries = [driven[0] - 40, *((driven[gaps] + driven[gaps + 1]) // 2), driven[-1] + 50]
    times = drive.start + np.array(boundaries) / drive.sample_rate
    return [recording.slice(start, stop) for start, stop in pairwise(times)]


def simulation_error(prediction: Predicted) -> Array:
    """Simulated minus measured signal, without its mean [V]."""
    return (prediction.values - prediction.measured) - np.nanmean(prediction.values - prediction.measured)


def draw(steps: dict[str, list[Predicted]], rate: float, output: Path) -> None:
    """Draw spectra of the simulation error of each device for one held-out multisine, and the errors of all nine."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, (left, right) = plt.subplots(1, 2, figsize=(13, 4.8), layout="constrained")
    for name, predictions in steps.items():
        error = np.nan_to_num(simulation_error(predictions[0]))
        level = np.abs(np.fft.rfft(error * np.hanning(error.size))) / np.sqrt(error.size)
        smooth = np.sqrt(np.convolve(level**2, np.ones(40) / 40, "same"))
        left.semilogy(np.fft.rfftfreq(error.size, 1 / rate), smooth, label=name)
        right.semilogy([1e3 * np.nanstd(simulation_error(prediction)) for prediction in predictions], "o-", label=name)
    left.set(title="Spectrum of the simulation error", xlabel="frequency (Hz)", ylabel="V")
    right.set(title="Simulation error", xlabel="multisine not used in the fit", ylabel="rms (mV)")
    right.legend()
    figure.savefig(output, dpi=100)
    plt.close(figure)


def main(data: Path, output: Path) -> None:
    """Convert, diagnose one multisine, predict the others, draw."""
    output.mkdir(parents=True, exist_ok=True)
    convert_file(data / "multisine.npz", MAPPING, output / "silverbox.h5")
    with Recording.open(output / "silverbox.h5") as recording:
        parts = multisines(recording)
        diagnosis = diagnose([parts[FITTED_MULTISINE]], progress=lambda text: print(f"  ... {text}", flush=True))
        (output / "device.toml").write_text(diagnosis.device.to_toml(), encoding="utf-8")
        print(f"Found in multisine {FITTED_MULTISINE + 1} of {len(parts)}")
        print(findings_text(diagnosis))
        others = [part for i, part in enumerate(parts) if i != FITTED_MULTISINE]
        steps = {
            name: [predict(part, improved_device(fit))["sense_x"] for part in others]
            for name, fit in nested_fits(diagnosis).items()
        }
        print(f"Simulation error on the other {len(others)} multisines: rms over all, and largest")
        for name, predictions in steps.items():
            errors = [1e3 * float(np.nanstd(simulation_error(prediction))) for prediction in predictions]
            added = name if name == "linear" else f"+ {name}"
            print(f"  {added:22} {np.sqrt(np.mean(np.square(errors))):7.3f} mV {max(errors):7.3f} mV")
        draw(steps, recording["sense_x"].sample_rate, output / "silverbox.png")
    print(f"Picture: {output / 'silverbox.png'}")


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
