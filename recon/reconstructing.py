"""``lissajous reconstruct``: one recording's file to a folder of pictures, motion, summary and report."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from recon.convert import open_any
from recon.frames import film
from recon.mapping import fill_holes
from recon.output import finite, replacing_folder, write_json, write_motion, write_tiff
from recon.pipeline import Options, reconstruct
from recon.report import reconstruction_report
from recon.score import truth_of
from recon.summary import summarise
from recon.views import save_picture


def reconstruct_file(
    path: Path,
    output: Path,
    options: Options,
    mapping: Path | None = None,
    quiet: bool = False,
    live: Mapping[str, Any] | None = None,
) -> dict[str, Any]:
    """``reconstruct`` a file and write everything into the folder ``output``; returns the summary.

    Args:
        mapping: what makes an instrument's file a recording, see :func:`recon.convert.open_any`.
        quiet: no progress.
        live: what following the file amounted to, for the summary. Its writer may have it open still; a truth is not
            looked for.
    """
    growing = live is not None
    with open_any(path, mapping, growing) as recording, replacing_folder(output) as folder:
        result = reconstruct(recording, options, None if mapping or growing else truth_of(path), quiet)
        said = {"output": str(output), "recording": str(path)} | ({"live": live} if live else {})
        summary = finite(summarise(result) | said)
        grid = result.picture.grid
        write_tiff(folder / "image.tif", result.picture.image, grid)
        write_tiff(folder / "coverage.tif", result.picture.coverage, grid)
        if options.fill_radius:
            image, mask = fill_holes(result.picture, options.fill_radius)
            write_tiff(folder / "filled.tif", image, grid)
            write_tiff(folder / "fill.tif", mask.astype(np.uint8), grid)
        if result.trouble:
            write_tiff(folder / "affected.tif", result.affected.astype(np.uint8), grid)
        if options.frames or options.frame_time:
            film(folder / "frames.ome.tif", result, options)
        write_motion(folder / "motion.h5", result.motion)
        write_json(folder / "summary.json", summary)
        save_picture(folder / "image.png", result.picture, result.affected)
        page = reconstruction_report(result, summary)
        (folder / "report.html").write_text(page, encoding="utf-8")
    return summary
