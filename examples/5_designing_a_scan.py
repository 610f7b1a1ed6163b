"""
Designing a scan
================

Motions at n_x F and n_y F, without a common divisor, trace one closed figure F times a second. Which pairs can this
mirror sustain, and which fraction of the picture do they visit?
"""

import matplotlib.pyplot as plt
import numpy as np

import lissajous

# %%
# 60 pictures a second of 200 × 200 pixels, 85 % of the pixels on the path of the beam, drives of 30 V + 30 V sin on
# both axes.
device = lissajous.load_device("imaging")
found = lissajous.design(device, pixels=(200, 200), frame_rate=60.0, fill=0.85, volts=(30.0, 30.0), sample_rate=None)
for axis, band in found.bands.items():
    low, high = band.motion_frequencies_reaching(0.18, 0.0005)
    print(f"{axis}: the field is covered from {low:.1f} to {high:.1f} Hz of the motion")
for pair in found.candidates[:5]:
    n_x, n_y = pair.figure.windings
    print(
        f"{n_x}:{n_y}, drives {pair.drive[0]:.2f} and {pair.drive[1]:.2f} Hz, {pair.figure.frame_rate:.2f} pictures a "
        f"second, fill {pair.fill['worst']:.1%} to {pair.fill['best']:.1%}, worst gap {pair.gap['worst']:.1f} px"
    )

# %%
# The phase between the axes determines the mesh. A drifting resonance moves it from the best phase to the worst and
# back.
best = found.candidates[0]
rate = 5e6
grid = lissajous.Grid(200, 200, device.scan.half_angle_x, device.scan.half_angle_y)
figure, panels = plt.subplots(1, 3, figsize=(12, 3.8), layout="constrained")
for panel, phase in zip(panels, ("best", "worst"), strict=False):
    x, y = best.figure.angles(rate, *best.starts[phase])
    counts = np.linspace(0, x.size, 21, dtype=int)[1:]
    coverage = [lissajous.map_samples(x[:n], y[:n], x[:n], grid).coverage for n in counts]
    panel.imshow(coverage[-1] > 0, cmap="gray")
    panel.set(title=f"visited at the {phase} phase", xticks=[], yticks=[])
    panels[2].plot(1e3 * counts / rate, [np.mean(visits > 0) for visits in coverage], label=phase)
panels[2].axhline(0.85, color="0.4", ls=":")
panels[2].set(xlabel="time (ms)", ylabel="fill")
panels[2].legend()
plt.show()
