"""Rigid motion of the sample during a scan: translation, jumps and vibrations, and its correction."""
