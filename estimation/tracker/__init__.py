"""The tracker: block demodulation, and a smoother on the slow flow of phase and amplitude."""

from estimation.tracker.track import PhaseSeen, track

__all__ = ["PhaseSeen", "track"]
