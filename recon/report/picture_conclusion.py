"""The conclusion of a reconstruction: what the picture does not show, how sharp it is, and what would improve it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from recon.imaging.blur import SHARP_FRACTION
from recon.imaging.scan_phase.readout_phase import REPORTED_SDS
from recon.report.conclusions import MIN_USABLE_FRACTION, condition_on_clock
from recon.report.numbers import format_degrees, format_uncertain
from scanner.wording import sentence

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
    limits = "".join(f"{sentence(limit)} " for limit in summary["limits"])
    text = f"{limits}{_describe_readout_phase(summary)}"
    if _is_readout_unchecked(summary):
        causes = [each for each in _sample_displacements(summary) if each.within < SHARP_FRACTION]
        text += _describe_sharpness(causes, bool(limits)) + " " if causes else ""
        text += _describe_unchecked_readout(summary, bool(limits or causes))
    else:
        text += _describe_sharpness([_phase_displacement(summary), *_sample_displacements(summary)], bool(limits))
    if summary["fill"] < SUFFICIENT_FILL:
        text += f" Only {summary['fill']:.0%} of the pixels were visited: record longer or choose fewer pixels."
    return text


def _describe_sharpness(causes: Sequence[Displacement], limited: bool) -> str:
    """How sharp the picture is, by which cause, and what would make it sharper.

    Args:
        causes: of which the first is stated in any case, the others only if they blur.
        limited: whether the picture does not show the scene, so that this is said of the motion alone.
    """
    blurring = [each for each in causes if each.within < SHARP_FRACTION]
    verdict = _grade(min(each.within for each in causes))
    subject = "The motion alone would give a picture that is" if limited else "The picture is"
    reasons = "; ".join(dict.fromkeys(each.text for each in (*blurring, causes[0])))
    return f"{subject} {verdict}: {reasons}." + "".join(f" {each.advice}" for each in blurring)


def _grade(within: float) -> str:
    """The word for a picture of which the fraction ``within`` is displaced by no more than the tolerance."""
    return "sharp" if within >= SHARP_FRACTION else "partly blurred" if within >= MIN_USABLE_FRACTION else "blurred"


def _is_readout_unchecked(summary: Mapping[str, Any]) -> bool:
    """Whether only the uncertainty of the readout's phase leaves a part of the scan outside the bound.

    It is no evidence of a blur: the recording did not measure the phase of the readout that precisely. A doubted clock
    of the intensity is.
    """
    axes = [summary[axis] for axis in summary["axes"]]
    has_other_evidence = _is_truth_known(summary) or summary["clock_doubted"]
    if has_other_evidence or any(axis["readout_as_stated"] is None for axis in axes):
        return False
    as_stated = min(axis["readout_as_stated"]["within_bound"] for axis in axes)
    return as_stated >= SHARP_FRACTION > min(axis["within_bound"] for axis in axes)


def _describe_unchecked_readout(summary: Mapping[str, Any], blurred: bool) -> str:
    """What is not known of the readout's phase, what was assumed of it, and what settles it.

    Args:
        summary: content of summary.json.
        blurred: whether the picture has another defect, stated before.
    """
    axes = {axis: summary[axis] for axis in summary["axes"] if summary[axis]["within_bound"] < SHARP_FRACTION}
    as_stated = {axis: each["readout_as_stated"] for axis, each in axes.items()}
    assumed = [axis for axis, each in as_stated.items() if each["assumed_delay_us"] is not None]
    bounds = " / ".join(sorted({f"{each['bound_deg']:.3f}°" for each in axes.values()}))
    reasons = []
    if assumed:
        delay = max(as_stated[axis]["assumed_delay_us"] for axis in assumed)
        reasons.append(
            f"the picture determines no phase of {' and '.join(assumed)}, and a readout delay of {delay:g} µs (1 sd) "
            "that the device file does not state was assumed"
        )
    reasons += [f"the picture determines the phase of {axis} less precisely" for axis in axes if axis not in assumed]
    subject = "The" if blurred or assumed else "No blur was found, but the"  # where nothing was measured, none can be
    return (
        f"{subject} phase could not be checked to within the bound of "
        f"{bounds}: {'; '.join(reasons)}. The phase is thus known to {_list_sd(axes)} (1 sd), with a probability of "
        f"{min(each['within_bound'] for each in axes.values()):.1%} within the bound; with the readout exactly as "
        f"stated, to {_list_sd(as_stated)}. To settle it, record a scene with detail in both directions, more light or "
        "a longer scan; or, if the delay of the readout was measured and the device file states it, add --sense-only."
    )


def _list_sd(axes: Mapping[str, Mapping[str, float]]) -> str:
    """Standard deviation of the phase of each axis, in words."""
    return " and ".join(f"{format_degrees(each['phase_sd_deg'])} in {axis}" for axis, each in axes.items())


def _is_truth_known(summary: Mapping[str, Any]) -> bool:
    """Whether the error of the phase is known, as of a simulation."""
    return all("phase_rmse_deg" in summary[axis] for axis in summary["axes"])


def _phase_displacement(summary: Mapping[str, Any]) -> Displacement:
    """The displacement by the error of the phase, or by its uncertainty where the truth is not known."""
    axes = summary["axes"]
    measured = _is_truth_known(summary)
    key, what = ("phase_rmse_deg", "the phase error is") if measured else ("phase_sd_deg", "the phase is known to")
    errors = " and ".join(f"{format_degrees(summary[axis][key])} in {axis}" for axis in axes)
    bounds = " / ".join(sorted({f"{summary[axis]['bound_deg']:.3f}°" for axis in axes}))
    within = min(summary[axis]["within_bound"] for axis in axes)
    kind = ("rms" if measured else "1 sd") + condition_on_clock(summary)
    outside = {axis: summary[axis]["blur_px"] for axis in axes if summary[axis]["within_bound"] < SHARP_FRACTION}
    noise = {axis: blur["sensor"] for axis, blur in outside.items() if blur["sensor"] > blur["phase"]}
    if noise:
        sizes = " and ".join(f"{px:.2g} px in {axis}" for axis, px in noise.items())
        return Displacement(
            within,
            f"the noise of the position signals moves single samples by {sizes} (1 sd), so that {within:.1%} of the "
            f"scan lies within the tolerated {summary['tolerance_px']:g} px; {what} {errors} ({kind})",
            "Use --estimator tracker, which follows the motion through the noise; it needs the drives and [mechanics] "
            "in the device file.",
        )
    advice = "Run lissajous diagnose on this recording to find what the device file lacks."
    if summary["estimator"] == "constant":
        advice = "Use --estimator tracker, which follows the drift of the phase."
    return Displacement(
        within, f"{what} {errors} ({kind}), and {within:.1%} of the scan lies within the bound of {bounds}", advice
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
    delay = summary["readout_delay_us"]
    if delay is not None and delay["value"] < 0.0:
        errors = (summary[axis]["readout_phase_deg"] for axis in summary["axes"])
        sizes = (format_uncertain(abs(error["value"]), error["sd"], "°") for error in errors)
        by_axis = " and ".join(f"{size} in {axis}" for axis, size in zip(summary["axes"], sizes, strict=True))
        return (
            f"The intensity is {format_uncertain(-delay['value'], delay['sd'], 'µs')} late against the signals of both "
            f"axes (detector, amplifier, or start of the channel). This explains the phase errors of {by_axis}, "
            "which the picture corrected. Run lissajous diagnose on this recording to find the cause. "
        )
    late: dict[str, list[str]] = {}
    for axis in summary["axes"]:
        error = summary[axis].get("readout_phase_deg")
        if error is not None and abs(error["value"]) > REPORTED_SDS * error["sd"]:
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
