r"""
The bound, and what blur looks like
===================================

A sample at θ = A sin α is displaced by A cos α Δφ where the phase is wrong by Δφ: at most m Δφ pixels, in the middle
of a line, with m half the width of the picture in pixels. A picture that tolerates p pixels needs a phase within p/m
(chen2020, eq 7).
"""

import matplotlib.pyplot as plt
import numpy as np

import lissajous

grid = lissajous.Grid(200, 200, 0.18, 0.18)
limit = lissajous.phase_bound(p=1.0, m=grid.width / 2)
print(f"p/m = {limit:.4f} rad = {np.degrees(limit):.3f}°")

# %%
# The true angles of a simulation are known exactly. The picture is mapped with a phase of x that is wrong by a given
# amount: the angles are read too early by that part of a period. Forward and backward sweeps are then displaced in
# opposite directions.
recording, truth = lissajous.simulate(target="siemens_star", duration=0.04, drift=0.0, seed=1)
intensity = recording["intensity"].read()
(theta_x, clock), (theta_y, _) = (truth[f"angle_{axis}"] for axis in "xy")
time = np.arange(theta_x.size) / clock["sample_rate"]


def map_with_error(error: float) -> lissajous.Picture:
    """The picture under a phase of x that is wrong by ``error`` [rad]."""
    shifted = np.interp(time + error / (2 * np.pi * 13840.0), time, theta_x)
    return lissajous.map_samples(shifted, theta_y, intensity, grid)


multiples = (0.0, 1.0, 3.0, 6.0)
figure, panels = plt.subplots(1, len(multiples), figsize=(12, 3.4), layout="constrained")
for panel, multiple in zip(panels, multiples, strict=True):
    panel.imshow(map_with_error(multiple * limit).image[60:140, 60:140], cmap="gray")
    panel.set(title=f"phase error {multiple:g} p/m", xticks=[], yticks=[])
plt.show()

# %%
# The picture error against the noiseless scene. At p/m it is about three times the error of the pixels themselves.
# Beyond, edges are doubled.
errors = limit * np.linspace(0.0, 6.0, 7)
rms = [lissajous.compare_with_scene(map_with_error(error), truth["scene"]).rms for error in errors]
displacement = 0.182 / 0.18 * 100 * errors / np.sqrt(2.0)
figure, left = plt.subplots(layout="constrained")
left.plot(errors / limit, rms, "o-", color="C0")
left.axvline(1.0, color="0.4", ls=":", label="p/m")
left.set(xlabel="phase error (p/m)", ylabel="picture error (of the scene's contrast)")
left.legend()
right = left.twinx()
right.plot(errors / limit, displacement, color="C1")
right.set_ylabel("displacement of a sample, rms (px)", color="C1")
plt.show()
print(f"picture error: {rms[0]:.3f} at no phase error, {rms[1]:.3f} at p/m, {rms[-1]:.3f} at 6 p/m")
