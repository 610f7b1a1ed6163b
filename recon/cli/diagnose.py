"""``lissajous diagnose REC...``: locate, name and model the effects that the nominal device omits.

With ``--plan`` nothing is measured: the command lists which effects such recordings could show.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from recon.cli.argument_types import parse_count
from recon.cli.shared_arguments import add_source_arguments


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("recordings", type=Path, nargs="+", metavar="REC", help="recordings of one device (.h5)")
    kinds = parser.add_mutually_exclusive_group()
    kinds.add_argument(
        "--plan",
        action="store_true",
        help="no diagnosis: which effects such recordings could show; REC may be an excitation (.toml)",
    )
    kinds.add_argument(
        "--each",
        action="store_true",
        help="every recording by itself, a folder and a line of table.csv each; REC may be a folder of recordings",
    )
    parser.add_argument("-o", "--output", type=Path, required=True, metavar="DIR", help="folder for the diagnosis")
    add_source_arguments(parser)
    where = parser.add_mutually_exclusive_group()
    where.add_argument("--scheduler", metavar="ADDRESS", help="each: on the Dask cluster of this scheduler")
    where.add_argument("--workers", type=parse_count, metavar="N", help="each: processes here (one a core)")
    parser.add_argument("--overwrite", action="store_true", help="each: also what an earlier run has completed")


def run(args: argparse.Namespace) -> dict[str, Any]:
    from scanner.errors import BadInput

    if (args.workers or args.scheduler) and not args.each:
        option = "--workers" if args.workers else "--scheduler"
        raise BadInput("has no effect without --each", channel=option, hint="add --each, or leave it out")
    if args.each:
        from recon.cli.diagnose_each import diagnose_each

        where = {"scheduler": args.scheduler, "workers": args.workers, "overwrite": args.overwrite}
        return diagnose_each(args.recordings, args.output, args.device, args.mapping, **where)
    from recon.experiment_planning import plan_files

    work = plan_files if args.plan else diagnose_files
    return work(args.recordings, args.output, device=args.device, mapping=args.mapping, quiet=args.json)


def diagnose_files(
    paths: Sequence[Path],
    output: Path,
    device: str | Path | None = None,
    mapping: Path | None = None,
    quiet: bool = False,
) -> dict[str, Any]:
    """Diagnose recordings of one device; write diagnosis.json, device.toml and report.html; return the diagnosis.

    Args:
        paths: recordings of one device, which are fitted together.
        output: folder.
        device: file of the nominal device; None takes that of the first recording.
        mapping: makes recordings of instruments' files, see :func:`recon.io.convert.open_any`.
        quiet: show no progress.

    Raises:
        BadInput: a recording or the device cannot be used.
    """
    from contextlib import ExitStack

    from recon.diagnose_recordings import diagnose_recordings
    from recon.io.convert import check_different, open_any
    from recon.io.output import check_folder, replacing_folder, write_json
    from recon.report.diagnosis import diagnosis_report
    from recon.runtime.stage_progress import stage_progress
    from scanner import devices

    check_different(paths)
    check_folder(output)
    began = time.perf_counter()
    with ExitStack() as stack:
        recordings = [stack.enter_context(open_any(path, mapping)) for path in paths]
        nominal = devices.find(device) if device is not None else None
        with stage_progress(quiet) as progress:
            diagnosis = diagnose_recordings(recordings, nominal, progress)
            progress("report")
            conclusion, page = diagnosis_report(diagnosis, [recording.name for recording in recordings])
        content = diagnosis.to_json() | {"conclusion": conclusion}
        with replacing_folder(output, device, *paths) as folder:
            write_json(folder / "diagnosis.json", content)
            (folder / "device.toml").write_text(diagnosis.device.to_toml(), encoding="utf-8")
            (folder / "report.html").write_text(page, encoding="utf-8")
    return content | {"output": str(output), "seconds": time.perf_counter() - began}


def format_summary(summary: dict[str, Any]) -> str:
    if "table" in summary:
        from recon.cli.diagnose_each import format_each

        return format_each(summary)
    return _format_plan(summary) if "excitations" in summary else _format_diagnosis(summary)


def _format_plan(summary: dict[str, Any]) -> str:
    from recon.report.conclusions import conclude_plan

    lines = [conclude_plan(summary)]
    lines += [
        f"  {effect['key']}: {effect['sigma']:.3g} sigma, {effect['distance']:.3g} from "
        f"{effect['nearest']}" + (f" ({effect['advice']})" if effect["advice"] else "")
        for effect in summary["effects"]
    ]
    return "\n".join([*lines, f"  report {summary['output']}/report.html"])


def _format_diagnosis(summary: dict[str, Any]) -> str:
    from estimation.candidate_terms.significance import MIN_RIVAL_PROBABILITY
    from recon.report.diagnosis_conclusion import name_rival
    from recon.report.numbers import format_interval, format_probability

    lines = [summary["conclusion"], f"{summary['output']}: {summary['verdict']}"]
    for finding in summary["findings"]:
        heldout = finding["heldout"]
        lines.append(
            f"  {finding['axis']} {finding['stage']}: {finding['effect']} (probability "
            f"{format_probability(finding['probability'])} among the laws compared), "
            f"held-out {'chi-square' if 'chi-square' in heldout['metric'] else 'error'} "
            f"{heldout['before']:.3g} -> {heldout['after']:.3g}"
        )
        lines += [
            f"    {p['name']} = {format_interval(p['value'], p['ci95'][0], p['ci95'][1], p['unit'])}"
            for p in finding["parameters"]
        ]
        names = [(name_rival(r["effect"], r.get("stage")), r["probability"]) for r in finding["rivals"]]
        probable = [f"{name} ({format_probability(p)})" for name, p in names if p > MIN_RIVAL_PROBABILITY]
        others = [name for name, p in names if p <= MIN_RIVAL_PROBABILITY]
        lines += [f"    alternative: {', '.join(probable)}"] if probable else []
        lines += [f"    not excluded by this recording: {', '.join(others)}"] if others else []
        if "advice" in finding:
            lines.append(f"    to distinguish them: {finding['advice']}")
    if summary["unexplained"]:
        lines.append(f"  unexplained: {summary['unexplained']}")
    lines.append(f"  report {summary['output']}/report.html")
    return "\n".join(lines)
