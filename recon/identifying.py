"""``identify`` on files: calibration recordings in, device, summary and report out."""

from __future__ import annotations

import json
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Any

from recon.convert import open_any
from recon.output import check_folder, replacing_folder
from scanner.device import Device
from scanner.errors import BadInput

if TYPE_CHECKING:
    from estimation.calibration import Identified

UNITS = {
    "J": "kg m²", "b": "N m s", "k": "N m/rad", "k_over_J": "1/s²", "b_over_J": "1/s",
    "C0": "F", "theta0": "rad", "theta_th": "rad", "a_cir": "V/F", "b_cir": "V",
    "noise_var": "V²", "noise_sd": "V", "delay": "s",
}  # fmt: skip


def identify_files(
    paths: Sequence[Path], output: Path, device: Path | None = None, mapping: Path | None = None
) -> dict[str, Any]:
    """Identify a device and write device.toml, summary.json and report.html into ``output``.

    Args:
        mapping: what makes instruments' files recordings, see :func:`recon.convert.open_any`.

    Raises:
        BadInput: a recording or the device cannot be used, or nothing can be told.
    """
    from estimation.calibration import identify

    check_folder(output)
    with ExitStack() as stack:
        recordings = [stack.enter_context(open_any(path, mapping)) for path in paths]
        nominal = Device.load(device) if device else next((r.device for r in recordings if r.device), None)
        if nominal is None:
            hint = "give one with --device, or record it under /device"
            raise BadInput("states no device", file=paths[0], channel="/device", hint=hint)
        found = identify(recordings, nominal)
    summary = {
        "recordings": [str(path) for path in paths],
        "device": nominal.name,
        "axes": {
            name: {
                "used": list(found.used[name]),
                "values": {
                    key: {"value": each.value, "sd": each.sd, "ci95": list(each.ci95), "unit": UNITS[key]}
                    for key, each in values.items()
                },
            }
            for name, values in found.values.items()
        },
        "notes": list(found.notes),
    }
    with replacing_folder(output) as folder:
        (folder / "device.toml").write_text(found.device.to_toml(), encoding="utf-8")
        (folder / "summary.json").write_text(json.dumps(summary, indent=1) + "\n", encoding="utf-8")
        (folder / "report.html").write_text(report(found, nominal, [path.name for path in paths]), encoding="utf-8")
    return summary | {"output": str(output)}


def report(found: Identified, nominal: Device, names: Sequence[str]) -> str:
    """One page: each axis's values beside the nominal ones."""
    from recon.report import Section, Table, render

    sections = []
    for name, values in found.values.items():
        rows = [
            [
                key,
                f"{each.value:.6g} {UNITS[key]}",
                f"{each.ci95[0]:.6g} to {each.ci95[1]:.6g}",
                _nominal(nominal, name, key),
            ]
            for key, each in values.items()
        ]
        table = Table(["constant", "found", "95 % interval", "nominal"], rows)
        sections.append(Section(f"Axis {name}", "; ".join(found.used[name]), table))
    lead = f"{nominal.name}, from {', '.join(names)}."
    return render("Identification", lead, sections, list(found.notes))


def _nominal(device: Device, axis: str, key: str) -> str:
    own = device.axis(axis)
    for part in (own.mechanics, own.capacitance, own.readout):
        if part is not None and key in part.__dataclass_fields__:
            return f"{getattr(part, key):.6g}"
    mechanics = own.mechanics
    if mechanics is not None and key.endswith("_over_J"):
        return f"{getattr(mechanics, key[0]) / mechanics.J:.6g}"
    return ""
