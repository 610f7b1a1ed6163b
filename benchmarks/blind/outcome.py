"""The outcome of one diagnosis of a blind recording, beside its key."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any


@dataclass(frozen=True)
class Outcome:
    """One recording, its key and its diagnosis.

    Attributes:
        name: of the recording.
        key: in the form of :func:`normalise_key`.
        diagnosis: content of ``diagnosis.json``, None where none was written.
        seconds: wall time of the diagnosis.
        failure: why there is no diagnosis, else an empty string.
        open_loop: by device (``nominal``, ``improved``) and sense channel the rms error [V] of an open-loop prediction
            of another recording of the same scanner; empty where there is none.
        imaging: by device the errors of the reconstructed scan, see :mod:`benchmarks.blind.imaging_score`.
    """

    name: str
    key: dict[str, Any]
    diagnosis: dict[str, Any] | None
    seconds: float
    failure: str = ""
    open_loop: dict[str, dict[str, float]] = field(default_factory=dict)
    imaging: dict[str, dict[str, float]] = field(default_factory=dict)


def normalise_key(key: dict[str, Any]) -> dict[str, Any]:
    """A key with a list of effects; keys of other generators may state one effect and its stage instead."""
    if "effects" in key:
        return key
    none = key["effect"] == "none"
    only = {"effect": key["effect"], "stage": key["stage"], "listed": True, "parameters": key["parameters"]}
    return key | {"kind": "none" if none else "one", "effects": [] if none else [only]}
