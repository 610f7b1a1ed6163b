"""The conclusion of a reconstruction: what the picture does not show, how sharp it is, and what would improve it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

from recon.report.conclusions import MIN_USABLE_FRACTION, SHARP_FRACTION, condition_on_clock
from recon.report.numbers import format_degrees, format_uncertain

MIN_READOUT_ERROR_SD = 3.0
"""Phase error of the readout in standard deviations from which it is stated: chance exceeds it in 0.3 % of readouts."""

SIGNALS_BY_ESTIMATOR = {"sensor": "position signal is", "edges": "list of sync edges is"}
"""The signal that an estimator takes the phase from, where it is not the sense signal."""

SUFFICIENT_FILL = 0.9
"""Fraction of visited pixels below which a longer recording or fewer pixels are advised. Isolated holes up to this
number are filled from their neighbours without visible loss."""


class Displacement(NamedTuple):
    """A cause that displaces samples in the picture.

    Attributes:
        within: fraction of the scan that it displaces by no more than the tolerance.
        text: how large it is.
        advice: what reduces it, a sentence.
    """

    within: float
    text: str
    advice: str


def conclude_reconstruction(summary: Mapping[str, Any]) -> str:
    """What the picture does not show, how sharp it is, and what would improve it.

    Args:
        summary: content of summary.json.
    """
    limits = "".join(f"{limit[0].upper()}{limit[1:]}. " for limit in summary["limits"])
    subject = "The motion alone would give a picture that is" if limits else "The picture is"
    phase = _phase_displacement(summary)
    causes = [each for each in (phase, *_sample_displacements(summary)) if each.within < SHARP_FRACTION]
    verdict = _grade(min((each.within for each in causes), default=1.0))
    text = f"{limits}{_describe_readout_phase(summary)}{subject} {verdict}: "
    text += "; ".join(dict.fromkeys([each.text for each in causes] + [phase.text])) + "."
    text += "".join(f" {each.advice}" for each in causes)
    if summary["fill"] < SUFFICIENT_FILL:
        text += f" Only {summary['fill']:.0%} of the pixels were visited: record longer or choose fewer pixels."
    return text


def _grade(within: float) -> str:
    """The word for a picture of which the fraction ``within`` is displaced by no more than the tolerance."""
    return "sharp" if within >= SHARP_FRACTION else "partly blurred" if within >= MIN_USABLE_FRACTION else "blurred"


def _phase_displacement(summary: Mapping[str, Any]) -> Displacement:
    """The displacement by the error of the phase, or by its uncertainty where the truth is not known."""
    axes = summary["axes"]
    measured = all("phase_rmse_deg" in summary[axis] for axis in axes)
    key, what = ("phase_rmse_deg", "the phase error is") if measured else ("phase_sd_deg", "the phase is known to")
    errors = " and ".join(f"{format_degrees(summary[axis][key])} in {axis}" for axis in axes)
    bounds = " / ".join(sorted({f"{summary[axis]['bound_deg']:.3f}°" for axis in axes}))
    within = min(summary[axis]["within_bound"] for axis in axes)
    kind = ("rms" if measured else "1 sd") + condition_on_clock(summary)
    return Displacement(
        within,
        f"{what} {errors} ({kind}), and {within:.1%} of the scan lies within the bound of {bounds}",
        "Run lissajous diagnose on this recording to find what the device file lacks.",
    )


def _sample_displacements(summary: Mapping[str, Any]) -> list[Displacement]:
    """The displacement by what the removed motion of the sample leaves; none where no motion was estimated."""
    motion = summary["sample_motion"]
    if motion is None:
        return []
    by_axis = motion["displaced_px"].items()
    size = " and ".join(f"{px:.2g} px in {axis}" for axis, px in by_axis)
    within = min(motion["within_tolerance"].values())
    return [
        Displacement(
            within,
            f"a motion of the sample of {size} (1 sd) is left in it, so that {within:.1%} of the scan lies within the "
            f"tolerated {summary['tolerance_px']:g} px",
            "Hold the sample still, or raise the frequency of the slower axis: a motion is followed from one of its "
            "periods to the next.",
        )
    ]


def _describe_readout_phase(summary: Mapping[str, Any]) -> str:
    """A sentence on the phase error of the readout that was removed; empty where none was significant."""
    late: dict[str, list[str]] = {}
    for axis in summary["axes"]:
        error = summary[axis].get("readout_phase_deg")
        if error is not None and abs(error["value"]) > MIN_READOUT_ERROR_SD * error["sd"]:
            word = "late" if error["value"] > 0.0 else "early"
            said = f"{format_uncertain(abs(error['value']), error['sd'], '°')} {word} in {axis}"
            late.setdefault(_signal_of_axis(summary, axis), []).append(said)
    if not late:
        return ""
    signals = ", the ".join(f"{signal} {' and '.join(said)}" for signal, said in late.items())
    return f"The {signals}; the picture was used instead. "


def _signal_of_axis(summary: Mapping[str, Any], axis: str) -> str:
    """The signal of an axis's phase, and its verb; ``edges`` treats axes without edges as ``sensor`` does."""
    from_sensor = summary["estimator"] == "edges" and str(summary[axis].get("sign")).endswith(
        (f"sense_{axis}", f"angle_{axis}")
    )
    return SIGNALS_BY_ESTIMATOR.get("sensor" if from_sensor else summary["estimator"], "sense signal is")
