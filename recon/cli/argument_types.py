"""Parsers of argument values, as ``type=`` of argparse takes them."""

from __future__ import annotations

import argparse

MAX_PICTURE_SIDE_PX = 16384
"""Largest width and height of a picture. Its sums and counts at this size take 3 GB, which a workstation has."""


def parse_size(text: str) -> tuple[int, int]:
    """Width and height in pixels from WIDTHxHEIGHT."""
    width, cross, height = text.lower().partition("x")
    valid = cross and width.isdecimal() and height.isdecimal()
    if not valid or not all(1 <= int(side) <= MAX_PICTURE_SIDE_PX for side in (width, height)):
        raise argparse.ArgumentTypeError(f"{text!r} is no size; give WIDTHxHEIGHT, as 400x400")
    return int(width), int(height)


def parse_count(text: str) -> int:
    """A whole number above zero."""
    if not text.isdecimal() or int(text) < 1:
        raise argparse.ArgumentTypeError(f"{text!r} is no whole number above 0")
    return int(text)


def parse_numbers(text: str, count: int, example: str) -> tuple[float, ...]:
    """``count`` numbers, separated by commas; ``example`` goes into the message."""
    try:
        numbers = tuple(float(part) for part in text.split(","))
    except ValueError:
        numbers = ()
    if len(numbers) != count:
        raise argparse.ArgumentTypeError(f"{text!r} is not {count} numbers; give them as {example}")
    return numbers


def parse_positive(text: str) -> float:
    """A finite number above zero."""
    (value,) = parse_numbers(text, 1, "1.5")
    if not 0.0 < value < float("inf"):
        raise argparse.ArgumentTypeError(f"{text!r} is not above 0")
    return value


def parse_drive(text: str) -> tuple[float, ...]:
    """Frequency [Hz], amplitude [V] and offset [V] of a sinusoidal drive."""
    return parse_numbers(text, 3, "27680,30,30: frequency, amplitude, offset")


def parse_axis_pair(text: str) -> tuple[float, ...]:
    """One number for x and one for y."""
    return parse_numbers(text, 2, "30,30: of x and of y")
