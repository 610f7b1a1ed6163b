"""One sentence, or a few, that say what a command found and what to do about it: the start of reports and summaries.

Every function takes the content of the command's JSON file.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from recon.imaging.blur import SHARP_FRACTION
from recon.imaging.frame_axis import format_positions
from recon.report.numbers import format_degrees, format_value
from scanner.wording import counted, percent, sentence

MIN_USABLE_FRACTION = 0.5
"""Fraction of the scan within the bound below which a picture is called blurred, and no estimator is recommended: most
samples are then in a wrong pixel."""

PICTURES_LISTED = 4
"""Pictures of many that the conclusion names; the page lists all."""


def condition_on_clock(summary: Mapping[str, Any]) -> str:
    """The condition on which standard deviations of the phase hold, for a list in brackets; empty without a doubt."""
    return ", if the sample rate of the intensity is right" if summary["clock_doubted"] else ""


def describe_slices(measured: Mapping[str, Any]) -> str:
    """What the slices of the scan show beside the mean of their phase errors; empty where they agree."""
    scatter = measured["scatter"]
    return f" (mean; slices of the scan differ by {scatter:.2g}°, 1 sd)" if scatter else ""


def describe_stack(stack: Mapping[str, Any]) -> str:
    """Number of the slices, their spacing and their range; ``stack`` is an entry of the summary."""
    if stack["z_m"] is None:
        return f"stack of {len(stack['recordings'])} repeats in the order given"
    z = format_positions(stack["z_m"])
    if len(z) == 1:
        return f"stack of a single slice at z = {z[0]} µm"
    uneven = "" if stack["even"] else " in the mean, unevenly spaced"
    return f"stack of {len(z)} slices {1e6 * stack['step_m']:.4g} µm apart{uneven}, from z = {z[0]} µm to {z[-1]} µm"


def conclude_plan(content: Mapping[str, Any]) -> str:
    """How many effects planned recordings could identify."""
    effects = content["effects"]
    separable = sum(effect["distance"] >= content["apart"] for effect in effects)
    text = f"These recordings could identify {separable} of {len(effects)} effects of typical size unambiguously."
    if separable < len(effects):
        text += " The others need a further excitation or channel, listed below."
    return text


def conclude_identification(summary: Mapping[str, Any]) -> str:
    """How many constants were measured, the least certain of them, and whether a linear law holds."""
    values = {f"{axis}.{name}": v for axis, r in summary["axes"].items() for name, v in r["values"].items()}
    relative = {name: v["sd"] / abs(v["value"]) for name, v in values.items() if v["value"] and v["sd"]}
    text = f"{counted(len(values), 'constant')} of {summary['device']} measured"
    if relative:
        worst = max(relative, key=lambda name: relative[name])
        text += f", the least certain {worst} to {percent(relative[worst])}"
    if summary["nonlinear"]:
        axes = " and ".join(summary["nonlinear"])
        return (
            f"{text}. They hold for no amplitude exactly, because the law of {axes} is not linear or changed during a "
            "recording. Run lissajous diagnose to find the law."
        )
    return text + ". Use device.toml in place of the nominal device."


def conclude_prediction(summary: Mapping[str, Any]) -> str:
    """How well the device predicts the channels from the drive alone."""
    channels = summary["channels"]
    if not channels:
        return "The recording has no channel that the device predicts."
    worst = max(channels, key=lambda name: channels[name]["nrmse"])
    channel = channels[worst]
    if channel["nrmse"] >= 1.0:
        return (
            f"From the drive alone {summary['device']} does not predict {worst}: they differ by {channel['nrmse']:.2g} "
            "times the signal, no less than without a prediction. Check sign, unit and axis of the channel, then run "
            "lissajous diagnose to find what the device lacks."
        )
    text = (
        f"From the drive alone {summary['device']} predicts "
        + {1: "the channel", 2: "both channels"}.get(len(channels), f"all {len(channels)} channels")
        + f" with an error of {percent(channel['nrmse'])} of the signal{' or less' if len(channels) > 1 else ''} "
        + f"({f'largest in {worst}' if len(channels) > 1 else worst}, "
        f"{format_value(channel['rmse'], 3)} {channel['unit']} rms)"
    )
    if channel["noise_sd"] and channel["rmse"] > 1.5 * channel["noise_sd"]:
        ratio = format_value(channel["rmse"] / channel["noise_sd"], 2)
        advice = "" if summary["terms"] else " Run lissajous diagnose to find what the device lacks."
        return f"{text}, {ratio} times its noise.{advice}"
    return text + "."


def conclude_design(summary: Mapping[str, Any]) -> str:
    """The drive frequencies to use, and the fill that they reach."""
    best, fill = summary["candidates"][0], summary["wanted"]["fill"]
    drive = best["drive_hz"]
    text = (
        f"Drive x at {drive['x']:.4f} Hz and y at {drive['y']:.4f} Hz: {best['frame_rate']:.4g} pictures a second, "
        f"{best['fill']['worst']:.1%} to {best['fill']['best']:.1%} of the pixels visited, depending on the phase "
        "between the axes."
    )
    if best["fill_reached"] == "no":
        text += f" The required {fill:.1%} is not reached: choose fewer pixels or a lower frame rate."
    return text


def conclude_study(summary: Mapping[str, Any]) -> str:
    """Which estimator was best, and how often it satisfied the bound."""
    statistics = {
        name: values
        for name, values in summary["estimators"].items()
        if values["phase_rmse_deg_median"] is not None and values["within_bound"] is not None
    }
    if not statistics:
        return f"None of {counted(summary['cells'], 'cell')} was computed; the reasons are listed below."
    best = min(statistics, key=lambda name: statistics[name]["phase_rmse_deg_median"])
    values = statistics[best]
    usable = values["within_bound"] >= MIN_USABLE_FRACTION
    subject = (
        f"Use {best}: its phase error is the smallest"
        if usable
        else f"No estimator is accurate enough: the smallest phase error is that of {best}"
    )
    text = (
        f"{subject}, {format_degrees(values['phase_rmse_deg_median'])} rms (median), "
        f"with {values['within_bound']:.1%} of the scan within the bound p/m."
    )
    if summary["failed"]:
        text += f" {summary['failed']} of {counted(summary['cells'], 'cell')} failed."
    return text


def conclude_many(summary: Mapping[str, Any]) -> str:
    """How many recordings were reconstructed, which pictures do not show their scene, and which one needs a look."""
    rows: Sequence[Mapping[str, Any]] = summary["recordings"]
    done = [row for row in rows if not row["failed"]]
    text = f"{len(done)} of {counted(len(rows), 'recording')} reconstructed."
    if limited := [row["output"].rsplit("/", 1)[-1] for row in done if row["limits"]]:
        names = ", ".join(limited[:PICTURES_LISTED]) + (", …" if len(limited) > PICTURES_LISTED else "")
        verb = "does" if len(limited) == 1 else "do"
        text += f" {counted(len(limited), 'picture')} ({names}) {verb} not show the scene, or only a part."
    if done:
        worst = min(done, key=lambda row: min(row["within_bound"].values()))
        share = min(worst["within_bound"].values())
        name = worst["output"].rsplit("/", 1)[-1]
        text += f" At least {share:.1%} of every scan lies within the bound p/m" + (
            f"; look at {name} first." if share < SHARP_FRACTION else "."
        )
    if summary["stack"]:
        stack = describe_stack(summary["stack"])
        text += f" {stack[0].upper()}{stack[1:]}: stack.ome.tif."
    if len(done) < len(rows):
        text += " The reasons of the others are listed below."
    return text


def conclude_bidirectional(summary: Mapping[str, Any]) -> str:
    """How far the lines of the two directions lay apart, and what the correction leaves."""
    shift, rms = summary["shift_px"], summary["rows_rms"]
    phase = summary["phase_deg"]
    text = f"The lines of the two directions lay {shift['median']:+.3f} ± {shift['sd']:.3f} pixels apart"
    if summary["frames"] > 1:
        text += f" (between {shift['min']:+.3f} and {shift['max']:+.3f} over {summary['frames']} frames)"
    text += (
        "; the lag is the same in all columns" if phase is None else f", a phase error of {format_degrees(abs(phase))}"
    )
    return (
        f"{text}. Lines differed from their neighbours by {rms['recorded']:.3g} rms and differ by "
        f"{rms['corrected']:.3g} in corrected.tif."
    )


def conclude_point_cloud(summary: Mapping[str, Any], file: str) -> str:
    """What displaces the points, how many there are, how far they reach and how uncertain they are."""
    sd, reach = max(summary["sd_m"].values()), summary["largest_distance_m"]
    of_angles = "" if summary["range_sd_m"] else "; by the angles alone, without the range finder's noise"
    points, shots = counted(summary["points"], "point"), counted(summary["shots"], "shot")
    limits = "".join(f"{sentence(limit)} " for limit in summary["limits"])
    return (
        f"{limits}{points} from {shots}, up to {reach:.3g} m away, with a standard deviation of "
        f"at most {format_value(1e3 * sd, 2)} mm (rms of an axis{of_angles}).{'' if limits else f' Use {file}.'}"
    )


def conclude_fleet(summary: Mapping[str, Any]) -> str:
    """How many recordings show an effect, and which effects most of them have in common."""
    rows: Sequence[Mapping[str, Any]] = [row for row in summary["table"] if not row.get("failed")]
    diagnosed = len({row["recording"] for row in rows})
    effects: dict[str, set[str]] = {}
    for row in rows:
        if row.get("effect"):
            effects.setdefault(f"{row['axis']} {row['effect']}", set()).add(row["recording"])
    affected = len(set().union(*effects.values()))
    verb = "shows" if affected == 1 else "show"
    text = f"{affected} of {counted(diagnosed, 'recording')} {verb} effects that the nominal device omits."
    largest = max(map(len, effects.values()), default=0)
    if largest > 1:
        names = [name for name, where in effects.items() if len(where) == largest]
        text += f" The most frequent {'is' if len(names) == 1 else 'are'} {' and '.join(names)}, in {largest}."
    elif len(effects) > 1:
        text += " No effect occurs in more than one."
    if summary["failed"]:
        text += f" {counted(summary['failed'], 'recording')} failed; the reasons are listed below."
    return text
