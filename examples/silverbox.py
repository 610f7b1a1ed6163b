"""A measured oscillator with a cubic spring: what the linear model leaves out, found from one multisine, tried on nine.

    python examples/silverbox.py DATA OUT

DATA holds multisine.npz. One of its ten multisines is diagnosed; the device found is played the drive of the other
nine, open loop, as are the devices with fewer of its terms. The benchmark's test record, the arrowhead, is not in the
file.
"""

from __future__ import annotations

import sys
from itertools import pairwise
from pathlib import Path

import numpy as np
from effect_contributions import findings_text, nested_fits

from estimation.diagnosis.diagnose import diagnose
from estimation.diagnosis.improvement import improved_device
from estimation.diagnosis.predict import Predicted, predict
from recon.io.convert import convert_file
from scanner.arrays import Array
from scanner.recording import Recording

MAPPING = Path(__file__).with_suffix(".toml")
FITTED = 2
QUIET = 0.015
"""Between two multisines the drive stays below this [V]."""


def multisines(recording: Recording) -> list[Recording]:
    """The multisines, each from the middle of the rest before it to the middle of the rest behind."""
    drive = recording["drive_x"]
    loud = np.flatnonzero(np.abs(drive.read()) > QUIET)
    gaps = np.flatnonzero(np.diff(loud) > 60)
    middles = [loud[0] - 40, *((loud[gaps] + loud[gaps + 1]) // 2), loud[-1] + 50]
    times = drive.start + np.array(middles) / drive.sample_rate
    return [recording.slice(low, high) for low, high in pairwise(times)]


def off(each: Predicted) -> Array:
    """Simulated minus measured, their means taken off [V]."""
    return (each.values - each.measured) - np.nanmean(each.values - each.measured)


def draw(steps: dict[str, list[Predicted]], rate: float, output: Path) -> None:
    """Spectra of what each device leaves of the first multisine, and the errors of all nine."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, (left, right) = plt.subplots(1, 2, figsize=(13, 4.8), layout="constrained")
    for name, held in steps.items():
        rest = np.nan_to_num(off(held[0]))
        level = np.abs(np.fft.rfft(rest * np.hanning(rest.size))) / np.sqrt(rest.size)
        smooth = np.sqrt(np.convolve(level**2, np.ones(40) / 40, "same"))
        left.semilogy(np.fft.rfftfreq(rest.size, 1 / rate), smooth, label=name)
        right.semilogy([1e3 * np.nanstd(off(each)) for each in held], "o-", label=name)
    left.set(title="What is left of a multisine not used", xlabel="frequency (Hz)", ylabel="V")
    right.set(title="Simulation error", xlabel="multisine not used in the fit", ylabel="rms (mV)")
    right.legend()
    figure.savefig(output, dpi=100)
    plt.close(figure)


def main(data: Path, output: Path) -> None:
    """Convert, diagnose one multisine, predict the others, draw."""
    output.mkdir(parents=True, exist_ok=True)
    convert_file(data / "multisine.npz", MAPPING, output / "silverbox.h5")
    with Recording.open(output / "silverbox.h5") as whole:
        parts = multisines(whole)
        found = diagnose([parts[FITTED]], progress=lambda text: print(f"  ... {text}", flush=True))
        (output / "device.toml").write_text(found.device.to_toml(), encoding="utf-8")
        print(f"Found in multisine {FITTED + 1} of {len(parts)}")
        print(findings_text(found))
        unseen = [part for i, part in enumerate(parts) if i != FITTED]
        steps = {
            name: [predict(part, improved_device(fit))["sense_x"] for part in unseen]
            for name, fit in nested_fits(found).items()
        }
        print(f"Simulation error on the other {len(unseen)}, rms over all, and the worst one")
        for name, held in steps.items():
            errors = [1e3 * float(np.nanstd(off(each))) for each in held]
            added = name if name == "linear" else f"+ {name}"
            print(f"  {added:22} {np.sqrt(np.mean(np.square(errors))):7.3f} mV {max(errors):7.3f} mV")
        draw(steps, whole["sense_x"].sample_rate, output / "silverbox.png")
    print(f"Picture: {output / 'silverbox.png'}")


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
