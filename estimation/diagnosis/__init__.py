"""Diagnosis of unmodelled dynamics: which effect the nominal device omits, its size, and the updated device.

The package contains the selection of terms by evidence among fits of ``estimation.device_fit``, around which
``estimation.candidate_terms`` compares them; simulation of test data, pictures and reports do not belong here. Modules
in the order of the computation:

1. ``undriven``: recordings that no model predicts; ``unit_check``: channels in another unit or with the wrong sign;
   ``clipping``: readouts that are clipped.
2. ``from_stated_values``: fits where nominal values have absorbed a misfit.
3. ``law_selection``: laws selected, fitted and selected again; ``rival_laws``: laws to be fitted in their place;
   ``necessity``: whether they are the answer; ``pruning``: terms and amplitudes that are not required;
   ``rival_stages``: corrections of all other stages in the place of one; ``selection``: named laws, else a discrepancy,
   else nothing.
4. ``improvement``: the improved device; ``shares``: what each finding explains; ``corrected_parameters``: parameters
   beside a discrepancy; ``identifiability``: detectability of every effect; ``experiment_design``: further
   measurements; ``free_decay``: what a single decay cannot distinguish; ``held_drive``: a delay by half a sample;
   ``localisation``: channel, time and harmonics of a misfit; ``discrepancy_law``: a fitted discrepancy as curve and
   table.
5. ``finding``: an effect with its evidence and its rivals; ``diagnose``: verdict and findings.
"""
