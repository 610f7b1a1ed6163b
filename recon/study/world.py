"""One job of a study: simulate a recording, reconstruct it in several ways, say how far each is from the truth."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache
from typing import Any

import numpy as np

from phantoms.experiment import Experiment, run
from phantoms.forward import Plan, simulate
from phantoms.optics import Detector
from phantoms.waveforms import Sine, Waveform
from recon.output import finite
from recon.pipeline import AXES, Options, Reconstruction, reconstruct
from recon.score import told_truth
from recon.study.plan import Design, Job, World
from recon.summary import axis_summary, summarise
from scanner.device import Amdm, Device, Readout
from scanner.recording import Recording

_CALIBRATION = 2e-3  # seconds of noiseless signal whose rms is the SNR's


def do(job: Job) -> list[dict[str, Any]]:
    """One record for each cell of the job: ``cell`` and either what was measured or ``failed``, why not.

    What an estimator cannot do (the motion died, the covariance lost its rank) is a result of the study, not its end.
    """
    recording = truth = None
    records: list[dict[str, Any]] = []
    for way in job.ways:
        try:
            if recording is None:
                recording, told = record(job.world)
                truth = told_truth(told)
            options = Options(estimator=way[0], pixels=(way[1], way[1]))
            result = reconstruct(recording, options, truth, quiet=True)
            whole = summarise(result)
        except (ValueError, ArithmeticError, np.linalg.LinAlgError) as error:
            failed = " ".join(f"{error}".split()) or type(error).__name__
            records += [{"cell": job.cell(way, p), "failed": failed} for p in job.p]
            continue
        for p in job.p:
            # p moves the bound and nothing else: the picture is scored once.
            axes = {axis: _measured(replace(result, p=p), axis) for axis in AXES}
            shared = {"picture_error": (whole["picture"] or {}).get("rms"), "fill": whole["fill"]}
            records.append({"cell": job.cell(way, p), **axes, **shared, "seconds": result.seconds})
    return [finite(each) for each in records]


def record(world: World) -> tuple[Recording, dict[str, object]]:
    """The recording of a world and what ``phantoms.forward.simulate`` tells of its truth."""
    device = Device.from_toml(world.design.device, source=world.design.name)
    if world.snr_db is not None:
        device = with_noise(device, sense_rms(world.design, world.recording.sample_rate), world.snr_db)
    own = world.recording
    experiment = Experiment(
        device=device,
        target=world.phantom,
        drives=_drives(world.design),
        duration=own.duration,
        sample_rate=own.sample_rate,
        drift=dict.fromkeys(AXES, world.drift),
        drift_tau=own.drift_tau,
        field_um=own.field_um,
        spot_um=own.spot_um,
        detector=Detector(gain=1.0 / own.photons, photons_per_sample=own.photons, bits=12),
    )
    return run(experiment, world.seed)


@lru_cache(maxsize=16)
def sense_rms(design: Design, sample_rate: float) -> dict[str, float]:
    """Rms of the noiseless sense signals about their mean, by channel [V]."""
    device = _each_readout(Device.from_toml(design.device), lambda name, readout: _noise(readout, 0.0, None))
    recording, _ = simulate(device, Plan(_drives(design), _CALIBRATION, sample_rate))
    return {name: float(np.std(channel.read())) for name, channel in recording.channels.items() if "sense" in name}


def with_noise(device: Device, rms: dict[str, float], snr_db: float) -> Device:
    """The device with each readout's noise at ``snr_db`` below the ``rms`` [V] of its channel."""

    def noisy(name: str, readout: Readout) -> Readout:
        return _noise(readout, rms[name] * 10.0 ** (-snr_db / 20.0), readout.bits)

    return _each_readout(device, noisy)


def _noise(readout: Readout, sd: float, bits: int | None) -> Readout:
    if isinstance(readout, Amdm):
        return replace(readout, noise_var=sd * sd, bits=bits)
    return replace(readout, noise_sd=sd, bits=bits)


def _each_readout(device: Device, change: Callable[[str, Readout], Readout]) -> Device:
    if device.readout is not None:
        return replace(device, readout=change("sense", device.readout))
    axes = {
        name: axis if axis.readout is None else replace(axis, readout=change(f"sense_{name}", axis.readout))
        for name, axis in device.axes.items()
    }
    return replace(device, axes=axes)


def _drives(design: Design) -> dict[str, Waveform]:
    return {"x": Sine(*design.drive_x), "y": Sine(*design.drive_y)}


def _measured(result: Reconstruction, axis: str) -> dict[str, Any]:
    summary = axis_summary(result, axis)
    blur = {f"blur_{cause}_px": value for cause, value in summary["blur_px"].items()}
    seen = summary["picture_phase_error_deg"]
    kept = ("phase_rmse_deg", "phase_bias_deg", "phase_sd_deg", "bound_deg", "within_bound", "amplitude_rmse")
    return {name: summary[name] for name in kept} | {"seen_deg": seen["value"], "seen_sd_deg": seen["sd"]} | blur
