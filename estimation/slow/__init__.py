"""Diagnosis of slow data: the amplitude of a free decay, from a lock-in, an envelope detector or a waveform."""
