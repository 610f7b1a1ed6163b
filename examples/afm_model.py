"""A measured piezo stage: what lies between the spiral that it was told to follow and the one that its sensors saw.

    python examples/afm_model.py DATA OUT

DATA holds spiral_20hz.mat. The nominal stage is linear, with a resonance far above the scan's 20 Hz; each axis is
diagnosed by itself, and the two laws of the catalogue that a piezo stage is known for are fitted beside that. As
everywhere, one block of time in five is kept from the fit.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from afm_spiral import TURNS_PER_SECOND, fit_spiral
from effect_contributions import findings_text, nested_fits
from numpy.typing import NDArray

from estimation.diagnosis.data import prepare_run
from estimation.diagnosis.diagnose import diagnose
from estimation.diagnosis.fit import TIME_BLOCKS, VALIDATION_BLOCK_INTERVAL, Fit, Likelihood, fit_model
from estimation.diagnosis.initial import flat_whiteners
from estimation.diagnosis.model import Candidate, Model
from recon.io.readers import read
from scanner.arrays import Array
from scanner.device import Axis, Device, Drive, Mechanics, Position
from scanner.recording import Recording
from scanner.terms import catalogue

RATE = 20e3
THIN = 10
LAWS = ("hysteresis", "offset-drift")
LEAD = 1e-3
"""The file does not say when the stage was told. The spiral that fits the sensors best is led by about what such a
stage and its electronics lag [s]; damping and stiffness carry the rest, within wide tolerances."""

RESONANCE, QUALITY = 2 * np.pi * 300.0, 1.0
STAGE = Axis(
    Mechanics(1.0 / RESONANCE**2, 1.0 / (RESONANCE * QUALITY), 1.0),
    drive=Drive("linear", 1.0),
    readout=Position(1.0, 0.07e-3 / np.sqrt(THIN)),
    tolerance={"J": 1e-9, "b": 0.5, "k": 0.2, "torque_per_volt": 1e-9, "gain": 1e-9},
    name="x",
)
"""1 "rad" stands for 1 V of the sensor; the scan moves far below any resonance, so that J stands for nothing."""


def recordings(file: Path) -> dict[str, Recording]:
    """Commanded and sensed position about the centre at 2 kHz; either axis stands as ``x`` of a device of its own."""
    from scipy.signal import decimate

    variables = read(file).variables
    path = np.array([variables[name].raw[:] for name in ("x", "y")])
    time = np.arange(path.shape[1]) / RATE
    spiral = fit_spiral(time, path, TURNS_PER_SECOND)
    told_path = spiral.at(time + LEAD) - spiral.centre[:, None]
    sensed = path - spiral.centre[:, None]
    made = {}
    for i, name in enumerate("xy"):
        channels = {
            "drive_x": (told_path[i, ::THIN], "V", RATE / THIN, 0.0),
            "sense_x": (decimate(sensed[i], THIN, ftype="fir"), "V", RATE / THIN, 0.0),
        }
        made[name] = Recording.from_arrays(channels, Device(f"stage-{name}", {"x": STAGE}), f"afm-{name}")
    return made


def left(fit: Fit) -> Array:
    """Sensed minus simulated position, shape (n,) [V]."""
    return fit.model.runs[0].outputs[0].data - fit.model.outputs(fit.x)[0][0]


def by_laws(recording: Recording, laws: Sequence[str]) -> Fit:
    """The linear stage with ``laws`` of its sensed position, all fitted together."""
    device = recording.device
    assert device is not None
    run = prepare_run(recording, device)
    model = Model([run], device, [Candidate(catalogue()[effect], "x", "sense") for effect in laws], ())
    return fit_model(Likelihood([run], flat_whiteners(model)), model, np.zeros(len(model.parameters)), max_iterations=8)


def held_out(size: int) -> NDArray[np.bool_]:
    """Samples that no fit saw, shape (n,)."""
    block = np.floor(np.arange(size) / size * TIME_BLOCKS).astype(int)
    return np.asarray(block % VALIDATION_BLOCK_INTERVAL == VALIDATION_BLOCK_INTERVAL // 2)


def missed(fit: Fit) -> float:
    """Sensed minus simulated position, rms of samples that no fit saw [mV]."""
    rest = left(fit)
    return 1e3 * float(np.sqrt(np.mean(rest[held_out(rest.size)] ** 2)))


def draw(steps: dict[str, dict[str, Fit]], output: Path) -> None:
    """What each device leaves over time, axis by axis."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, panels = plt.subplots(2, 1, figsize=(12, 8), layout="constrained", sharex=True)
    for panel, (name, fits) in zip(panels, steps.items(), strict=True):
        for label, fit in fits.items():
            rest = left(fit)
            panel.plot(np.arange(rest.size) * THIN / RATE, 1e3 * rest, lw=0.7, label=label)
        panel.set(ylabel=f"sensed − simulated {name} (mV)")
        panel.legend(loc="upper left")
    panels[1].set(xlabel="time (s)")
    figure.savefig(output, dpi=100)
    plt.close(figure)


def main(data: Path, output: Path) -> None:
    """Diagnose both axes, say what each term is worth, draw."""
    output.mkdir(parents=True, exist_ok=True)
    steps = {}
    for name, recording in recordings(data / "spiral_20hz.mat").items():
        found = diagnose([recording], progress=lambda text: print(f"  ... {text}", flush=True))
        (output / f"device_{name}.toml").write_text(found.device.to_toml(), encoding="utf-8")
        print(f"Axis {name}")
        print(findings_text(found))
        steps[name] = {f"diagnosed: {effect}": fit for effect, fit in nested_fits(found).items()}
        steps[name] |= {" and ".join(laws): by_laws(recording, laws) for laws in (LAWS[:1], LAWS[1:], LAWS)}
        print("  Commanded through the stage against sensed position, rms on samples not used in the fit")
        for label, fit in steps[name].items():
            print(f"    {label:36} {missed(fit):7.3f} mV")
    draw(steps, output / "afm_model.png")
    print(f"Picture: {output / 'afm_model.png'}")


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
