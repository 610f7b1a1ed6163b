"""
Three estimators and the tracker
================================

One recording while both resonances drift: a constant phase, the extended and the unscented Kalman filter of chen2020,
and the tracker, which smooths phase and amplitude under the averaged equations of the resonator.
"""

import matplotlib.pyplot as plt
import numpy as np

import lissajous

recording, truth = lissajous.simulate(duration=0.02, seed=3)
results = {
    estimator: lissajous.reconstruct(recording, estimator=estimator, truth=truth)
    for estimator in ("constant", "ekf", "ukf", "tracker")
}

# %%
# Phase errors against the truth, which no estimator reads.
limit = np.degrees(lissajous.phase_bound(p=1.0, m=200))
figure, panels = plt.subplots(2, 1, sharex=True, layout="constrained")
for axis, panel in zip("xy", panels, strict=True):
    for estimator, result in results.items():
        error = result.evaluation[axis]
        panel.plot(1e3 * error.time, np.degrees(error.phase), lw=1.0, label=estimator)
        print(f"{axis} {estimator:9} phase error {np.degrees(error.phase_rmse):.4f}° rms, bound {limit:.3f}°")
    panel.axhspan(-limit, limit, color="0.9")
    panel.set(ylabel=f"phase error of {axis} (°)", ylim=(-3 * limit, 3 * limit))
panels[0].legend(ncols=4, fontsize="small")
panels[1].set_xlabel("time (ms); grey: within ±p/m for 400 pixels")
plt.show()

# %%
# An estimator also states its uncertainty: the standard deviation of the tracker beside its true error.
for axis in "xy":
    stated = np.degrees(np.sqrt(np.mean(results["tracker"].motion.axes[axis].phase_sd ** 2)))
    error = np.degrees(results["tracker"].evaluation[axis].phase_rmse)
    print(f"{axis}: the tracker states {stated:.4f}°, its error is {error:.4f}°")
