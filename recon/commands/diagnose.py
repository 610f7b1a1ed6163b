"""``lissajous diagnose REC...``: locate, name and model what the nominal device leaves out.

With ``--plan`` nothing is compared: what recordings under such excitations could tell.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("recordings", type=Path, nargs="+", metavar="REC", help="recordings of one device (.h5)")
    parser.add_argument(
        "--plan",
        action="store_true",
        help="no diagnosis: what such recordings could tell; REC may be an excitation (.toml)",
    )
    parser.add_argument("-o", "--output", type=Path, required=True, metavar="DIR", help="folder for the diagnosis")
    parser.add_argument("--mapping", type=Path, metavar="FILE", help="TOML: which variable is which channel")
    parser.add_argument(
        "--device",
        type=Path,
        metavar="FILE",
        help="device TOML in place of the recording's own; with --plan, or a name",
    )


def run(args: argparse.Namespace) -> dict[str, Any]:
    from recon.diagnosing import diagnose_files
    from recon.planning import plan_files

    work = plan_files if args.plan else diagnose_files
    return work(args.recordings, args.output, device=args.device, mapping=args.mapping, quiet=args.json)


def tell(summary: dict[str, Any]) -> str:
    return _plan(summary) if "excitations" in summary else _diagnosis(summary)


def _plan(summary: dict[str, Any]) -> str:
    apart = [each for each in summary["effects"] if each["distance"] >= summary["apart"]]
    lines = [f"{summary['output']}: {len(apart)} of {len(summary['effects'])} effects could be named alone"]
    lines += [
        f"  {each['axis']} {each['effect']}: {each['sigma']:.3g} sigma, {each['distance']:.3g} from {each['nearest']}"
        + (f" ({each['advice']})" if each["advice"] else "")
        for each in summary["effects"]
    ]
    return "\n".join([*lines, f"  report {summary['output']}/report.html"])


def _diagnosis(summary: dict[str, Any]) -> str:
    lines = [f"{summary['output']}: {summary['verdict']}"]
    for finding in summary["findings"]:
        change = finding["heldout"]
        lines.append(
            f"  {finding['axis']} {finding['stage']}: {finding['effect']} ({finding['probability']:.1%}), "
            f"held-out chi-square {change['before']:.3g} -> {change['after']:.3g}"
        )
        lines += [
            f"    {p['name']} = {p['value']:.4g} [{p['ci95'][0]:.4g}, {p['ci95'][1]:.4g}] {p['unit']}"
            for p in finding["parameters"]
        ]
        if finding["rivals"]:
            lines.append("    or " + ", ".join(f"{r['effect']} ({r['probability']:.1%})" for r in finding["rivals"]))
        if "advice" in finding:
            lines.append(f"    to tell them apart: {finding['advice']}")
    if summary["unexplained"]:
        lines.append(f"  unexplained: {summary['unexplained']}")
    lines.append(f"  report {summary['output']}/report.html")
    return "\n".join(lines)
