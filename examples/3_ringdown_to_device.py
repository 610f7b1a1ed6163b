"""
From ringdown to device
=======================

The mirror is released under a DC bias and rings down; a position detector and the current of the comb are recorded.
The nominal values of resonance, damping and comb are replaced by measured ones with their uncertainty.
"""

from dataclasses import replace

import matplotlib.pyplot as plt
import numpy as np

import lissajous
from phantoms.forward import InitialState, Plan, simulate
from phantoms.waveforms import Constant

# %%
# The true mirror is stiffer than the nominal one by 0.5 %, and its damping is 8 % larger.
nominal = lissajous.load_device("chen2019")
axis = nominal.axis("x")
mechanics = axis.mechanics
true = replace(axis, mechanics=replace(mechanics, k=1.005 * mechanics.k, b=1.08 * mechanics.b))
plan = Plan({"x": Constant(10.0)}, duration=0.08, sample_rate=200e3, references=("angle",))
clean, _ = simulate(replace(nominal, axes={"x": true}), plan, seed=1, start={"x": InitialState(0.15, 0.0)})

# %%
# The position detector has a noise of 0.2 mrad. A constant voltage is a bias, not a drive.
angle, sense = clean["angle_x"], clean["sense_x"]
noisy = angle.read() + 2e-4 * np.random.default_rng(2).standard_normal(angle.size)
channels = {
    "angle_x": (noisy, "rad", angle.sample_rate, angle.start),
    "sense_x": (sense.read(), "V", sense.sample_rate, sense.start),
    "bias_x": (np.full(angle.size, 10.0), "V", angle.sample_rate, angle.start),
}
found = lissajous.identify(lissajous.Recording.from_arrays(channels, nominal, name="ringdown"))

# %%
figure, (top, bottom) = plt.subplots(2, 1, sharex=True, layout="constrained")
time = 1e3 * np.arange(angle.size) / angle.sample_rate
top.plot(time, noisy, lw=0.6)
top.set_ylabel("angle (rad)")
bottom.plot(time, sense.read(), lw=0.4)
bottom.set(xlabel="time (ms)", ylabel="comb's current, amplified (V)")
plt.show()

# %%
# The identified device replaces the nominal one. Its tolerances are the standard deviations of the identified values.
for name, value in found.values["x"].items():
    print(f"{name:10} {value.value:.6g} ({value.ci95[0]:.6g} to {value.ci95[1]:.6g})")
resonances = [state.resonance for state in (axis, found.device.axis("x"), true)]
print("resonance: nominal {:.2f} Hz, found {:.2f} Hz, true {:.2f} Hz".format(*resonances))
print(*found.notes, sep="\n")
