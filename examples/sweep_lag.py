"""The demodulator's lag is no constant over a sweep: hidden in chen2020's own model, found, and taken into account.

    python examples/sweep_lag.py [FOLDER]

The paper models its readout as y = a_cir C + b_cir with filters whose phase shifts "are constant" (section II-C). Two
sections near 41 kHz are not: from 31.11 to 31.50 kHz they move the motion's phase by 0.35 degrees. Three short
recordings at different drive frequencies, with the position detector that the paper had on its bench, are held against
the paper's device; what is found goes into the device, and recordings at other frequencies, of the sense signal alone,
are estimated with the paper's constant phase and with the improved device.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from estimation.diagnosis.diagnose import Diagnosis, diagnose
from estimation.estimate import estimate
from phantoms.forward import Plan, simulate
from phantoms.waveforms import Sine
from recon.evaluation import evaluate_axis, truth_from_simulation
from recon.report.figures import new_figure
from scanner import devices
from scanner.device import Amdm, Device
from scanner.recording import Recording

CALIBRATION = 31420.0, 31470.0, 31520.0  # Hz, of the recordings that the diagnosis sees
SWEEP = 31400.0, 31440.0, 31500.0, 31540.0  # Hz, of those it does not
LENGTH, TEST = 0.003, 0.006  # seconds
DETECTOR_NOISE = 1e-4  # rad, of the bench's position detector


def papers_own(true: Device) -> Device:
    """The device as the paper models it: no filter behind its demodulator."""
    axis = true.axis("x")
    readout = axis.require_readout()
    assert isinstance(readout, Amdm)
    return replace(true, axes={"x": replace(axis, readout=replace(readout, lpf_hz=()))})


def driven(frequency: float, duration: float, references: tuple[str, ...] = ()) -> Plan:
    """30 V + 30 V sin at ``frequency`` [Hz], for ``duration`` [s]."""
    return Plan({"x": Sine(frequency, 30.0, 30.0)}, duration, references=references)


def on_the_bench(true: Device, nominal: Device, frequency: float, seed: int) -> Recording:
    """Sense signal and the detector's angle."""
    recording, _ = simulate(true, driven(frequency, LENGTH, references=("angle",)), seed=seed, nominal=nominal)
    channels = {name: (c.read(), c.unit, c.sample_rate, c.start) for name, c in recording.channels.items()}
    angle, *told = channels["angle_x"]
    noise = DETECTOR_NOISE * np.random.default_rng(seed).standard_normal(angle.size)
    return Recording.from_arrays(channels | {"angle_x": (angle + noise, *told)}, nominal)


def diagnosed(true: Device, nominal: Device) -> Diagnosis:
    """What the bench's recordings, taken together, say is missing."""
    records = [on_the_bench(true, nominal, frequency, seed) for seed, frequency in enumerate(CALIBRATION)]
    return diagnose(records, nominal, lambda text: print(text, file=sys.stderr))


def phase_over_sweep(true: Device, device: Device, sweep: Sequence[float] = SWEEP) -> NDArray[np.float64]:
    """Mean phase error of the tracker with ``device`` at each drive frequency, shape (len(sweep),) [deg]."""
    errors = []
    for frequency in sweep:
        recording, told = simulate(true, driven(frequency, TEST), seed=round(frequency), nominal=device)
        truth = truth_from_simulation(told)
        assert truth is not None
        error = evaluate_axis(estimate(recording, device, "tracker").axes["x"], *truth.angles["x"])
        errors.append(np.degrees(error.phase.mean()))
    return np.array(errors)


def main(folder: Path) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    true = devices.load("chen2020-driven")
    nominal = papers_own(true)
    found = diagnosed(true, nominal)
    for finding in found.findings:
        values = ", ".join(f"{p.name} = {p.value:.4g} {p.unit}" for p in finding.parameters)
        held = finding.heldout
        print(f"{finding.effect} ({finding.stage}): {values}; held out {held['before']:.3f} -> {held['after']:.3f}")
    lags = phase_over_sweep(true, nominal)
    constant = lags - lags.mean()  # the paper's calibration: one phase shift for the whole sweep
    improved = phase_over_sweep(true, found.device)
    for name, errors in (("no filter", lags), ("one constant phase", constant), ("improved device", improved)):
        told = ", ".join(f"{error:.3f}°" for error in errors)
        print(f"{name:>18}: {told}; spread {np.ptp(errors):.3f}°, rms {np.sqrt(np.mean(errors**2)):.3f}°")

    (folder / "diagnosis.json").write_text(json.dumps(found.to_json(), indent=1), encoding="utf-8")
    (folder / "device.toml").write_text(found.device.to_toml(), encoding="utf-8")
    drawing, axes = new_figure(1, 1, (6.0, 3.6))
    place = axes.flat[0]
    khz = np.array(SWEEP) / 1e3
    place.plot(khz, constant, "o-", label="the paper's model, one constant phase")
    place.plot(khz, improved, "s-", label="with what the diagnosis found")
    place.set(xlabel="drive [kHz]", ylabel="phase error [deg]")
    place.legend()
    drawing.savefig(folder / "sweep_lag.png", dpi=150)


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "sweep-lag"))
