"""Diagnosis of unmodelled dynamics: which effect the nominal device omits, its size, and the updated device.

The package contains the fit of the forward model to recordings and the selection of terms by evidence; simulation of
test data, pictures and reports do not belong here. Modules in the order of the computation:

1. ``data``: recorded inputs and outputs on the grids of the simulation; ``drive_lines``: spectral lines of a drive;
   ``resampling``; ``clipping``: readouts that are clipped.
2. ``model``: simulated channels as a function of ``parameters``; ``noise``: noise spectrum and whitening; ``mains`` and
   ``hum``: hum as part of the noise; ``interference``: tones that are neither motion nor drive.
3. ``fit``: whitened residuals, Jacobian and fit; ``initial``: initial state and growing windows.
4. ``discrepancy``: flexible terms for effects without a law; ``anchor``: a fit that follows the motion.
5. ``screening``: sensitivities to every candidate term; ``linear_model``: named laws beside a discrepancy, compared by
   evidence; ``linearisation``: that model around a fit, and fits from it; ``law_selection``: laws selected, fitted and
   selected again; ``pruning``: terms and amplitudes that are not required; ``significance``; ``selection``: named laws,
   else a discrepancy, else nothing.
6. ``profile_likelihood``: intervals; ``localisation``: channel, time and harmonics of a misfit;
   ``identifiability``: detectability of every effect; ``experiment_design``: further measurements.
7. ``discrepancy_law``, ``effect_curve``, ``posterior``: a fitted effect as formula, curve and draws.
8. ``open_loop``: prediction error of a device; ``improvement``: the improved device; ``shares``: what each finding
   explains; ``diagnose``: verdict and findings; ``predict``: prediction of a recording.
"""
