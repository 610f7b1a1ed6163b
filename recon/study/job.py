"""One job of a study: simulate a recording, reconstruct it in several variants, and compare each with the truth."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import replace
from functools import lru_cache
from typing import Any

import numpy as np

from phantoms.experiment import Experiment, plan_experiment, settling_time, simulate_experiment
from phantoms.forward import Plan, simulate
from phantoms.optics import imaging_detector
from phantoms.waveforms import Sine
from recon.evaluation import truth_from_simulation
from recon.io.output import finite
from recon.pipeline import reconstruct
from recon.report.summary import axis_summary, summarise
from recon.steps.reconstruction import Options, Reconstruction
from recon.study.plan import Job, Scenario, StudyDesign
from scanner.device import AXES, Device
from scanner.recording import Recording
from scanner.stages import Amdm, Readout

CALIBRATION_TIME_S, CALIBRATION_PERIODS = 2e-3, 10.0
"""Least duration [s] of the noiseless signal whose rms defines the signal-to-noise ratio, and its least number of
periods of the slowest axis: a part of a period changes the rms by less than 1 %."""


def run_job(job: Job) -> list[dict[str, Any]]:
    """Return one record for each cell of the job: ``cell``, and either the results or the reason in ``failed``.

    A failure of an estimator (the motion ceased, the covariance became singular) is a result of the study.
    """
    recording = truth = None
    records: list[dict[str, Any]] = []
    for variant in job.variants:
        try:
            if recording is None:
                recording, simulated = simulate_scenario(job.scenario)
                truth = truth_from_simulation(simulated)
            options = Options(estimator=variant[0], pixels=(variant[1], variant[1]))
            result = reconstruct(recording, options, truth, quiet=True)
            summary = summarise(result)
        except (ValueError, ArithmeticError, np.linalg.LinAlgError) as error:
            failed = " ".join(f"{error}".split()) or type(error).__name__
            records += [{"cell": job.cell(variant, p), "failed": failed} for p in job.p]
            continue
        for p in job.p:
            # p changes the bound only, so the picture is compared once.
            axes = {axis: _axis_record(replace(result, p=p), axis) for axis in AXES}
            shared = {"picture_error": (summary["picture"] or {}).get("rms"), "fill": summary["fill"]}
            records.append({"cell": job.cell(variant, p), **axes, **shared, "seconds": result.seconds})
    return [finite(each) for each in records]


def check_scenarios(scenarios: Iterable[Scenario]) -> None:
    """Check recordings before the first one is simulated; those that differ in noise only once.

    Raises:
        BadInput: one cannot be simulated, whatever its noise.
    """
    distinct = {(each.phantom, each.design.name, each.drift): each for each in scenarios}
    for scenario in distinct.values():
        plan_experiment(_experiment(scenario, _device(scenario.design)))


def simulate_scenario(scenario: Scenario) -> tuple[Recording, dict[str, object]]:
    """Simulate the recording of a scenario; return it with its truth."""
    device = _device(scenario.design)
    if scenario.snr_db is not None:
        device = with_noise(device, sense_rms(scenario.design, scenario.recording.sample_rate), scenario.snr_db)
    return simulate_experiment(_experiment(scenario, device), scenario.seed)


def _device(design: StudyDesign) -> Device:
    return Device.from_toml(design.device, source=design.name)


def _experiment(scenario: Scenario, device: Device) -> Experiment:
    conditions = scenario.recording
    return Experiment(
        device=device,
        target=scenario.phantom,
        drives=_drive_waveforms(scenario.design),
        duration=conditions.duration,
        sample_rate=conditions.sample_rate,
        drift=dict.fromkeys(AXES, scenario.drift),
        drift_tau=conditions.drift_tau,
        field_um=conditions.field_um,
        spot_um=conditions.spot_um,
        detector=imaging_detector(conditions.photons),
    )


@lru_cache(maxsize=16)
def sense_rms(design: StudyDesign, sample_rate: float) -> dict[str, float]:
    """Return the rms of the noiseless sense signals of settled axes about their mean, by channel [V]."""
    device = _replace_readouts(Device.from_toml(design.device), lambda name, readout: _set_noise(readout, 0.0, None))
    drives = _drive_waveforms(design)
    duration = max(CALIBRATION_TIME_S, CALIBRATION_PERIODS / _slowest_frequency(device, drives))
    recording, _ = simulate(device, Plan(drives, duration, sample_rate, settle=settling_time(device)))
    return {name: float(np.std(channel.read())) for name, channel in recording.channels.items() if "sense" in name}


def _slowest_frequency(device: Device, drives: Mapping[str, Sine]) -> float:
    """Lowest frequency of a motion [Hz]: an axis follows its drive, or moves near its resonance."""
    resonances = [axis.resonance for axis in device.axes.values() if axis.mechanics]
    return min([*resonances, *(drive.frequency for drive in drives.values() if drive.frequency > 0)])


def with_noise(device: Device, rms: dict[str, float], snr_db: float) -> Device:
    """Return the device with the noise of each readout ``snr_db`` below the ``rms`` [V] of its channel."""

    def noisy(name: str, readout: Readout) -> Readout:
        return _set_noise(readout, rms[name] * 10.0 ** (-snr_db / 20.0), readout.bits)

    return _replace_readouts(device, noisy)


def _set_noise(readout: Readout, sd: float, bits: int | None) -> Readout:
    if isinstance(readout, Amdm):
        return replace(readout, noise_var=sd * sd, bits=bits)
    return replace(readout, noise_sd=sd, bits=bits)


def _replace_readouts(device: Device, change: Callable[[str, Readout], Readout]) -> Device:
    if device.readout is not None:
        return replace(device, readout=change("sense", device.readout))
    axes = {
        name: axis if axis.readout is None else replace(axis, readout=change(f"sense_{name}", axis.readout))
        for name, axis in device.axes.items()
    }
    return replace(device, axes=axes)


def _drive_waveforms(design: StudyDesign) -> dict[str, Sine]:
    return {"x": Sine(*design.drive_x), "y": Sine(*design.drive_y)}


def _axis_record(result: Reconstruction, axis: str) -> dict[str, Any]:
    summary = axis_summary(result, axis)
    blur = {f"blur_{cause}_px": value for cause, value in summary["blur_px"].items()}
    measured = summary["picture_phase_error_deg"]
    names = ("phase_rmse_deg", "phase_bias_deg", "phase_sd_deg", "bound_deg", "within_bound", "amplitude_rmse")
    return (
        {name: summary[name] for name in names} | {"seen_deg": measured["value"], "seen_sd_deg": measured["sd"]} | blur
    )
