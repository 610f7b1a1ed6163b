"""
Three estimators and the tracker
================================

One recording, both mirrors drifting: a constant phase as calibrated, the extended and the unscented Kalman filter of
chen2020, and the tracker, which smooths the slow phase and amplitude under the resonator's averaged equations.
"""

import matplotlib.pyplot as plt
import numpy as np

from estimation.estimate import estimate
from phantoms.experiment import Experiment, run
from recon.blur import bound
from recon.score import axis_error, told_truth

recording, told = run(Experiment(duration=0.02), seed=3)
truth = told_truth(told)
motions = {method: estimate(recording, method=method) for method in ("constant", "ekf", "ukf", "tracker")}

# %%
# The truth comes in here and not before: no estimator reads it.
limit = np.degrees(bound(p=1.0, m=200))
figure, panels = plt.subplots(2, 1, sharex=True, layout="constrained")
for axis, panel in zip("xy", panels, strict=True):
    for method, motion in motions.items():
        error = axis_error(motion.axes[axis], *truth.angles[axis])
        panel.plot(1e3 * error.time, np.degrees(error.phase), lw=1.0, label=method)
        print(f"{axis} {method:9} phase error {np.degrees(error.phase_rmse):.4f}° rms, bound {limit:.3f}°")
    panel.axhspan(-limit, limit, color="0.9")
    panel.set(ylabel=f"phase error of {axis} (°)", ylim=(-3 * limit, 3 * limit))
panels[0].legend(ncols=4, fontsize="small")
panels[1].set_xlabel("time (ms); grey: within ±p/m for 400 pixels")
plt.show()

# %%
# What an estimator says of itself counts as much: the tracker's standard deviation beside its error.
for axis in "xy":
    track = motions["tracker"].axes[axis]
    error = axis_error(track, *truth.angles[axis])
    said = np.degrees(np.sqrt(np.mean(track.phase_sd**2)))
    print(f"{axis}: the tracker says {said:.4f}°, and is off by {np.degrees(error.phase_rmse):.4f}°")
