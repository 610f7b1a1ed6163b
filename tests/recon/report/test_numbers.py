"""Numbers are rounded to their uncertainty and carry their unit."""

import math

import pytest

from recon.report.numbers import format_interval, format_probability, format_uncertain, format_value


@pytest.mark.parametrize(
    ("value", "sd", "unit", "text"),
    [
        (0.0116342, 0.0000202, "", "0.011634 ± 0.000020"),
        (12.697, 0.05, "ms", "(12.697 ± 0.050) ms"),
        (-1.1e-5, 1.3e-7, "N m/rad³", "(−1.100 ± 0.013) · 10⁻⁵ N m/rad³"),
        (3.0, 12.0, "1", "3 ± 12"),
        (0.0, 0.013, "°", "0.000° ± 0.013°"),
        (4.0, None, "V", "4.000 V"),
        (4.0, math.inf, "V", "4.000 V"),
        (math.nan, 1.0, "V", "not determined"),
        (1720938866911.0, None, "", "1.721 · 10¹²"),
    ],
)
def test_a_value_is_rounded_to_its_uncertainty(value: float, sd: float | None, unit: str, text: str) -> None:
    assert format_uncertain(value, sd, unit) == text


def test_intervals_probabilities_and_values_are_formatted_with_units() -> None:
    assert format_interval(1.0, 0.902, 1.098, "s") == "(1.000 ± 0.050) s"
    assert format_interval(1.0, 0.9, 2.0, "s") == "1.000 (0.9000 to 2.000) s"
    assert [format_probability(p) for p in (1.0, 0.9834, 1e-9)] == ["> 99.9 %", "98.3 %", "< 0.1 %"]
    assert format_value(0.0) == "0"
    assert format_interval(0.0127, 0.0126, 0.0128, "s") == "(12.700 ± 0.051) ms"
    assert format_interval(0.001163, 0.001159, 0.001167, "1") == "(0.11630 ± 0.00020) %"
