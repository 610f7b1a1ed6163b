"""
A first reconstruction
======================

A scan is simulated while both resonances drift. Its motion is estimated, and its picture is reconstructed and
compared with the truth.
"""

import matplotlib.pyplot as plt
import numpy as np

import lissajous

# %%
# Both combs share one sense electrode. ``simulate`` returns the recording and, separately, what only the simulation
# knows.
recording, truth = lissajous.simulate(target="siemens_star", duration=0.03, seed=7)
print(recording)

# %%
# The angles of both axes are estimated from the sense signal. Each sample of the intensity is mapped to the pixel at
# those angles.
result = lissajous.reconstruct(recording, estimator="ekf", truth=truth)
print(result.picture)

# %%
# The phase may be wrong by p/m before a sample is displaced by p pixels; m is half the width of the picture in pixels.
limit = lissajous.phase_bound(p=1, m=200)
for axis, error in result.evaluation.items():
    inside = np.mean(np.abs(error.phase) < limit)
    print(f"{axis}: phase error {np.degrees(error.phase_rmse):.3f}° rms, {inside:.1%} of the scan within ±p/m")

# %%
plt.imshow(result.picture.image, cmap="gray")
plt.title("reconstructed; white: never visited")
plt.axis("off")
plt.show()
