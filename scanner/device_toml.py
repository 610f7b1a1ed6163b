"""Conversion between TOML tables and dataclasses, key by key: errors name their key, and unknown keys are preserved."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from dataclasses import MISSING, dataclass, field, fields
from math import isfinite
from typing import Any, TypeVar

from scanner.errors import DeviceInvalid
from scanner.wording import counted

# Conditions on the number in a field: stored as the field's metadata, checked when the dataclass is made.
FINITE = {"must": "be a finite number"}
POSITIVE = {"must": "be a number greater than 0"}
NOT_NEGATIVE = {"must": "be a number, 0 or greater"}
NONZERO = {"must": "be a number other than 0"}
WHOLE = {"must": "be a whole number greater than 0"}
INDEX = {"must": "be a whole number, 0 or greater"}
CAN_BE_OFF = {"optional": True}

_CONDITIONS: dict[str, Callable[[Any], bool]] = {
    FINITE["must"]: lambda number: True,
    POSITIVE["must"]: lambda number: number > 0,
    NOT_NEGATIVE["must"]: lambda number: number >= 0,
    NONZERO["must"]: lambda number: number != 0,
    WHOLE["must"]: lambda number: isinstance(number, int) and number > 0,
    INDEX["must"]: lambda number: number >= 0 and float(number).is_integer(),  # tables of terms hold floats
}

T = TypeVar("T")


def checked_number(value: object, must: str, key: str, hint: str = "") -> float | int:
    """Return ``value`` as a number that satisfies ``must``. true and false are not numbers.

    Args:
        value: of the device file.
        must: condition.
        key: of the value.
        hint: what to do where it is a number that does not satisfy the condition.

    Raises:
        DeviceInvalid: it does not; the error names ``key``.
    """
    if isinstance(value, (int, float)) and not isinstance(value, bool):
        with suppress(OverflowError):  # an integer of TOML may be too large for a float
            if isfinite(value) and _CONDITIONS[must](value):
                return value if must == WHOLE["must"] else float(value)
            raise DeviceInvalid(f"is {value!r} and must {must}", channel=key, hint=hint or None)
    raise DeviceInvalid(f"is {value!r} and must {must}", channel=key)


def checked_numbers(value: object, must: str, key: str, size: int | None = None) -> tuple[float | int, ...]:
    """Return ``value`` as a tuple of numbers that satisfy ``must``.

    Args:
        value: of the device file.
        must: condition on every number.
        key: of the value.
        size: how many numbers are needed; any where None.

    Raises:
        DeviceInvalid: it is no list, has another length, or a number does not satisfy the condition.
    """
    if not isinstance(value, (list, tuple)):
        raise DeviceInvalid(f"is {value!r} and must be a list of numbers", channel=key)
    if size is not None and len(value) != size:
        raise DeviceInvalid(f"has {counted(len(value), 'number')} and must have {size}", channel=key)
    return tuple(checked_number(number, must, key) for number in value)


def check_values(record: object) -> None:
    """Check every number of a dataclass against its field's metadata and store it as float (or int)."""
    for item in fields(record):  # type: ignore[arg-type]
        must, value = item.metadata.get("must"), getattr(record, item.name)
        if must is None or (value is None and item.metadata.get("optional")):
            continue
        if item.type in ("tuple[float, ...]", "tuple[int, ...]"):
            checked: object = checked_numbers(value, must, item.name)
        else:
            checked = checked_number(value, must, item.name, item.metadata.get("hint", ""))
        object.__setattr__(record, item.name, checked)


def check_kind(kind: object, known: Iterable[str]) -> str:
    """Return ``kind`` if it is one of the known ones.

    Raises:
        DeviceInvalid: it is not; the error lists the known ones.
    """
    if kind not in (known := tuple(known)):
        raise DeviceInvalid(f"{kind!r} is unknown", channel="kind", hint=f"known kinds: {', '.join(known)}")
    return str(kind)


def to_table(record: Any) -> dict[str, Any]:
    """Return a dataclass as a TOML table, without values that are None. A ``kind`` comes first."""
    kind = {"kind": record.kind} if hasattr(record, "kind") else {}
    return kind | {item.name: v for item in fields(record) if (v := getattr(record, item.name)) is not None}


def merged(table: Mapping[str, Any], extra: Mapping[str, Any]) -> dict[str, Any]:
    """Return ``table`` with the keys of ``extra`` added, also in nested tables."""
    out = dict(table)
    for key, value in extra.items():
        out[key] = merged(out[key], value) if isinstance(value, Mapping) and key in out else value
    return out


@dataclass
class Table:
    """A table that is being read. Reading a key removes it; the keys that remain are unknown ones.

    Attributes:
        rest: keys that have not been read.
        where: dotted key of the table, empty for the whole file.
        source: the file, for messages.
    """

    rest: dict[str, Any]
    where: str
    source: str | None
    tables: dict[str, Table] = field(default_factory=dict)

    def key(self, name: str | None) -> str:
        return ".".join(part for part in (self.where, name) if part)

    def wrong(self, error: DeviceInvalid) -> DeviceInvalid:
        """Return the same error with the file and the whole key."""
        return DeviceInvalid(error.what, file=self.source, channel=self.key(error.channel), hint=error.hint)

    def take_text(self, name: str, default: str) -> str:
        value = self.rest.pop(name, default)
        if not isinstance(value, str):
            raise self.wrong(DeviceInvalid(f"is {value!r} and must be text", channel=name, hint="put it in quotes"))
        return value

    def take_table(self, name: str) -> Table | None:
        value = self.rest.pop(name, None)
        if value is None:
            return None
        if not isinstance(value, dict):
            raise self.wrong(
                DeviceInvalid(f"is {value!r} and must be a table", channel=name, hint=f"write [{self.key(name)}]")
            )
        self.tables[name] = Table(dict(value), self.key(name), self.source)
        return self.tables[name]

    def take_kind(self, known: Iterable[str]) -> str:
        if "kind" not in self.rest:
            hint = f"known kinds: {', '.join(known)}"
            raise self.wrong(DeviceInvalid("is missing", channel="kind", hint=hint))
        try:
            return check_kind(self.rest.pop("kind"), known)
        except DeviceInvalid as error:
            raise self.wrong(error) from None

    def take_numbers(self, must: Mapping[str, Any] = FINITE, only: bool = False) -> dict[str, float]:
        """Read all numbers of the table, and leave texts, lists and tables; those are wrong with ``only``."""
        names = [name for name, value in self.rest.items() if only or not isinstance(value, (str, list, dict))]
        try:
            return {name: checked_number(self.rest.pop(name), must["must"], name) for name in names}
        except DeviceInvalid as error:
            raise self.wrong(error) from None

    def take_as(self, cls: type[T], name: str) -> T | None:
        table = self.take_table(name)
        return None if table is None else table.made(cls)

    def made(self, cls: type[T]) -> T:
        """Return an object of the dataclass ``cls`` made from the keys of this table."""
        known = fields(cls)  # type: ignore[arg-type]
        for item in known:
            if item.default is MISSING and item.name not in self.rest:
                needs = ", ".join(other.name for other in known if other.default is MISSING)
                raise self.wrong(DeviceInvalid("is missing", channel=item.name, hint=f"[{self.where}] needs {needs}"))
        try:
            return cls(**{item.name: self.rest.pop(item.name) for item in known if item.name in self.rest})
        except DeviceInvalid as error:
            raise self.wrong(error) from None

    def take_rest(self) -> dict[str, Any]:
        """Return the keys that have not been read, of this table and the tables in it, nested as in the file."""
        inner = {name: rest for name, table in self.tables.items() if (rest := table.take_rest())}
        rest, self.rest, self.tables = self.rest | inner, {}, {}
        return rest
