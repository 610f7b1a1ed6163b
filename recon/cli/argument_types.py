"""Parsers of argument values, as ``type=`` of argparse takes them."""

from __future__ import annotations

import argparse
from math import isfinite

MAX_PICTURE_SIDE_PX = 16384
"""Largest width and height of a picture. Its sums and counts at this size take 3 GB, which a workstation has."""


MAX_MAGNITUDE = 1e15
"""Largest magnitude of a number, and the inverse of the least other than 0. No quantity that an option states lies
beyond, and calculations with such numbers overflow."""


def parse_size(text: str) -> tuple[int, int]:
    """Width and height in pixels from WIDTHxHEIGHT."""
    width, cross, height = text.lower().partition("x")
    valid = cross and width.isdecimal() and height.isdecimal()
    if not valid or not all(1 <= int(side) <= MAX_PICTURE_SIDE_PX for side in (width, height)):
        raise argparse.ArgumentTypeError(f"{text!r} is no size; give WIDTHxHEIGHT, as 400x400")
    return int(width), int(height)


def parse_whole(text: str) -> int:
    """A whole number, 0 or above."""
    if not text.isdecimal() or len(text) > 15:
        raise argparse.ArgumentTypeError(f"{text[:40]!r} is no whole number from 0 to {MAX_MAGNITUDE:g}")
    return int(text)


def parse_count(text: str) -> int:
    """A whole number above zero."""
    number = parse_whole(text)
    if number < 1:
        raise argparse.ArgumentTypeError(f"{text!r} is no whole number above 0")
    return number


def parse_numbers(text: str, count: int, example: str) -> tuple[float, ...]:
    """``count`` finite numbers within ``MAX_MAGNITUDE``, separated by commas; ``example`` goes into the message."""
    try:
        numbers = tuple(float(part) for part in text.split(","))
    except ValueError:
        numbers = ()
    if len(numbers) != count:
        expected = "a number; give one" if count == 1 else f"{count} numbers; give them"
        raise argparse.ArgumentTypeError(f"{text!r} is not {expected} as {example}")
    for number in numbers:
        if not isfinite(number) or (number and not 1.0 / MAX_MAGNITUDE <= abs(number) <= MAX_MAGNITUDE):
            limits = f"0, or of a magnitude from {1.0 / MAX_MAGNITUDE:g} to {MAX_MAGNITUDE:g}"
            raise argparse.ArgumentTypeError(f"{number:g} is not {limits}")
    return numbers


def parse_number(text: str) -> float:
    """A finite number."""
    return parse_numbers(text, 1, "0.5")[0]


def parse_not_negative(text: str) -> float:
    """A finite number, 0 or above."""
    value = parse_number(text)
    if value < 0.0:
        raise argparse.ArgumentTypeError(f"{text!r} is below 0")
    return value


def parse_positive(text: str) -> float:
    """A finite number above zero."""
    value = parse_number(text)
    if value <= 0.0:
        raise argparse.ArgumentTypeError(f"{text!r} is not above 0")
    return value


def parse_drive(text: str) -> tuple[float, ...]:
    """Frequency [Hz], amplitude [V] and offset [V] of a sinusoidal drive."""
    return parse_numbers(text, 3, "27680,30,30: frequency, amplitude, offset")


def parse_axis_pair(text: str) -> tuple[float, ...]:
    """One number for x and one for y."""
    return parse_numbers(text, 2, "30,30: of x and of y")
