"""A small case of ``benchmarks.readout_errors``: errors of the readout, in light and without."""

from benchmarks.readout_errors import scan


def test_a_bright_picture_corrects_the_readout() -> None:
    row = scan(60501, (100.0, 1000.0))
    for axis in "xy":
        assert row[axis]["rms_deg"] < 0.15
    assert row["picture"] < 1.02


def test_a_picture_that_determines_one_slice_by_chance_leaves_a_wide_uncertainty() -> None:
    """With 5 photons only y of the first slice is determined. This is no loss of samples after it."""
    row = scan(58451, (3.0, 30.0))
    for axis in "xy":
        assert row[axis]["rms_deg"] < 3.0 * row[axis]["sd_deg"]
