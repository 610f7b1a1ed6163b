"""
Finding missing physics
=======================

Behind the demodulator the amplifier has one more low-pass than its data sheet says. The picture is blurred; a bench
recording is held against the nominal device; what is missing is named, and the same scan comes out sharp. The device
and its recordings are those of ``missing_physics.py``, which stands beside this in ``examples``.
"""

import matplotlib.pyplot as plt
from missing_physics import HIDDEN, calibration, phase_errors, scanned, with_terms

from estimation.mismatch.diagnosis import judged
from estimation.mismatch.experiment import experiment
from estimation.mismatch.search import search
from recon.views import stretched, visible
from scanner import devices
from scanner.terms import catalogue

nominal = devices.load("imaging")
true = with_terms(nominal, HIDDEN)
print(f"hidden: {HIDDEN}")


def tell(scan: str, errors: dict[str, float]) -> None:
    print(f"{scan}: phase error {errors['x']:.3f}° in x, {errors['y']:.3f}° in y, rms")


# %%
# The scan, reconstructed as the data sheet has the device.
scan = scanned(true, nominal, duration=0.012)
before = scan(nominal)
tell("nominal device", phase_errors(before))

# %%
# Five milliseconds on the bench, with a position detector. ``diagnose`` searches the whole catalogue; to be quick, here
# it is what stands behind the mirror.
bench = calibration(true, nominal)
terms = {name: term for name, term in catalogue().items() if term.stage in ("readout", "timing")}
found = judged(search([experiment(bench, nominal)], nominal, terms))
for finding in found.findings:
    print(f"{finding.effect} ({finding.stage}), probability {finding.probability:.2f}: {finding.equation}")
    for p in finding.parameters:
        print(f"  {p.name} = {p.value:.4g} {p.unit} ({p.ci95[0]:.4g} to {p.ci95[1]:.4g})")
    for rival in finding.rivals:
        print(f"  or {rival.effect}, {rival.probability:.2f}")

# %%
# A low-pass far above the signal and a delay are nearly one and the same, and either puts the picture right.
after = scan(found.device)
tell("improved device", phase_errors(after))
figure, panels = plt.subplots(1, 2, figsize=(9, 4.6), layout="constrained")
for panel, result, title in zip(panels, (before, after), ("nominal device", "improved device"), strict=True):
    panel.imshow(stretched(visible(result.picture)), cmap="gray")
    panel.set(title=title, xticks=[], yticks=[])
plt.show()
