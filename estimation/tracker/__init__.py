"""The tracker: phase and amplitude of a resonant motion, by block demodulation and Kalman smoothing.

The motion of a resonant mirror is a sine whose phase and amplitude change slowly. The tracker estimates both from the
sense signal, with standard deviations close to the posterior Cramér-Rao bound. docs/explanation/tracker.md explains it.
It must not import the simulator (``phantoms``) or anything of ``recon``, and reads nothing of a recording but sense,
bias and drive channels.

Reading guide, in the order of the data:

Measurements
    ``demodulation`` projects blocks of samples on the harmonics of the axes; ``change_points`` finds where a drive
    switches; ``drive_blocks`` demodulates a drive. ``observations`` joins them for a sense channel into a
    ``block_signal``, with the noise of the channel from ``line_noise``. ``clipping`` adds the information of clipped
    samples. ``drive_ends`` extends a drive that was recorded for a part of the time; ``drive_consistency`` finds pauses
    of a drive that the motion contradicts.
Model
    ``averaged_dynamics`` gives the rates of phase and amplitude by harmonic balance; ``state_space`` propagates state
    and covariance between blocks; ``linearisation`` linearises the expected projections.
Estimation
    ``kalman_filter`` (forward) and ``rts_smoother`` (backward) are compiled; ``filter_run`` calls them.
    ``process_noise`` tunes the drift's spectral densities; ``initial_state`` provides the first estimate, with the
    amplitude from ``amplitude_table``, and the signs; ``phase_measurements`` adds phases from the picture.
    ``block_tracking`` joins them to tracks. ``readout_curve`` measures a curved characteristic of the readout.
Result
    ``track`` runs everything over a recording, section by section, and ``continuation`` continues it in the next
    segment; ``to_motion`` and ``angle_synthesis`` make the angle at any sample. ``drive_only`` is the same for an axis
    without a sense signal, from its ``steady_motion`` under the drive.
Reference
    ``cramer_rao`` computes the bound of an ideal estimator.
"""

from estimation.tracker.phase_measurements import PhaseMeasurement
from estimation.tracker.track import track, track_end

__all__ = ["PhaseMeasurement", "track", "track_end"]
