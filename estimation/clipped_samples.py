"""The rails of clipped samples, and corrections that keep the samples recognisable as clipped."""

from __future__ import annotations

import numpy as np
from numba import njit

from scanner.arrays import Array
from scanner.channel import MIN_CLIPPED_RUN_SAMPLES


@njit(cache=True)
def find_rails(samples):  # type: ignore[no-untyped-def]
    """Rails of samples of shape (n,), shape (2,); infinite where no run of equal samples is at that extreme.

    A rail is placed half-way between the extreme and the value next to it. With few bits a sample at the extreme may be
    off by that much, and the threshold of a comparator is half-way between its two values.
    """
    out, finite = np.array([-np.inf, np.inf]), samples[np.isfinite(samples)]
    if finite.size == 0 or finite.min() == finite.max():
        return out
    for i, extreme in ((0, finite.min()), (1, finite.max())):
        run, longest = 0, 0
        for j in range(samples.size):
            run = run + 1 if samples[j] == extreme else 0
            longest = max(longest, run)
        if longest >= MIN_CLIPPED_RUN_SAMPLES:
            rest = finite[finite != extreme]
            out[i] = 0.5 * (float(extreme) + float(rest.min() if i == 0 else rest.max()))
    return out


def clip_again(corrected: Array, measured: Array) -> Array:
    """Samples that were corrected after they had been clipped, with one value at each rail again.

    All that is known of a clipped sample is that the signal lies beyond its corrected value. The innermost of these
    values becomes the rail of all samples, as of an instrument whose range ends there.

    Args:
        corrected, measured: shape (n,), in the unit of the channel.
    """
    lower, upper = find_rails(measured)
    highest = np.max(corrected, where=measured < lower, initial=-np.inf)
    lowest = np.min(corrected, where=measured > upper, initial=np.inf)
    return np.clip(corrected, highest, lowest)
