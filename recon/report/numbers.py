"""Numbers as text, rounded to their uncertainty."""

from __future__ import annotations

import math
import sys


def format_uncertain(value: float, sd: float | None, unit: str = "") -> str:
    """``value ± sd unit``: the standard deviation with two significant digits, the value to the same decimal place.

    Without a usable standard deviation the value has four significant digits. Very large and very small numbers are
    written with a common power of ten.
    """
    if not math.isfinite(value):
        return "not determined"
    if sd is None or not math.isfinite(sd) or sd <= 0.0:
        return _with_unit(format_value(value), unit)
    power = math.floor(math.log10(max(abs(value), sd)))
    exponent = power if not -3 <= power < 5 else 0
    scaled, scaled_sd = value / 10.0**exponent, sd / 10.0**exponent
    decimals = max(0, 1 - math.floor(math.log10(scaled_sd)))
    text = f"{scaled:.{decimals}f} ± {scaled_sd:.{decimals}f}"
    text = text.replace("-", "−")
    if not exponent:
        return _with_unit(text, unit)
    return f"({text}) · 10{_superscript(exponent)}" + (f" {unit}" if unit not in ("", "1") else "")


def format_value(value: float, digits: int = 4) -> str:
    """A number with significant digits and, if it is very large or small, a power of ten."""
    if value == 0.0:
        return "0"
    if not math.isfinite(value):
        return "not determined"
    power = math.floor(math.log10(abs(value)))
    if -3 <= power < 5:
        return f"{value:.{max(0, digits - 1 - power)}f}".replace("-", "−")
    return f"{value / 10.0**power:.{digits - 1}f} · 10{_superscript(power)}".replace("-", "−")


def format_degrees(value: float) -> str:
    """An angle in degrees: two significant digits, two decimal places above 1°."""
    return f"{value:.2g}°" if value < 1.0 else f"{value:.2f}°"


def format_interval(value: float, low: float, high: float, unit: str = "") -> str:
    """A value with its 95 % interval as ``value ± sd``, or as a range if the interval is clearly asymmetric."""
    factor, unit = readable_unit(value, unit)
    value, low, high = factor * value, factor * low, factor * high
    sd = (high - low) / (2.0 * 1.96)
    if sd > 0.0 and math.isfinite(sd) and abs(high + low - 2.0 * value) > 0.25 * (high - low):
        return _with_unit(f"{format_value(value)} ({format_value(low)} to {format_value(high)})", unit)
    return format_uncertain(value, sd, unit)


def format_range(low: float, high: float) -> str:
    """Both ends of an interval as one text, see :func:`format_ends`."""
    return " to ".join(format_ends(low, high))


def format_ends(low: float, high: float, unit: str = "") -> tuple[str, str]:
    """Both ends of an interval with their unit, with two significant digits of its width."""
    width, largest = high - low, max(abs(low), abs(high))
    digits = 4
    if math.isfinite(width) and width > 0.0:
        needed = math.floor(math.log10(largest)) - math.floor(math.log10(width)) + 2
        digits = min(needed, sys.float_info.dig)
    return _with_unit(format_value(low, digits), unit), _with_unit(format_value(high, digits), unit)


def readable_unit(value: float, unit: str) -> tuple[float, str]:
    """Factor and unit that give a value a readable size: ms or µs for short times, kHz, % for small ratios."""
    size = abs(value)
    if unit == "s" and 0.0 < size < 1.0:
        return (1e3, "ms") if size >= 1e-3 else (1e6, "µs")
    if unit == "Hz" and size >= 1e4:
        return 1e-3, "kHz"
    if unit == "1" and 0.0 < size < 0.1:
        return 100.0, "%"
    return 1.0, unit


def format_probability(probability: float) -> str:
    """A probability in percent; the ends of the scale as bounds."""
    if probability > 0.999:
        return "> 99.9 %"
    if probability < 0.001:
        return "< 0.1 %"
    return f"{100.0 * probability:.1f} %"


def _with_unit(text: str, unit: str) -> str:
    if unit in ("", "1"):
        return text
    if unit == "°":
        return " ± ".join(f"{part}°" for part in text.split(" ± "))
    return f"({text}) {unit}" if "±" in text else f"{text} {unit}"


def _superscript(exponent: int) -> str:
    return str(exponent).translate(str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹"))
