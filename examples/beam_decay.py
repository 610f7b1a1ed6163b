"""A measured free decay: how a beam's frequency and damping depend on its amplitude, and which laws say so.

    python examples/beam_decay.py DATA OUT

DATA holds the .lvm file. The linear beam is diagnosed over four seconds of decay. One block of 0.2 s in five is kept
from the fit; there the instantaneous frequency of the model is held against the measured one.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
from effect_contributions import findings_text, nested_fits
from numpy.typing import NDArray

from estimation.diagnosis.diagnose import diagnose
from estimation.diagnosis.fit import TIME_BLOCKS, VALIDATION_BLOCK_INTERVAL, Fit
from recon.io.convert import convert_file
from scanner.arrays import Array
from scanner.recording import Recording

MAPPING = Path(__file__).with_suffix(".toml")
FROM, TO = 12.4, 16.4
"""The shaker is off and its last push has passed; at the end the beam still moves ten times the noise [s]."""

CENTRE = 37.5
CYCLES = 4
"""Cycles seen at once by the demodulation, under a Hann window."""


def slow_motion(signal: Array, rate: float) -> tuple[Array, Array, Array]:
    """Amplitude, frequency [Hz] and decay rate [1/s] of a slowly changing oscillation (n,), each of its shape."""
    time = np.arange(signal.size) / rate
    window = np.hanning(int(CYCLES * rate / CENTRE))
    turning = signal * np.exp(-2j * np.pi * CENTRE * time)
    phasor = 2 * np.convolve(turning, window / window.sum(), "same")
    logarithm = np.log(np.abs(phasor)) + 1j * np.unwrap(np.angle(phasor))
    slope = np.gradient(logarithm, 1 / rate)
    return np.abs(phasor), CENTRE + slope.imag / (2 * np.pi), -slope.real


def held_out(size: int, rate: float) -> NDArray[np.bool_]:
    """Samples of the blocks that no fit saw, without those whose window reaches into the neighbours, shape (n,)."""
    block = np.floor(np.arange(size) / size * TIME_BLOCKS).astype(int)
    inside = (block % VALIDATION_BLOCK_INTERVAL) == VALIDATION_BLOCK_INTERVAL // 2
    reach = int(CYCLES * rate / CENTRE / 2)
    return np.asarray(np.convolve(inside, np.ones(2 * reach + 1), "same") > 2 * reach)


def simulated(fit: Fit) -> Array:
    """What a fit shows in the channel, shape (n,) [V]."""
    return fit.model.outputs(fit.x)[0][0]


def draw(measured: Array, steps: dict[str, Fit], rate: float, output: Path) -> None:
    """Frequency and decay rate against amplitude, measured and by each device."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, panels = plt.subplots(1, 2, figsize=(13, 4.8), layout="constrained")
    ends = slice(int(2 * CYCLES * rate / CENTRE), -int(2 * CYCLES * rate / CENTRE))
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
    with Recording.open(output / "beam_decay.h5") as whole:
        found = diagnose([whole.slice(FROM, TO)], progress=lambda text: print(f"  ... {text}", flush=True))
    (output / "device.toml").write_text(found.device.to_toml(), encoding="utf-8")
    print(f"Found in the decay from {FROM} s to {TO} s")
    print(findings_text(found))
    assert found.search is not None
    channel = found.search.likelihood.runs[0].outputs[0]
    rate = 1 / channel.step
    unseen = held_out(channel.data.size, rate)
    _, frequency, decay = slow_motion(channel.data - channel.data.mean(), rate)
    print(f"Not used in the fit: {unseen.sum()} samples. Frequency off, rms (Hz); decay rate off, rms (1/s)")
    print(f"  {'constant':22} {frequency[unseen].std():7.3f} {decay[unseen].std():7.3f}")
    steps = nested_fits(found)
    for name, fit in steps.items():
        signal = simulated(fit)
        _, told_frequency, told_decay = slow_motion(signal - signal.mean(), rate)
        off = [np.sqrt(np.mean((a - b)[unseen] ** 2)) for a, b in ((frequency, told_frequency), (decay, told_decay))]
        print(f"  {name if name == 'linear' else '+ ' + name:22} {off[0]:7.3f} {off[1]:7.3f}")
    draw(channel.data, steps, rate, output / "beam_decay.png")
    print(f"Picture: {output / 'beam_decay.png'}")


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
