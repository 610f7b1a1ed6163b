"""Errors that a user can act on: what is wrong, where, and what to do, in one line."""

from __future__ import annotations


class BadInput(ValueError):
    """Input that cannot be used. The command line prints it as one line and exits with 2.

    Args:
        what: what is wrong, in words.
        file: the file it is wrong in.
        channel: the channel (or device key) it is wrong in.
        hint: what the user can do about it.
    """

    def __init__(self, what: str, *, file: object = None, channel: str | None = None, hint: str | None = None):
        self.what, self.file, self.channel, self.hint = what, file, channel, hint
        super().__init__(what)

    def __str__(self) -> str:
        where = ": ".join(str(part) for part in (self.file, self.channel) if part)
        line = f"{where}: {self.what}" if where else self.what
        if self.hint:
            line += f"; {self.hint}"
        line = " ".join(line.split())
        # a name in a damaged or hostile file may hold control characters, which must not reach the terminal
        return "".join(c if c.isprintable() else "\N{REPLACEMENT CHARACTER}" for c in line)


def line_of(error: OSError, place: object) -> str:
    """Return the message of a system error in one line; ``place`` is used if the error names no file."""
    return " ".join(f"{error.filename or place}: {error.strerror or ' '.join(map(str, error.args))}".split())


class ChannelMissing(BadInput, KeyError):
    """A channel that the asked-for operation needs is not in the recording."""


class DeviceInvalid(BadInput):
    """The device lacks a value that is needed, or states one that is not physical."""


class UnitUnknown(BadInput):
    """A unit that cannot be converted to that of the channel."""
