"""Signed values that were stored as unsigned integers, and unsigned ones that are not."""

import numpy as np
import pytest
from numpy.typing import NDArray

from recon.quality.wrapped_integers import describe_wrapped_integers
from scanner.channel import Channel, make_channel

COUNTS = np.random.default_rng(1).poisson(80.0 * np.random.default_rng(2).uniform(0.1, 1.0, 20_000))


def detector(stored: NDArray[np.int64], kind: str) -> Channel:
    """An intensity of integers of a type, into which larger and smaller ones wrap."""
    return make_channel("intensity", stored.astype(kind), unit="counts", sample_rate=1e6)


@pytest.mark.parametrize(("kind", "signed"), [("uint16", "int16"), ("uint32", "int32")])
def test_a_baseline_that_was_subtracted_from_unsigned_counts_is_named(kind: str, signed: str) -> None:
    [line] = describe_wrapped_integers(detector(COUNTS - 40, kind))
    assert f"stored as {kind}" in line
    assert line.endswith(f"store them as {signed}")


@pytest.mark.parametrize(
    ("stored", "kind"),
    [
        (COUNTS, "uint16"),
        (COUNTS - 40, "int16"),
        (np.minimum(COUNTS * 900, 65535), "uint16"),
        (np.where(COUNTS > 60, 65535, COUNTS), "uint16"),
        (np.where(COUNTS > 60, 65535, 0), "uint16"),
        (np.where(COUNTS > 60, 40_000 + COUNTS, COUNTS), "uint16"),
    ],
    ids=["counts", "signed", "saturated", "pulses at the rail", "comparator", "two levels"],
)
def test_other_integers_are_not(stored: NDArray[np.int64], kind: str) -> None:
    assert describe_wrapped_integers(detector(stored, kind)) == []
