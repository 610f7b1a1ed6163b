"""Diagnosis of unmodelled dynamics: which effect the nominal device omits, its size, and the updated device.

The package contains the selection of terms by evidence among fits of ``estimation.device_fit``; simulation of test
data, pictures and reports do not belong here. Modules in the order of the computation:

1. ``clipping``: readouts that are clipped; ``structure``: further modes of the structure.
2. ``discrepancy``: flexible terms for effects without a law; ``anchor``: a fit that follows the motion.
3. ``screening``: sensitivities to every candidate term; ``linear_model``: named laws beside a discrepancy, compared by
   evidence; ``linearisation``: that model around a fit, and fits from it; ``law_selection``: laws selected, fitted and
   selected again; ``pruning``: terms and amplitudes that are not required; ``significance``; ``selection``: named laws,
   else a discrepancy, else nothing.
4. ``localisation``: channel, time and harmonics of a misfit; ``free_decay``: what one decay cannot tell apart;
   ``identifiability``: detectability of every effect; ``experiment_design``: further measurements;
   ``corrected_parameters``: parameters beside a discrepancy.
5. ``discrepancy_law``, ``effect_curve``: a fitted effect as formula and curve.
6. ``improvement``: the improved device; ``shares``: what each finding explains; ``diagnose``: verdict and findings.
"""
