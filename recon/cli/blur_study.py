"""``lissajous blur-study STUDY.toml``: phantoms x scans x drifts x noise x estimators x resolutions x p as a table."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from recon.cli.argument_types import parse_count
from scanner.wording import counted


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("study", type=Path, metavar="STUDY", help="what to vary (TOML; docs/reference/study.md)")
    parser.add_argument(
        "-o",
        "--output",
        type=Path,
        required=True,
        metavar="DIR",
        help="folder of the table; an interrupted study continues there",
    )
    where = parser.add_mutually_exclusive_group()
    where.add_argument("--scheduler", metavar="ADDRESS", help="run on the Dask cluster of this scheduler")
    where.add_argument("--workers", type=parse_count, metavar="N", help="processes on this machine (one a core)")
    parser.add_argument("--parquet", action="store_true", help="write the table as Parquet too")


def run(args: argparse.Namespace) -> dict[str, Any]:
    from recon.study.run import run_study

    return run_study(args.study, args.output, scheduler=args.scheduler, workers=args.workers, parquet=args.parquet)


def format_summary(summary: dict[str, Any]) -> str:
    lines = [
        summary["conclusion"],
        f"{summary['output']}: {counted(summary['cells'], 'cell')}, {summary['computed']} of them computed now, "
        f"{summary['failed']} failed",
    ]
    lines += [f"  failed: {reason}" for reason in summary["reasons"]]
    for name, statistics in summary["estimators"].items():
        if statistics["phase_rmse_deg_median"] is not None:
            lines.append(
                f"  {name}: phase error {statistics['phase_rmse_deg_median']:.3f}° (median of rms), 95 % below "
                f"{statistics['phase_rmse_deg_p95']:.3f}°; {statistics['within_bound']:.1%} of the scan within ±p/m"
            )
    lines.append(f"  table {summary['output']}/table.csv, report {summary['output']}/report.html")
    return "\n".join(lines)
