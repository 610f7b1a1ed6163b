"""``lissajous identify REC...``: measure a device's constants from recordings at rest, in free decay and driven."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from recon.cli.shared_arguments import add_source_arguments

if TYPE_CHECKING:
    from estimation.identification.calibrate import Identification

UNITS = {
    "J": "kg m²", "b": "N m s", "k": "N m/rad", "k_over_J": "1/s²", "b_over_J": "1/s",
    "C0": "F", "theta0": "rad", "theta_th": "rad", "a_cir": "V/F", "b_cir": "V",
    "noise_var": "V²", "noise_sd": "V", "delay": "s", "amplitude_over_theta0": "1",
}  # fmt: skip
"""Units of the constants that can be identified."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("recordings", type=Path, nargs="+", metavar="REC", help="calibration recordings (.h5)")
    parser.add_argument("-o", "--output", type=Path, required=True, metavar="DIR", help="folder for the device")
    add_source_arguments(parser)


def run(args: argparse.Namespace) -> dict[str, Any]:
    return identify_files(args.recordings, args.output, device=args.device, mapping=args.mapping)


def identify_files(
    paths: Sequence[Path], output: Path, device: str | Path | None = None, mapping: Path | None = None
) -> dict[str, Any]:
    """Identify a device; write device.toml, summary.json and report.html into ``output``; return the summary.

    Args:
        paths: recordings of one device.
        output: folder.
        device: file of the nominal device; None takes that of the first recording that states one.
        mapping: makes recordings of instruments' files, see :func:`recon.io.convert.open_any`.

    Raises:
        BadInput: a recording or the device cannot be used, or the recordings determine no constant.
    """
    from contextlib import ExitStack

    from estimation.identification.calibrate import identify
    from estimation.signals import require_device
    from recon.io.convert import check_different, open_any
    from recon.io.output import check_folder, replacing_folder, write_json
    from recon.report.conclusions import conclude_identification
    from recon.report.identification import identification_report
    from scanner import devices

    check_different(paths)
    check_folder(output)
    with ExitStack() as stack:
        recordings = [stack.enter_context(open_any(path, mapping)) for path in paths]
        first = next((recording for recording in recordings if recording.device), recordings[0])
        nominal = require_device(first, devices.find(device) if device is not None else None)
        identification = identify(recordings, nominal)
    summary: dict[str, Any] = {
        "recordings": [str(path) for path in paths],
        "device": nominal.name,
        "axes": _axes_summary(identification),
        "nonlinear": list(identification.nonlinear),
        "notes": list(identification.notes),
        "output": str(output),
    }
    summary["conclusion"] = conclude_identification(summary)
    with replacing_folder(output, device, *paths) as folder:
        (folder / "device.toml").write_text(identification.device.to_toml(), encoding="utf-8")
        write_json(folder / "summary.json", summary)
        names = [path.name for path in paths]
        page = identification_report(summary, nominal, names, identification.responses)
        (folder / "report.html").write_text(page, encoding="utf-8")
    return summary


def _axes_summary(identification: Identification) -> dict[str, Any]:
    """By axis which recordings were used for what, and every identified constant."""
    return {
        axis: {
            "used": list(identification.used[axis]),
            "values": {
                name: {
                    "value": each.value,
                    "sd": each.sd,
                    "ci95": list(each.ci95),
                    "unit": UNITS[name],
                    "tolerance": identification.device.axis(axis).tolerance.get(name),
                }
                for name, each in values.items()
            },
        }
        for axis, values in identification.values.items()
    }


def format_summary(summary: dict[str, Any]) -> str:
    from recon.report.numbers import format_interval

    lines = [summary["conclusion"], f"{summary['output']}: {summary['device']} identified"]
    for name, axis in summary["axes"].items():
        lines.append(f"  {name}: {'; '.join(axis['used'])}")
        for key, value in axis["values"].items():
            low, high = value["ci95"]
            lines.append(f"    {key} = {format_interval(value['value'], low, high, value['unit'])}")
    return "\n".join([*lines, *(f"  {note}" for note in summary["notes"])])
