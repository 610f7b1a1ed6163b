"""Simulate a drifting scan, estimate its motion, reconstruct the picture, score it: the whole pipeline in a page."""

import numpy as np

from estimation.estimate import estimate
from phantoms.experiment import Experiment, run
from recon.blur import bound, picture_error, within_bound
from recon.mapping import Grid, map_samples
from recon.score import axis_error

recording, truth = run(Experiment(target="siemens_star", duration=0.03), seed=7)
motion = estimate(recording, method="ekf")
grid = Grid(400, 400, recording.device.scan.half_angle_x, recording.device.scan.half_angle_y)
x, y = (motion.axes[axis].angle.values for axis in "xy")
picture = map_samples(x, y, recording["intensity"].read(), grid)
errors = {axis: axis_error(motion.axes[axis], truth[f"angle_{axis}"][0].astype(float), 5e6, 0.0) for axis in "xy"}
for axis, error in errors.items():
    inside = within_bound(bound(p=1, m=200), error=error.phase)
    print(f"{axis}: phase error {np.degrees(error.phase_rmse):.3f}° rms, {inside:.1%} of the scan within ±p/m")
print(picture_error(picture, truth["scene"], errors["x"].mirrored, errors["y"].mirrored))
