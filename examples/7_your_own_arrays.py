"""
Your own arrays
===============

Arrays in memory become a picture: no file is written. The arrays here come from a simulation of an electromagnetic
mirror with position detectors; replace them by your own.
"""

from pathlib import Path
from tempfile import TemporaryDirectory

import matplotlib.pyplot as plt
import numpy as np

import lissajous
from lissajous import Device

# %%
# A device file describes the scanner. ``lissajous new-device`` writes one to edit; here the text stands in the program.
device = Device.from_toml("""
name = "my mirror"
[x.readout]
kind = "position"       # V = gain theta
gain = 20.0             # V / rad
noise_sd = 2.0e-3       # V
[y.readout]
kind = "position"
gain = 20.0
noise_sd = 2.0e-3
[scan]
half_angle_x = 0.08     # rad, half the field of view
half_angle_y = 0.08
""")

# %%
# Three arrays of one sample rate: the two detector voltages and the intensity.
rate = 1e6
time = np.arange(300_000) / rate
theta_x, theta_y = 0.08 * np.sin(2 * np.pi * 2003.0 * time), 0.08 * np.sin(2 * np.pi * 837.0 * time + 0.4)
scene = lissajous.simulate(target="siemens_star", duration=0.001, seed=1).truth["scene"]
row, column = (np.clip((0.5 * (angle / 0.08 + 1) * 1599).astype(int), 0, 1599) for angle in (theta_y, theta_x))
rng = np.random.default_rng(2)
volts_x, volts_y = (20.0 * angle + rng.normal(0.0, 2e-3, time.size) for angle in (theta_x, theta_y))
light = rng.poisson(200.0 * scene[row, column]).astype(float)

# %%
# Arrays are given by the name of their channel, in SI units. An array with a rate, a unit or a start of its own is a
# tuple (values, unit, rate, start).
arrays = {"sense_x": volts_x, "sense_y": volts_y, "intensity": light}
result = lissajous.reconstruct(arrays, device, sample_rate=rate, pixels=(200, 200))
print(result.picture)
for axis, motion in result.motion.axes.items():
    print(f"{axis}: {np.median(motion.frequency):.2f} Hz, amplitude {np.median(motion.amplitude):.4f} rad")

# %%
# ``result.picture.image`` is an array: NaN where the beam never was. ``napari.view_image(result.picture.image)`` shows
# it in napari.
plt.imshow(result.picture.image, cmap="gray")
plt.title("reconstructed; white: never visited")
plt.axis("off")
plt.show()

# %%
# The same arrays as a recording file, for the command line.
with TemporaryDirectory() as folder:
    path = Path(folder) / "scan.h5"
    channels = {name: (values, "V", rate) for name, values in arrays.items()}
    lissajous.Recording.from_arrays(channels, device).write(path)
    print(lissajous.Recording.open(path))
