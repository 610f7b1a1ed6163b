"""
A first reconstruction
======================

A scan is simulated while both resonances drift; its motion is estimated, its picture reconstructed and scored.
"""

import matplotlib.pyplot as plt
import numpy as np

from estimation.estimate import estimate
from phantoms.experiment import Experiment, run
from recon.blur import bound, picture_error, within_bound
from recon.mapping import Grid, map_samples
from recon.score import axis_error

# %%
# Both combs share one sense electrode. ``run`` gives the recording and, apart from it, what only a simulation knows.
recording, truth = run(Experiment(target="siemens_star", duration=0.03), seed=7)
print(*recording.channels)

# %%
# The angles of both axes come from the sense signal alone; each sample of the light goes to the pixel that they name.
motion = estimate(recording, method="ekf")
scan = recording.device.scan
grid = Grid(400, 400, scan.half_angle_x, scan.half_angle_y)
x, y = (motion.axes[axis].angle.values for axis in "xy")
picture = map_samples(x, y, recording["intensity"].read(), grid)

# %%
# The phase may err by p/m before a sample lands p pixels off, m being half the picture's width in pixels.
errors = {axis: axis_error(motion.axes[axis], truth[f"angle_{axis}"][0].astype(float), 5e6, 0.0) for axis in "xy"}
for axis, error in errors.items():
    inside = within_bound(bound(p=1, m=200), error=error.phase)
    print(f"{axis}: phase error {np.degrees(error.phase_rmse):.3f}° rms, {inside:.1%} of the scan within ±p/m")
print(picture_error(picture, truth["scene"], errors["x"].mirrored, errors["y"].mirrored))

# %%
plt.imshow(picture.image, cmap="gray")
plt.title("reconstructed; white: never visited")
plt.axis("off")
plt.show()
