r"""
The bound, and what blur looks like
===================================

A sample at θ = A sin α lands A cos α Δφ off where the phase errs by Δφ: at most m Δφ pixels, in the middle of a line,
m being half the picture's width in pixels. A picture that tolerates p pixels asks for a phase within p/m (chen2020,
eq 7).
"""

import matplotlib.pyplot as plt
import numpy as np

from phantoms.optics import sample
from phantoms.targets import siemens_star
from recon.blur import bound, parts, picture_error
from recon.mapping import Grid, Picture, map_samples

grid = Grid(200, 200, 0.18, 0.18)
limit = bound(p=1.0, m=grid.width / 2)
print(f"p/m = {limit:.4f} rad = {np.degrees(limit):.3f}°")

# %%
# The motion is known exactly here; the picture is mapped with a phase of x that is wrong by a given amount. Forward and
# backward sweeps then miss in opposite directions, so that every edge stands twice.
scene = siemens_star((1000, 1000))
time = np.arange(200_000) / 5e6
turn_x, turn_y = 2 * np.pi * 13840.0 * time, 2 * np.pi * 3270.0 * time + 0.3
theta_x, theta_y = 0.182 * np.sin(turn_x), 0.182 * np.sin(turn_y)
light = sample(scene, theta_x, theta_y, grid.half_angle_x, grid.half_angle_y)


def mapped(error: float) -> Picture:
    """The picture under a phase of x that is wrong by ``error`` [rad]."""
    return map_samples(0.182 * np.sin(turn_x + error), theta_y, light, grid)


multiples = (0.0, 1.0, 3.0, 6.0)
figure, panels = plt.subplots(1, len(multiples), figsize=(12, 3.4), layout="constrained")
for panel, multiple in zip(panels, multiples, strict=True):
    panel.imshow(mapped(multiple * limit).image[60:140, 60:140], cmap="gray")
    panel.set(title=f"phase error {multiple:g} p/m", xticks=[], yticks=[])
plt.show()

# %%
# Pixels of this size leave an error even where the phase is right. At p/m it has about doubled; beyond, edges part.
errors = limit * np.linspace(0.0, 6.0, 7)
rms = [picture_error(mapped(error), scene).rms for error in errors]
moved = [parts(0.182, 0.18, 200, error, 0.0)["phase"] for error in errors]
figure, left = plt.subplots(layout="constrained")
left.plot(errors / limit, rms, "o-", color="C0")
left.axvline(1.0, color="0.4", ls=":", label="p/m")
left.set(xlabel="phase error (p/m)", ylabel="picture error (of the scene's contrast)")
left.legend()
right = left.twinx()
right.plot(errors / limit, moved, color="C1")
right.set_ylabel("displacement of a sample, rms (px)", color="C1")
plt.show()
print(f"picture error: {rms[0]:.3f} at no phase error, {rms[1]:.3f} at p/m, {rms[-1]:.3f} at 6 p/m")
