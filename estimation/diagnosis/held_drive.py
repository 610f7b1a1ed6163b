"""A drive that a converter holds from one sample to the next, which delays it by half a sample."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from math import pi

from estimation.device_fit.data import output_channels
from estimation.diagnosis.finding import Finding
from scanner.device import Device
from scanner.recording import Recording

DELAYS = ("channel-delay", "drive-lag", "readout-lag")
"""Effects that a delay of the drive may be named as; for a linear axis all of them commute, and two may share it."""

MAX_RELATIVE_DEVIATION = 0.1
"""Deviation of a delay from half a sample, relative to it, up to which it is that of a held drive: at 12 to 100
samples a period the delay of fitted low-pass filters was 4 % below half a sample."""


def with_held_drives(
    findings: Sequence[Finding], recordings: Sequence[Recording], device: Device
) -> tuple[Finding, ...]:
    """The findings, the first delay of an axis with the advice that half a sample of its drive calls for."""
    found = list(findings)
    for axis in dict.fromkeys(finding.axis for finding in findings):
        if any(len(_outputs(recording, device, axis)) > 1 for recording in recordings):
            continue  # a late drive delays all channels alike, and neither of them alone
        delays = {i: delay for i, each in enumerate(found) if each.axis == axis and (delay := _delay(each))}
        name = f"drive_{axis}"
        halves = {0.5 / recording[name].sample_rate for recording in recordings if name in recording}
        if len(halves) != 1 or abs(sum(delays.values()) - (half := halves.pop())) > MAX_RELATIVE_DEVIATION * half:
            continue
        first = found[min(delays)]
        text = (
            f"a converter that holds {name} from one sample to the next delays it by half a sample "
            f"({1e6 * half:.3g} µs), as found: record its output, or state a start of the channel that is half a "
            "sample later"
        )
        found[min(delays)] = replace(first, advice="; ".join(filter(None, (text, first.advice))))
    return tuple(found)


def _outputs(recording: Recording, device: Device, axis: str) -> list[str]:
    """The compared channels that show an axis."""
    return [name for name, (_, axes) in output_channels(recording, device).items() if axis in axes]


def _delay(finding: Finding) -> float:
    """Delay of a finding [s], of a low-pass that at low frequencies; 0 for other effects."""
    if finding.effect not in DELAYS:
        return 0.0
    (parameter,) = finding.parameters
    return parameter.value if parameter.unit == "s" else 1.0 / (2.0 * pi * parameter.value)
