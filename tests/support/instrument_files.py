"""Text files as instruments write them, and what a reader states about a file."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from recon.io.readers import read

TEKTRONIX = """\
Model,MDO4014B-3
Firmware Version,3.22

Horizontal Units,s
Sample Interval,4e-10
Record Length,3
Vertical Units,V,mV
Label,,
TIME,CH2,CH3
-4.0000000e-03,3.34,1
-3.9999996e-03,3.3,2
-3.9999992e-03,3.28,3
"""
"""A table of a Tektronix oscilloscope with its clock in the header."""


def write_text(path: Path, content: str) -> Path:
    """Write ``content`` to ``path`` and return it."""
    path.write_text(content)
    return path


def stated_metadata(path: Path) -> dict[str, tuple]:
    """Variable -> unit, sample rate, start and the first two samples, as the file states them."""
    contents = read(path)
    try:
        return {
            name: (v.unit, v.sample_rate, v.start, list(np.ravel(v.raw[:2]))) for name, v in contents.variables.items()
        }
    finally:
        contents.close()
