"""A measured piezo stage: the effects that make its sensed position differ from the commanded spiral.

    python examples/afm_model.py DATA OUT

DATA contains spiral_20hz.mat. The nominal stage is linear, with a resonance far above the 20 Hz of the scan. Each axis
is diagnosed separately. For comparison, the two laws of the catalogue that are typical of piezo stages, hysteresis and
drift, are fitted. One block of time in five is held out of every fit.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from afm_spiral import TURNS_PER_SECOND, fit_spiral
from effect_contributions import findings_text, nested_fits
from numpy.typing import NDArray

from estimation.device_fit.data import prepare_run
from estimation.device_fit.fit import TIME_BLOCKS, VALIDATION_BLOCK_INTERVAL, Fit, Likelihood, fit_model
from estimation.device_fit.initial import flat_whiteners
from estimation.device_fit.model import Model
from estimation.device_fit.parameters import Candidate
from estimation.diagnosis.diagnose import diagnose
from recon.io.readers import read
from scanner.arrays import Array
from scanner.device import Axis, Device
from scanner.recording import Recording
from scanner.stages import Drive, Mechanics, Position
from scanner.terms import catalogue

SAMPLE_RATE_HZ = 20e3
DECIMATION = 10
LAWS = ("hysteresis", "offset-drift")
COMMAND_LEAD_S = 1e-3
"""Time by which the command precedes the spiral that fits the sensed position best [s]: about the lag of such a stage
and its electronics. The file does not contain the command. The remaining lag is fitted by damping and stiffness, within
wide tolerances."""

RESONANCE, QUALITY = 2 * np.pi * 300.0, 1.0
STAGE = Axis(
    Mechanics(1.0 / RESONANCE**2, 1.0 / (RESONANCE * QUALITY), 1.0),
    drive=Drive("linear", 1.0),
    readout=Position(1.0, 0.07e-3 / np.sqrt(DECIMATION)),
    tolerance={"J": 1e-9, "b": 0.5, "k": 0.2, "torque_per_volt": 1e-9, "gain": 1e-9},
    name="x",
)
"""1 "rad" of the device is 1 V of the sensor. The scan is far below any resonance, so that J has no effect."""


def recordings(file: Path) -> dict[str, Recording]:
    """Commanded and sensed position relative to the centre at 2 kHz, by axis; each axis is ``x`` of a separate
    device."""
    from scipy.signal import decimate

    variables = read(file).variables
    path = np.array([variables[name].raw[:] for name in ("x", "y")])
    time = np.arange(path.shape[1]) / SAMPLE_RATE_HZ
    fitted_spiral = fit_spiral(time, path, TURNS_PER_SECOND)
    commanded = fitted_spiral.at(time + COMMAND_LEAD_S) - fitted_spiral.centre[:, None]
    sensed = path - fitted_spiral.centre[:, None]
    by_axis = {}
    for i, name in enumerate("xy"):
        channels = {
            "drive_x": (commanded[i, ::DECIMATION], "V", SAMPLE_RATE_HZ / DECIMATION, 0.0),
            "sense_x": (decimate(sensed[i], DECIMATION, ftype="fir"), "V", SAMPLE_RATE_HZ / DECIMATION, 0.0),
        }
        by_axis[name] = Recording.from_arrays(channels, Device(f"stage-{name}", {"x": STAGE}), f"afm-{name}")
    return by_axis


def residual(fit: Fit) -> Array:
    """Sensed minus simulated position, shape (n,) [V]."""
    return fit.model.runs[0].outputs[0].data - fit.model.outputs(fit.x)[0][0]


def fit_laws(recording: Recording, laws: Sequence[str]) -> Fit:
    """The linear stage with ``laws`` of its sensed position, all fitted together."""
    device = recording.device
    assert device is not None
    run = prepare_run(recording, device)
    model = Model([run], device, [Candidate(catalogue()[effect], "x", "sense") for effect in laws], ())
    return fit_model(Likelihood([run], flat_whiteners(model)), model, np.zeros(len(model.parameters)), max_iterations=8)


def held_out_samples(size: int) -> NDArray[np.bool_]:
    """Mask of the samples that no fit uses, shape (n,)."""
    block = np.floor(np.arange(size) / size * TIME_BLOCKS).astype(int)
    return np.asarray(block % VALIDATION_BLOCK_INTERVAL == VALIDATION_BLOCK_INTERVAL // 2)


def held_out_rms_mv(fit: Fit) -> float:
    """Root mean square of sensed minus simulated position over the held-out samples [mV]."""
    error = residual(fit)
    return 1e3 * float(np.sqrt(np.mean(error[held_out_samples(error.size)] ** 2)))


def draw(steps: dict[str, dict[str, Fit]], output: Path) -> None:
    """Draw the residual of each model over time, one panel per axis."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, panels = plt.subplots(2, 1, figsize=(12, 8), layout="constrained", sharex=True)
    for panel, (name, fits) in zip(panels, steps.items(), strict=True):
        for label, fit in fits.items():
            error = residual(fit)
            panel.plot(np.arange(error.size) * DECIMATION / SAMPLE_RATE_HZ, 1e3 * error, lw=0.7, label=label)
        panel.set(ylabel=f"sensed − simulated {name} (mV)")
        panel.legend(loc="upper left")
    panels[1].set(xlabel="time (s)")
    figure.savefig(output, dpi=100)
    plt.close(figure)


def main(data: Path, output: Path) -> None:
    """Diagnose both axes, print the residual of each model, draw."""
    output.mkdir(parents=True, exist_ok=True)
    steps = {}
    for name, recording in recordings(data / "spiral_20hz.mat").items():
        diagnosis = diagnose([recording], progress=lambda text: print(f"  ... {text}", flush=True))
        (output / f"device_{name}.toml").write_text(diagnosis.device.to_toml(), encoding="utf-8")
        print(f"Axis {name}")
        print(findings_text(diagnosis))
        steps[name] = {f"diagnosed: {effect}": fit for effect, fit in nested_fits(diagnosis).items()}
        steps[name] |= {" and ".join(laws): fit_laws(recording, laws) for laws in (LAWS[:1], LAWS[1:], LAWS)}
        print("  Simulated against sensed position, rms on samples not used in the fit")
        for label, fit in steps[name].items():
            print(f"    {label:36} {held_out_rms_mv(fit):7.3f} mV")
    draw(steps, output / "afm_model.png")
    print(f"Picture: {output / 'afm_model.png'}")


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
