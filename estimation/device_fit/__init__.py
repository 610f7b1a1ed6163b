"""Fit of a device with effects to the samples of recordings.

The device is played through the forward model with the recorded drive; its constants, effects, initial state and noise
spectrum are estimated by regularised least squares. Which effects a device has is decided in ``estimation.diagnosis``.
Modules in the order of the computation:

1. ``data``: recorded inputs and outputs on the grids of the simulation; ``drive_lines``: spectral lines of a drive;
   ``resampling``.
2. ``model``: simulated channels as a function of ``parameters``; ``trajectory_cache``: motions that are kept;
   ``noise``: noise spectrum and whitening; ``mains`` and ``hum``: hum as part of the noise; ``interference``: tones
   that are neither motion nor drive.
3. ``fit``: whitened residuals, Jacobian and fit; ``initial``: initial state and growing windows; ``deviations``:
   whether fitted values are probable; ``slow_noise``: noise that rises more steeply than its measured spectrum.
4. ``profile_likelihood``: intervals; ``posterior``: draws.
5. ``open_loop``: prediction error of a device; ``predict``: prediction of a recording; ``further_modes``: modes that
   the drive excites beside the mirror's own.
"""
