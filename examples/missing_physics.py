"""A readout with an unmodelled low-pass: the picture is blurred, a diagnosis names the effect, the same scan is sharp.

    python examples/missing_physics.py [FOLDER]

Behind the demodulator the amplifier has one more low-pass than its data sheet states, and both axes share the electrode
that it reads. A scan alone does not determine that: damping and combs within their tolerances would change the phase as
well. A calibration recording of the same device does: five milliseconds with a position detector.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

import lissajous
from estimation.diagnosis.diagnose import Diagnosis
from phantoms.experiment import Experiment, simulate_experiment
from phantoms.forward import Plan, simulate
from recon.evaluation import truth_from_simulation
from recon.imaging.picture import Picture
from recon.pipeline import reconstruct
from recon.report.figures import fill_small_holes, new_figure, normalise_intensity
from recon.report.summary import summarise
from recon.steps.reconstruction import Options, Reconstruction
from scanner.device import Device
from scanner.recording import Recording

UNMODELLED = {"readout-lag": {"f_c": 1.5e5}}
SCAN, CALIBRATION = 0.04, 0.005  # seconds
DETECTOR_NOISE = 1e-4  # rad, of the bench's position detector
SEED = 4


def with_terms(device: Device, terms: dict[str, dict[str, float]]) -> Device:
    """The device with effects of its readout; on a shared electrode they are stated with the first axis."""
    return replace(device, axes=dict(device.axes) | {"x": replace(device.axis("x"), terms=terms)})


def calibration(true: Device, nominal: Device, duration: float = CALIBRATION) -> Recording:
    """A recording of both axes driven, with the sense signal and the angles of a position detector."""
    plan = Plan(Experiment().drives, duration, references=("angle",))
    recording, _ = simulate(true, plan, seed=SEED + 1, nominal=nominal)
    rng = np.random.default_rng(SEED)
    channels = {}
    for name, channel in recording.channels.items():
        noise = DETECTOR_NOISE if name.startswith("angle") else 0.0
        values = channel.read() + noise * rng.standard_normal(channel.size)
        channels[name] = (values, channel.unit, channel.sample_rate, channel.start)
    return Recording.from_arrays(channels, nominal, name="calibration")


def phase_errors(found: Reconstruction) -> dict[str, float]:
    """Phase error of each axis, root mean square [deg]."""
    return {axis: float(np.degrees(error.phase_rmse)) for axis, error in found.evaluation.items()}


def scanned(
    true: Device, nominal: Device, duration: float = SCAN, target: str = "immunohistochemistry"
) -> Callable[[Device], Reconstruction]:
    """A function that reconstructs one scan of the true device with the device that it is given."""
    scan, simulated_truth = simulate_experiment(Experiment(true, target, duration=duration), SEED, nominal=nominal)
    truth = truth_from_simulation(simulated_truth)
    return lambda device: reconstruct(replace(scan, device_toml=device.to_toml()), Options(sense_only=True), truth)


def close_the_loop() -> tuple[Reconstruction, Diagnosis, Reconstruction]:
    """The scan by the nominal device, the diagnosis of the calibration recording, the scan by the improved device."""
    nominal = lissajous.load_device("imaging")
    true = with_terms(nominal, UNMODELLED)
    scan = scanned(true, nominal)
    found = lissajous.diagnose(calibration(true, nominal), nominal)
    return scan(nominal), found, scan(found.device)


def draw(before: Picture, after: Picture, path: Path) -> None:
    """Both pictures side by side."""
    drawing, axes = new_figure(1, 2, (9.0, 4.6))
    for place, picture, title in zip(axes.flat, (before, after), ("nominal device", "improved device"), strict=True):
        place.imshow(normalise_intensity(fill_small_holes(picture)), cmap="gray")
        place.set(title=title, xticks=[], yticks=[])
    drawing.savefig(path, dpi=150)


def main(folder: Path) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    before, found, after = close_the_loop()
    for finding in found.findings:
        values = ", ".join(
            f"{p.name} = {p.value:.4g} {p.unit} ({p.ci95[0]:.4g} to {p.ci95[1]:.4g})" for p in finding.parameters
        )
        rivals = ", ".join(f"{rival.effect} {rival.probability:.3f}" for rival in finding.rivals) or "none"
        print(
            f"{finding.effect} ({finding.stage}, {finding.axis}): {values}; {finding.probability:.3f}, rivals {rivals}"
        )
    for name, result in (("nominal", before), ("improved", after)):
        errors, picture = phase_errors(result), summarise(result)["picture"]
        print(f"{name:>9}: phase error {errors['x']:.3f}° x, {errors['y']:.3f}° y; picture error {picture['rms']:.4f}")
    (folder / "diagnosis.json").write_text(json.dumps(found.to_json(), indent=1), encoding="utf-8")
    (folder / "device.toml").write_text(found.device.to_toml(), encoding="utf-8")
    draw(before.picture, after.picture, folder / "missing_physics.png")
    print(f"Pictures: {folder / 'missing_physics.png'}, improved device: {folder / 'device.toml'}")


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "missing-physics"))
