"""The lag of a demodulator is not constant over a frequency sweep: diagnosis and correction in a simulated experiment.

    python examples/sweep_lag.py [FOLDER]

The model of chen2020 is y = a_cir C + b_cir with filters whose phase shifts "are constant" (section II-C). The phase
shift of two low-pass sections near 41 kHz is not: from 31.11 to 31.50 kHz the phase of the motion changes by 0.35°,
over the sweep of this example by 0.123°.
Three short recordings at different drive frequencies, with a position detector as in the paper, are diagnosed against
the device of the paper. Recordings at other frequencies, of the sense signal only, are then estimated with the constant
phase shift of the paper and with the improved device.
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
from scanner.device import Device
from scanner.harmonics import readout_response
from scanner.recording import Recording
from scanner.stages import Amdm

CALIBRATION = 31420.0, 31470.0, 31520.0  # Hz, drive frequencies of the diagnosed recordings
SWEEP = 31400.0, 31440.0, 31500.0, 31540.0  # Hz, drive frequencies of the test recordings
CALIBRATION_S, TEST_S = 0.003, 0.006  # seconds
DETECTOR_NOISE = 1e-4  # rad, standard deviation of the position detector


def without_filters(true: Device) -> Device:
    """The device as modelled in the paper: without a filter after the demodulator."""
    axis = true.axis("x")
    readout = axis.require_readout()
    assert isinstance(readout, Amdm)
    return replace(true, axes={"x": replace(axis, readout=replace(readout, lpf_hz=()))})


def driven(frequency: float, duration: float, references: tuple[str, ...] = ()) -> Plan:
    """30 V + 30 V sin at ``frequency`` [Hz], for ``duration`` [s]."""
    return Plan({"x": Sine(frequency, 30.0, 30.0)}, duration, references=references)


def record_with_detector(true: Device, nominal: Device, frequency: float, seed: int) -> Recording:
    """A recording with the sense signal and the angle of a noisy position detector."""
    recording, _ = simulate(true, driven(frequency, CALIBRATION_S, references=("angle",)), seed=seed, nominal=nominal)
    channels = {name: (c.read(), c.unit, c.sample_rate, c.start) for name, c in recording.channels.items()}
    angle, *layout = channels["angle_x"]
    noise = DETECTOR_NOISE * np.random.default_rng(seed).standard_normal(angle.size)
    return Recording.from_arrays(channels | {"angle_x": (angle + noise, *layout)}, nominal)


def diagnose_calibration(true: Device, nominal: Device) -> Diagnosis:
    """Diagnosis of the calibration recordings against the nominal device."""
    records = [record_with_detector(true, nominal, frequency, seed) for seed, frequency in enumerate(CALIBRATION)]
    return diagnose(records, nominal, lambda text: print(text, file=sys.stderr))


def lag_of_filters(true: Device, nominal: Device, sweep: Sequence[float] = SWEEP) -> NDArray[np.float64]:
    """Phase by which a nominal device without filters misses the motion at each drive frequency [deg].

    The main line of the signal is the second harmonic of the motion, at the drive frequency, so that a phase shift of
    the filters counts half.
    """
    responses = [readout_response(each.axis("x").require_readout(), np.array(sweep)) for each in (true, nominal)]
    return np.degrees(-0.5 * np.angle(responses[0] / responses[1]))


def phase_over_sweep(
    true: Device, device: Device, sweep: Sequence[float] = SWEEP
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Mean phase error of the tracker with ``device`` at each drive frequency, and its stated uncertainty [deg].

    The uncertainty is the root mean square of ``phase_sd``, which bounds the standard deviation of the mean.
    """
    errors, sds = [], []
    for frequency in sweep:
        recording, simulation = simulate(true, driven(frequency, TEST_S), seed=round(frequency), nominal=device)
        truth = truth_from_simulation(simulation)
        assert truth is not None
        motion = estimate(recording, device, "tracker").axes["x"]
        errors.append(np.degrees(evaluate_axis(motion, *truth.angles["x"]).phase.mean()))
        sds.append(np.degrees(np.sqrt(np.mean(motion.phase_sd**2))))
    return np.array(errors), np.array(sds)


def main(folder: Path) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    true = devices.load("chen2020-driven")
    nominal = without_filters(true)
    diagnosis = diagnose_calibration(true, nominal)
    for finding in diagnosis.findings:
        values = ", ".join(f"{p.name} = {p.value:.4g} {p.unit}" for p in finding.parameters)
        heldout = finding.heldout
        print(
            f"{finding.effect} ({finding.stage}): {values}; held out {heldout['before']:.3f} -> {heldout['after']:.3f}"
        )
    lags, _ = phase_over_sweep(true, nominal)
    constant = lags - lags.mean()  # the paper's calibration: one phase shift for the whole sweep
    improved, _ = phase_over_sweep(true, diagnosis.device)
    for name, errors in (
        ("lag of the filters", lag_of_filters(true, nominal)),
        ("no filter", lags),
        ("one constant phase", constant),
        ("improved device", improved),
    ):
        values_text = ", ".join(f"{error:.3f}°" for error in errors)
        print(f"{name:>18}: {values_text}; spread {np.ptp(errors):.3f}°, rms {np.sqrt(np.mean(errors**2)):.3f}°")

    (folder / "diagnosis.json").write_text(json.dumps(diagnosis.to_json(), indent=1), encoding="utf-8")
    (folder / "device.toml").write_text(diagnosis.device.to_toml(), encoding="utf-8")
    figure, axes = new_figure(1, 1, (6.0, 3.6))
    panel = axes.flat[0]
    khz = np.array(SWEEP) / 1e3
    panel.plot(khz, constant, "o-", label="the paper's model, one constant phase")
    panel.plot(khz, improved, "s-", label="improved device of the diagnosis")
    panel.set(xlabel="drive [kHz]", ylabel="phase error [deg]")
    panel.legend()
    figure.savefig(folder / "sweep_lag.png", dpi=150)


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "sweep-lag"))
