"""
Finding missing physics
=======================

Behind the demodulator the amplifier has one more low-pass than its data sheet states, and the picture is blurred. A
diagnosis of a calibration recording names the effect, and the same scan is sharp with the improved device. The device
and its recordings are made by ``missing_physics.py`` in the same folder.
"""

import matplotlib.pyplot as plt
from missing_physics import UNMODELLED, calibration, phase_errors, scanned, with_terms

import lissajous
from estimation.device_fit.data import prepare_run
from estimation.diagnosis.diagnose import build_diagnosis
from estimation.diagnosis.selection import select_terms
from recon.report.figures import fill_small_holes, normalise_intensity

nominal = lissajous.load_device("imaging")
true = with_terms(nominal, UNMODELLED)
print(f"unmodelled effect: {UNMODELLED}")


def print_errors(scan: str, errors: dict[str, float]) -> None:
    print(f"{scan}: phase error {errors['x']:.3f}° in x, {errors['y']:.3f}° in y, rms")


# %%
# The scan, reconstructed with the nominal device.
scan = scanned(true, nominal, duration=0.012)
before = scan(nominal)
print_errors("nominal device", phase_errors(before))

# %%
# A calibration recording of five milliseconds with a position detector. ``lissajous.diagnose`` searches the whole
# catalogue; to be quick, only effects of readout and timing are searched here.
bench = calibration(true, nominal)
terms = {name: term for name, term in lissajous.catalogue().items() if term.stage in ("readout", "timing")}
found = build_diagnosis(select_terms([prepare_run(bench, nominal)], nominal, terms))
for finding in found.findings:
    print(f"{finding.effect} ({finding.stage}), probability {finding.probability:.2f}: {finding.equation}")
    for p in finding.parameters:
        print(f"  {p.name} = {p.value:.4g} {p.unit} ({p.ci95[0]:.4g} to {p.ci95[1]:.4g})")
    for rival in finding.rivals:
        print(f"  or {rival.effect}, {rival.probability:.2f}")

# %%
# A low-pass far above the signal and a delay are nearly the same effect, and either one corrects the picture.
after = scan(found.device)
print_errors("improved device", phase_errors(after))
figure, panels = plt.subplots(1, 2, figsize=(9, 4.6), layout="constrained")
for panel, result, title in zip(panels, (before, after), ("nominal device", "improved device"), strict=True):
    panel.imshow(normalise_intensity(fill_small_holes(result.picture)), cmap="gray")
    panel.set(title=title, xticks=[], yticks=[])
plt.show()
