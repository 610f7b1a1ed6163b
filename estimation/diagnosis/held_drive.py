"""A drive that a converter holds from one sample to the next, which delays it by half a sample."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from math import pi

from estimation.diagnosis.finding import Finding
from scanner.recording import Recording

DELAYS = ("channel-delay", "drive-lag", "readout-lag")
"""Effects that a delay of the drive may be named as; for a linear axis all of them commute."""

MAX_DEVIATION = 0.05
"""Deviation of a delay from half a sample, relative to it, up to which it is that of a held drive: a low-pass and the
attenuation by holding differ from a pure delay by less from ten samples a period on."""


def with_held_drive(finding: Finding, recordings: Sequence[Recording]) -> Finding:
    """The finding with the advice that a delay of half a sample of the drive calls for."""
    delay, name = _delay(finding), f"drive_{finding.axis}"
    halves = {0.5 / recording[name].sample_rate for recording in recordings if name in recording}
    if delay is None or len(halves) != 1 or abs(delay - (half := halves.pop())) > MAX_DEVIATION * half:
        return finding
    text = (
        f"a converter that holds {name} from one sample to the next delays it by half a sample ({1e6 * half:.3g} µs), "
        "as found: record its output, or state a start of the channel that is half a sample later"
    )
    return replace(finding, advice="; ".join(filter(None, (text, finding.advice))))


def _delay(finding: Finding) -> float | None:
    """Delay of a finding [s], of a low-pass that at low frequencies; None for other effects."""
    if finding.effect not in DELAYS:
        return None
    (parameter,) = finding.parameters
    return parameter.value if parameter.unit == "s" else 1.0 / (2.0 * pi * parameter.value)
