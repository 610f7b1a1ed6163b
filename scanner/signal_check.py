"""Check of a whole channel for samples that no estimator can use."""

from __future__ import annotations

from math import isfinite

import numpy as np

from scanner.channel import MAX_MAGNITUDE, READ_CHUNK_SAMPLES, Channel
from scanner.errors import BadInput


def check_signal(signal: Channel, *, constant_ok: bool = False, gaps_ok: bool = False) -> None:
    """Check a whole channel, chunk by chunk, for samples that no estimator can use.

    Args:
        signal: a channel with one or more columns.
        constant_ok: accept a channel that never changes (a bias).
        gaps_ok: accept samples that are not finite as missing.

    Raises:
        BadInput: a sample is not finite (the message states its time) or larger than ``MAX_MAGNITUDE``, no sample is
            finite, or the signal never changes.
    """
    low, high, missing, earliest = np.inf, -np.inf, 0, -1
    for first in range(0, signal.size, READ_CHUNK_SAMPLES):
        values = signal.stored(first, first + READ_CHUNK_SAMPLES)
        lowest, highest = float(values.min()), float(values.max())
        if not (isfinite(lowest) and isfinite(highest)):  # the minimum of samples with a NaN is NaN
            finite = np.isfinite(values).reshape(len(values), -1).all(axis=1)
            earliest = earliest if missing else first + int(np.argmin(finite))
            missing += int(np.sum(~finite))
            if not finite.any():
                continue
            lowest, highest = float(values[finite].min()), float(values[finite].max())
        low, high = min(low, lowest), max(high, highest)
    if low > high:
        what, hint = "holds no sample that can be used", "check that it was recorded"
        if dead := _dead_columns(signal):
            what, hint = f"{' and '.join(dead)} hold{'s' * (len(dead) == 1)} no sample that can be used", "leave it out"
        raise BadInput(what, file=signal.file, channel=signal.name, hint=hint)
    if missing and not gaps_ok:
        what = f"sample {earliest} at {signal.start + earliest / signal.sample_rate:.9g} s is not finite"
        others = f"is 1 other of {signal.size}" if missing == 2 else f"are {missing - 1} others of {signal.size}"
        what += f", nor {others}" if missing > 1 else ""
        hint = "cut the recording there or repair the sample"
        raise BadInput(what, file=signal.file, channel=signal.name, hint=hint)
    low, high = sorted((signal.gain * low + signal.offset, signal.gain * high + signal.offset))
    if max(-low, high) > MAX_MAGNITUDE:
        what = f"reaches {max(-low, high):.3g} {signal.unit}"
        raise BadInput(what, file=signal.file, channel=signal.name, hint="check its type, gain and offset")
    if 0.0 < high - low < 1.0 / MAX_MAGNITUDE:
        what = f"changes by {high - low:.3g} {signal.unit} only"
        raise BadInput(what, file=signal.file, channel=signal.name, hint="check its type, gain and offset")
    if low == high and not constant_ok:
        what = f"is constant, {low:.9g} {signal.unit}"
        raise BadInput(what, file=signal.file, channel=signal.name, hint=hint_of_dead(signal.name, "connected"))


def hint_of_dead(name: str, expected: str) -> str:
    """What to check where a channel shows nothing, as text.

    Args:
        name: of the channel; a drive may be off on purpose.
        expected: what it should have been, such as ``"connected"``.
    """
    is_drive = name.startswith("drive_")
    off = f"; if the drive was off, as in a free decay, name the channel {name.replace('drive', 'bias')}"
    return f"check that it was {expected}" + off * is_drive


def _dead_columns(signal: Channel) -> list[str]:
    """Names of the columns without a finite sample, where others have some."""
    if len(signal.shape) == 1:
        return []
    alive = np.zeros(signal.shape[1], bool)
    for first in range(0, signal.size, READ_CHUNK_SAMPLES):
        alive |= np.isfinite(signal.stored(first, first + READ_CHUNK_SAMPLES)).any(axis=0)
    names = signal.detectors or [f"detector {number}" for number in range(alive.size)]
    return [name for name, live in zip(names, alive, strict=True) if not live] if alive.any() else []
