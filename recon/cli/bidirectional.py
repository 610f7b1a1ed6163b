"""``lissajous bidirectional FILM.tif``: line phase of every frame of a resonant raster film, and the film corrected."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("film", type=Path, metavar="FILM", help="TIFF film whose lines run in alternate directions")
    parser.add_argument("-o", "--output", type=Path, required=True, metavar="DIR", help="folder for the corrected film")
    parser.add_argument(
        "--values",
        choices=("counts", "means"),
        default="counts",
        help="pixels hold counts, whose total is kept, or means over their time, as linearised films do (counts)",
    )


def run(args: argparse.Namespace) -> dict[str, Any]:
    from recon.film_correction import correct_film
    from recon.io.film import open_film
    from recon.io.output import replacing_folder, write_json
    from recon.report.bidirectional import bidirectional_report
    from recon.report.conclusions import conclude_bidirectional

    film = open_film(args.film)
    with replacing_folder(args.output, args.film) as folder:
        result = correct_film(film, folder / "corrected.tif", means=args.values == "means")
        result.write_phases(folder / "phase.csv")
        summary = result.summary()
        summary["conclusion"] = conclude_bidirectional(summary)
        summary |= {"film": str(args.film), "output": str(args.output)}
        write_json(folder / "summary.json", summary)
        (folder / "report.html").write_text(bidirectional_report(result, summary), encoding="utf-8")
    return summary


def format_summary(summary: dict[str, Any]) -> str:
    lines = [summary["conclusion"], *(f"  {note}" for note in summary["notes"])]
    return "\n".join([*lines, f"  film {summary['output']}/corrected.tif, report {summary['output']}/report.html"])
