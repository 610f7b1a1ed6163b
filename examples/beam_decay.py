"""A measured free decay of a beam: dependence of frequency and damping on the amplitude, and the laws that explain it.

    python examples/beam_decay.py DATA OUT

DATA contains the .lvm file. Four seconds of the decay are diagnosed against a linear beam. One block of 0.2 s in five
is held out of the fit; there the instantaneous frequency of the model is compared with the measured one.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
from effect_contributions import findings_text, nested_fits
from numpy.typing import NDArray

from estimation.device_fit.fit import TIME_BLOCKS, VALIDATION_BLOCK_INTERVAL, Fit
from estimation.diagnosis.diagnose import diagnose
from recon.io.convert import convert_file
from scanner.arrays import Array
from scanner.recording import Recording

MAPPING = Path(__file__).with_suffix(".toml")
START_S, STOP_S = 12.4, 16.4
"""Part of the recording that is diagnosed [s]: after the shaker's last transient, and until the amplitude is ten times
the noise."""

CENTRE_HZ = 37.5
WINDOW_CYCLES = 4
"""Length of the Hann window of the demodulation, in cycles of ``CENTRE_HZ``."""


def slow_motion(signal: Array, rate: float) -> tuple[Array, Array, Array]:
    """Amplitude, frequency [Hz] and decay rate [1/s] of a slowly changing oscillation (n,), each of its shape."""
    time = np.arange(signal.size) / rate
    window = np.hanning(int(WINDOW_CYCLES * rate / CENTRE_HZ))
    demodulated = signal * np.exp(-2j * np.pi * CENTRE_HZ * time)
    phasor = 2 * np.convolve(demodulated, window / window.sum(), "same")
    logarithm = np.log(np.abs(phasor)) + 1j * np.unwrap(np.angle(phasor))
    slope = np.gradient(logarithm, 1 / rate)
    return np.abs(phasor), CENTRE_HZ + slope.imag / (2 * np.pi), -slope.real


def held_out_samples(size: int, rate: float) -> NDArray[np.bool_]:
    """Samples of the held-out blocks whose demodulation window lies within the block, shape (n,)."""
    block = np.floor(np.arange(size) / size * TIME_BLOCKS).astype(int)
    held_out = (block % VALIDATION_BLOCK_INTERVAL) == VALIDATION_BLOCK_INTERVAL // 2
    half_window = int(WINDOW_CYCLES * rate / CENTRE_HZ / 2)
    return np.asarray(np.convolve(held_out, np.ones(2 * half_window + 1), "same") > 2 * half_window)


def simulated(fit: Fit) -> Array:
    """The simulated channel of a fit, shape (n,) [V]."""
    return fit.model.outputs(fit.x)[0][0]


def draw(measured: Array, steps: dict[str, Fit], rate: float, output: Path) -> None:
    """Draw frequency and decay rate over amplitude, measured and of each model."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, panels = plt.subplots(1, 2, figsize=(13, 4.8), layout="constrained")
    ends = slice(int(2 * WINDOW_CYCLES * rate / CENTRE_HZ), -int(2 * WINDOW_CYCLES * rate / CENTRE_HZ))
    for name, signal in {"measured": measured, **{name: simulated(fit) for name, fit in steps.items()}}.items():
        amplitude, frequency, decay = slow_motion(signal - signal.mean(), rate)
        style = "k." if name == "measured" else "-"
        label = name if name in ("measured", "linear") else f"+ {name}"
        panels[0].semilogx(amplitude[ends], frequency[ends], style, ms=2, label=label)
        panels[1].semilogx(amplitude[ends], decay[ends], style, ms=2, label=label)
    panels[0].set(title="Frequency", xlabel="amplitude (strain / 1e-4)", ylabel="Hz", ylim=(36.5, 40))
    panels[1].set(title="Decay rate", xlabel="amplitude (strain / 1e-4)", ylabel="1/s", ylim=(0, 2.5))
    for panel in panels:
        panel.set_xlim(0.04, 1.2)
    panels[1].legend()
    figure.savefig(output, dpi=100)
    plt.close(figure)


def main(data: Path, output: Path) -> None:
    """Convert, diagnose, compare the slow motion, draw."""
    output.mkdir(parents=True, exist_ok=True)
    convert_file(next(data.glob("*.lvm")), MAPPING, output / "beam_decay.h5")
    with Recording.open(output / "beam_decay.h5") as recording:
        diagnosis = diagnose(
            [recording.slice(START_S, STOP_S)], progress=lambda text: print(f"  ... {text}", flush=True)
        )
    (output / "device.toml").write_text(diagnosis.device.to_toml(), encoding="utf-8")
    print(f"Found in the decay from {START_S} s to {STOP_S} s")
    print(findings_text(diagnosis))
    assert diagnosis.search is not None
    channel = diagnosis.search.likelihood.runs[0].outputs[0]
    rate = 1 / channel.step
    held_out = held_out_samples(channel.data.size, rate)
    _, frequency, decay = slow_motion(channel.data - channel.data.mean(), rate)
    print(f"Not used in the fit: {held_out.sum()} samples. Rms error of the frequency (Hz) and of the decay rate (1/s)")
    print(f"  {'constant':22} {frequency[held_out].std():7.3f} {decay[held_out].std():7.3f}")
    steps = nested_fits(diagnosis)
    for name, fit in steps.items():
        signal = simulated(fit)
        _, model_frequency, model_decay = slow_motion(signal - signal.mean(), rate)
        errors = [
            np.sqrt(np.mean((a - b)[held_out] ** 2)) for a, b in ((frequency, model_frequency), (decay, model_decay))
        ]
        print(f"  {name if name == 'linear' else '+ ' + name:22} {errors[0]:7.3f} {errors[1]:7.3f}")
    draw(channel.data, steps, rate, output / "beam_decay.png")
    print(f"Picture: {output / 'beam_decay.png'}")


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
