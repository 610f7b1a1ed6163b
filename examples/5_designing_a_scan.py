"""
Designing a scan
================

Motions at n_x F and n_y F, without a common divisor, trace one closed figure F times a second. Which pairs does this
mirror sustain, and how much of the picture do they visit?
"""

import matplotlib.pyplot as plt

from recon.coverage import fill_against_time
from recon.design import PHASES, Wish, design
from recon.mapping import Grid, map_samples
from scanner import devices

# %%
# 60 pictures a second of 200 × 200 pixels, 85 pixels in 100 visited, from 30 V + 30 V sin on both axes.
device = devices.load("imaging")
grid = Grid(200, 200, device.scan.half_angle_x, device.scan.half_angle_y)
wish = Wish(grid, frame_rate=60.0, fill=0.85)
bands, candidates = design(device, wish, volts=(30.0, 30.0))
for axis, band in bands.items():
    low, high = band.covering(0.18, wish.margin)
    print(f"{axis}: the field is covered from {low:.1f} to {high:.1f} Hz of the motion")
for each in candidates[:5]:
    n_x, n_y = each.figure.windings
    print(
        f"{n_x}:{n_y}, drives {each.drive[0]:.2f} and {each.drive[1]:.2f} Hz, {each.figure.frame_rate:.2f} pictures a "
        f"second, fill {each.fill['worst']:.1%} to {each.fill['best']:.1%}, worst gap {each.gap['worst']:.1f} px"
    )

# %%
# The phase between the axes decides how fine the mesh is. A drifting resonance moves through best and worst.
best = candidates[0]
rate = 5e6
figure, panels = plt.subplots(1, 3, figsize=(12, 3.8), layout="constrained")
for panel, phase in zip(panels, PHASES, strict=False):
    x, y = best.figure.angles(rate, phase)
    panel.imshow(map_samples(x, y, x, grid).coverage > 0, cmap="gray")
    panel.set(title=f"visited at the {phase} phase", xticks=[], yticks=[])
    time, fill = fill_against_time(x, y, rate, grid)
    panels[2].plot(1e3 * time, fill, label=phase)
panels[2].axhline(wish.fill, color="0.4", ls=":")
panels[2].set(xlabel="time (ms)", ylabel="fill")
panels[2].legend()
plt.show()
