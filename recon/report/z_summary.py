"""The figures of z for summary.json: slices of a stack, and the position along the beam."""

from __future__ import annotations

from typing import Any

import numpy as np

from recon.imaging.frame_axis import position_axis
from recon.steps.reconstruction import Reconstruction
from recon.steps.z_rests import cut_to_intensity, read_blocks
from recon.steps.z_slices import ZSlices
from scanner.errors import BadInput


def stack_summary(slices: ZSlices | None) -> dict[str, Any] | None:
    """Positions and samples of the slices of a stack; None without one."""
    if slices is None:
        return None
    axis = position_axis(slices.positions)
    return {
        "z_m": list(axis.values),
        "step_m": axis.step,
        "even": axis.even,
        "samples": list(slices.samples),
    }


def position_summary(result: Reconstruction) -> dict[str, float] | None:
    """Mean and range of z during the intensity; None where it was not recorded or is nowhere known."""
    if result.position_z is None:
        return None
    try:
        blocks = read_blocks(cut_to_intensity(result.position_z, result.intensity))
    except BadInput:
        return None
    return {
        "mean_m": float(np.nanmean(blocks.mean)),
        "range_m": 0.0 if blocks.constant else float(blocks.most - blocks.least),
    }
