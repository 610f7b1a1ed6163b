"""Terms that a device may lack: which there are, and their evidence around a fit.

The package compares terms to first order around a fit of ``estimation.device_fit``; the choice of terms and what is
reported of them belong to ``estimation.diagnosis``. Modules in the order of the computation:

1. ``anchor``: a fit that follows the motion.
2. ``discrepancy``: flexible terms for effects without a law.
3. ``screening``: sensitivities to every candidate term.
4. ``linear_model``: named laws beside a discrepancy, compared by evidence; ``linearisation``: that model around a fit,
   and fits from it; ``significance``: the evidence from which a term counts.
"""
