"""The report's account of the phase error of an open-loop prediction: blur of a picture, or degrees without a field."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from estimation.device_fit.posterior import PredictionPhaseError
from recon.report.diagnosis_figures import AFTER, BEFORE, PAIR, one_panel
from recon.report.figures import use_plain_ticks
from recon.report.numbers import format_value
from recon.report.page import Figure, Section, Table
from scanner.arrays import Array
from scanner.device import Device
from scanner.motion import in_proportion_to_amplitude, rms_phase

if TYPE_CHECKING:
    from matplotlib.axes import Axes

PICTURE_HALF_WIDTH_PX = 200
"""Pixels from the middle of a line to its end, in a picture of 400 pixels."""

TOLERATED_BLUR_PX = 1.0
"""Blur that is marked as tolerated: the default of ``--p``."""

MIN_DRAWN = 1e-3
"""Errors below this value of their unit are drawn at it, because a logarithmic axis has no zero."""


@dataclass(frozen=True)
class PhaseErrorScale:
    """How a report states a phase error.

    Attributes:
        factor: from rad to the stated unit.
        quantity, unit: for titles and axes.
        tolerated: value that is marked in the figure; None marks none.
        explanation: of the quantity, a sentence.
        sentence: of the conclusion; the rms error stands at ``{}``.
    """

    factor: float
    quantity: str
    unit: str
    tolerated: float | None
    explanation: str
    sentence: str

    def rms(self, phase: Array, amplitude: Array) -> float:
        """Return the root mean square of a phase error, weighted with the squared amplitude, in the stated unit.

        Args:
            phase: errors, shape (n,) [rad].
            amplitude: of the motion, shape (n,) [rad].
        """
        return self.factor * rms_phase(phase, amplitude)


PICTURE_SCALE = PhaseErrorScale(
    PICTURE_HALF_WIDTH_PX,
    "blur at the centre of a line",
    "pixels",
    TOLERATED_BLUR_PX,
    f"A phase error δφ displaces the centre of a line by m δφ pixels, with m = {PICTURE_HALF_WIDTH_PX} in a picture of "
    f"{2 * PICTURE_HALF_WIDTH_PX} pixels.",
    "the nominal motion is wrong by {} px rms in a picture of " + f"{2 * PICTURE_HALF_WIDTH_PX} pixels",
)
"""For a device with a field of view."""

ANGLE_SCALE = PhaseErrorScale(
    float(np.degrees(1.0)),
    "phase error",
    "degrees",
    None,
    "The device states no field of view, so that the error is given as a phase.",
    "the phase of the nominal motion is wrong by {}° rms",
)
"""For a device without one."""


def scale_for(device: Device) -> PhaseErrorScale:
    """The scale of a device's phase errors: pixels if it has a field of view, degrees otherwise."""
    return ANGLE_SCALE if device.scan is None else PICTURE_SCALE


def describe_largest_error(errors: Mapping[str, PredictionPhaseError], scale: PhaseErrorScale) -> str:
    """A sentence on the largest phase error of the nominal device that exceeds its uncertainty; empty without one."""
    sizes = [(scale.rms(e.before, e.amplitude), scale.rms(e.after, e.amplitude)) for e in errors.values()]
    exceeding = [before for before, after in sizes if before > after]
    if not exceeding:
        return ""
    return f"Predicted from the drive alone, {scale.sentence.format(format_value(max(exceeding), 2))}."


def prediction_phase_section(errors: Mapping[str, PredictionPhaseError], scale: PhaseErrorScale) -> Section:
    """Phase errors of the nominal device, and the uncertainty of that with the findings, over time."""
    heading = "Phase of a prediction without feedback"
    if not errors:
        return Section(heading, "The axis is driven far below its resonance and follows its drive: no phase to lose.")
    text = (
        f"{scale.explanation} Errors count in proportion to the amplitude: where the mirror nearly rests, they "
        "displace nothing. First the motion that the nominal device with fitted values predicts from the drive alone, "
        "against that of the device with the findings; then the 95 % limit of the uncertainty of this device's phase."
    )
    rows = [
        [name, *(format_value(scale.rms(phase, e.amplitude), 2) for phase in (e.before, e.after))]
        for name, e in errors.items()
    ]
    table = Table([f"rms {scale.quantity} ({scale.unit})", *(label for _, label in PAIR)], rows)
    figures = [phase_error_figure(error, f"{name}: {scale.quantity}", scale) for name, error in errors.items()]
    return Section(heading, text, table, figures, least="24rem")


def phase_error_figure(error: PredictionPhaseError, caption: str, scale: PhaseErrorScale) -> Figure:
    """Phase error of an open-loop prediction over time."""

    def draw(axes: Axes) -> None:
        for phase, colour, label in (
            (error.before, BEFORE, PAIR[0][1]),
            (error.after, AFTER, f"{PAIR[1][1]}, 95 % limit"),
        ):
            value = scale.factor * np.abs(in_proportion_to_amplitude(phase, error.amplitude))
            axes.plot(1e3 * error.time, np.maximum(value, MIN_DRAWN), color=colour, label=label)
        if scale.tolerated is not None:
            label = f"tolerated, {scale.tolerated:g} {scale.unit}"
            axes.axhline(scale.tolerated, color="#444", lw=0.8, ls="--", label=label)
        axes.set(xlabel="time (ms)", ylabel=f"{scale.quantity} ({scale.unit})", yscale="log")
        use_plain_ticks(axes.yaxis)
        axes.legend(frameon=False, ncols=2, loc="lower left", bbox_to_anchor=(0.0, 1.0), fontsize=8)

    return one_panel(draw, caption)
