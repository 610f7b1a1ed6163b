"""``lissajous reconstruct REC...`` (= ``reconstruct-from-recording``): motion, picture, accuracy and report."""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from recon.cli.argument_types import parse_count, parse_positive, parse_size, parse_whole
from recon.cli.shared_arguments import add_source_arguments
from scanner.wording import counted

if TYPE_CHECKING:
    from recon.steps.reconstruction import Options


BY_POSITION = 0
"""Value of ``--frames`` and ``--stack`` without a number: ``position_z`` gives the slices or planes."""


OPTIONAL_FILES = (
    "affected.tif", "data_share.tif", "fill.tif", "filled.tif", "frames.gif", "frames.mp4", "frames.ome.tif",
    "frames.ome.zarr", "frames_filled.ome.tif", "frames_sd.ome.tif", "sample_motion.csv",
)  # fmt: skip
"""Files of the output that some options or recordings give only."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "recordings",
        type=Path,
        nargs="+",
        metavar="REC",
        help="recording (.h5), or an instrument's file with --mapping; several, or a folder of them: a folder each",
    )
    parser.add_argument(
        "-o", "--output", type=Path, required=True, metavar="DIR", help="folder for pictures, motion, report"
    )
    several = parser.add_mutually_exclusive_group()
    several.add_argument("--scheduler", metavar="ADDRESS", help="several: on the Dask cluster of this scheduler")
    several.add_argument("--workers", type=parse_count, metavar="N", help="several: processes here (one a core)")
    parser.add_argument("--overwrite", action="store_true", help="several: also what an earlier run has completed")
    several.add_argument(
        "--follow", action="store_true", help="show the frames of a recording that is still being written, then all"
    )
    parser.add_argument(
        "--stack",
        type=parse_positive,
        nargs="?",
        const=BY_POSITION,
        metavar="M",
        help="several: write their pictures as one stack, planes M metres apart, else at their position_z",
    )
    frame_options = parser.add_mutually_exclusive_group()
    frame_options.add_argument(
        "--frames",
        type=parse_count,
        nargs="?",
        const=BY_POSITION,
        metavar="N",
        help="write N frames of the scan to frames.ome.tif; without N a slice for each position of position_z",
    )
    frame_options.add_argument(
        "--frame-time",
        type=parse_positive,
        metavar="S",
        help="or frames of S seconds; follow: so long (the scan's repeat)",
    )
    parser.add_argument(
        "--z-step", type=parse_positive, metavar="M", help="slices M metres thick, where position_z does not rest"
    )
    parser.add_argument(
        "--independent-frames",
        action="store_true",
        help="posterior: each frame by itself; else a frame also uses earlier ones where they agree with its samples",
    )
    parser.add_argument("--zarr", action="store_true", help="write the frames to frames.ome.zarr too")
    parser.add_argument("--movie", choices=("mp4", "gif"), help="write the frames to frames.mp4 or frames.gif too")
    parser.add_argument(
        "--quiet-time",
        type=parse_positive,
        metavar="S",
        help="follow: end when nothing came for so long (5)",
    )
    add_source_arguments(parser)
    parser.add_argument("--estimator", metavar="NAME", help="tracker, ukf, ekf, ...; else by what was recorded")
    parser.add_argument(
        "--pixels", type=parse_size, default=(400, 400), metavar="WxH", help="size of the picture (400x400)"
    )
    parser.add_argument("--p", type=parse_positive, default=1.0, help="pixels of shift that are tolerated (1)")
    parser.add_argument(
        "--flip-x", action="store_true", help="turn the sign of x, which an even capacitance cannot know"
    )
    parser.add_argument("--flip-y", action="store_true", help="turn the sign of y")
    parser.add_argument(
        "--picture",
        choices=("mean", "kernel", "posterior"),
        default="mean",
        help="value of a pixel: mean of its samples, kernel-weighted mean, or posterior mean (mean)",
    )
    parser.add_argument(
        "--fill",
        type=parse_whole,
        default=0,
        metavar="PX",
        help="fill unvisited pixels with a visited one at most PX rows and columns away, marked in fill.tif (0: none)",
    )
    parser.add_argument(
        "--allow-outside", action="store_true", help="make the picture although most samples lie outside the field"
    )
    parser.add_argument(
        "--sense-only", action="store_true", help="do not correct the phase by the error that the picture shows"
    )
    parser.add_argument(
        "--intensity-drift",
        choices=("offset", "gain"),
        help="remove a drift of the detector's offset (1/f noise) or gain (bleaching), found at crossings of the scan",
    )
    parser.add_argument(
        "--sample-motion", action="store_true", help="remove a motion of the sample, found at crossings of the scan"
    )
    parser.add_argument(
        "--spot", type=parse_positive, metavar="PX", help="sd of the beam's spot in pixels, for the blur's account"
    )
    parser.add_argument(
        "--seed", type=parse_whole, default=0, help="of whatever is drawn at random (nothing is, at present)"
    )


def run(args: argparse.Namespace) -> dict[str, Any]:
    from recon.steps.reconstruction import Options
    from scanner.errors import BadInput

    options = Options(
        device=args.device,
        estimator=args.estimator,
        pixels=args.pixels,
        p=args.p,
        flips={"x": args.flip_x, "y": args.flip_y},
        picture=args.picture,
        fill_radius=args.fill,
        spot=args.spot,
        sense_only=args.sense_only,
        allow_outside=args.allow_outside,
        intensity_drift=args.intensity_drift,
        sample_motion=args.sample_motion,
        frames=args.frames or None,
        frame_time=args.frame_time,
        z_stack=args.frames == BY_POSITION,
        z_step=args.z_step,
        independent_frames=args.independent_frames,
        zarr=args.zarr,
        movie=args.movie,
    )
    _check_options(args, options)
    if len(args.recordings) > 1 or args.recordings[0].is_dir() or args.scheduler or args.workers:
        return _run_many(args, options)
    if args.stack is not None:
        raise BadInput("needs several recordings", channel="--stack", hint="name them, or their folder")
    live = _follow(args, options) if args.follow else None
    return reconstruct_file(args.recordings[0], args.output, options, args.mapping, live=live)


def _check_options(args: argparse.Namespace, options: Options) -> None:
    """Raise BadInput for options that contradict each other or have no effect."""
    from scanner.errors import BadInput
    from scanner.extras import import_extra

    if (args.zarr or args.movie) and not options.wants_frames and args.stack is None:
        option = "--zarr" if args.zarr else "--movie"
        raise BadInput("needs frames", channel=option, hint="add --frames, --frame-time, --z-step or --stack")
    if args.stack is not None and options.wants_stack:
        hint = "leave out --stack, or --frames and --z-step"
        raise BadInput("each recording is a plane, and cannot be a stack itself", channel="--stack", hint=hint)
    if args.z_step and (options.frames or options.frame_time):
        raise BadInput("sorts the samples by z, not by time", channel="--z-step", hint="give --frames without a number")
    if args.quiet_time is not None and not args.follow:
        raise BadInput("has no effect without --follow", channel="--quiet-time", hint="add --follow, or leave it out")
    over_time = args.follow or options.frames or options.frame_time
    if args.independent_frames and (args.picture != "posterior" or not over_time):
        what = "has no effect: only posterior frames over time use earlier ones"
        hint = "add --picture posterior and --frames N, --frame-time or --follow, or leave it out"
        raise BadInput(what, channel="--independent-frames", hint=hint)
    if args.zarr:
        import_extra("zarr", "zarr")
    if args.fill and args.picture != "mean":
        raise BadInput(f"a {args.picture} picture has no holes", channel="--fill", hint="leave out --fill or --picture")


def _follow(args: argparse.Namespace, options: Options) -> dict[str, Any]:
    """Show the frames of a growing recording until it ends; return the summary of them.

    Raises:
        BadInput: an option needs the whole recording, or it cannot be followed.
    """
    from recon.live.follow import QUIET_TIME_S, follow_recording
    from scanner.errors import BadInput

    for option, value in (("--intensity-drift", args.intensity_drift), ("--sample-motion", args.sample_motion)):
        if value:
            raise BadInput("needs a whole recording", channel=option, hint="leave out --follow")
    times = {"frame_time": args.frame_time, "quiet_time": args.quiet_time or QUIET_TIME_S}
    return follow_recording(args.recordings[0], args.output, options, args.mapping, **times).summary()


def _run_many(args: argparse.Namespace, options: Options) -> dict[str, Any]:
    from recon.cli.reconstruct_many import StackOptions, reconstruct_files
    from scanner.errors import BadInput

    if args.follow:
        raise BadInput("follows one recording", channel="--follow", hint="start one command for each")
    stack = None if args.stack is None else StackOptions(args.stack or None)
    where = {"scheduler": args.scheduler, "workers": args.workers}
    return reconstruct_files(
        args.recordings, args.output, options, args.mapping, **where, overwrite=args.overwrite, stack=stack
    )


def reconstruct_file(
    path: Path,
    output: Path,
    options: Options,
    mapping: Path | None = None,
    quiet: bool = False,
    live: Mapping[str, Any] | None = None,
) -> dict[str, Any]:
    """Reconstruct one recording; write pictures, motion, summary and report into ``output``; return the summary.

    Args:
        path: the recording.
        output: folder.
        options: of the reconstruction.
        mapping: makes a recording of an instrument's file, see :func:`recon.io.convert.open_any`.
        quiet: show no progress.
        live: summary of ``--follow``. The file may then still be open for writing, and no truth is read from it.

    Raises:
        BadInput: the recording or the device cannot be used.
    """
    from dataclasses import replace

    import numpy as np

    from recon.evaluation import load_truth
    from recon.imaging.picture import fill_holes
    from recon.io.convert import open_any
    from recon.io.output import finite, replacing_folder, write_json, write_motion, write_sample_motion, write_tiff
    from recon.pipeline import reconstruct
    from recon.report.figures import save_picture
    from recon.report.picture_conclusion import conclude_reconstruction
    from recon.report.reconstruction import reconstruction_report
    from recon.report.summary import summarise
    from recon.sequences.frames import write_scan_frames
    from recon.steps.notes import describe_live_frames
    from recon.steps.z_slices import find_z_slices

    growing = live is not None
    with (
        open_any(path, mapping, growing) as recording,
        replacing_folder(output, options.device, path, optional=OPTIONAL_FILES) as folder,
    ):
        if options.wants_stack:  # what prevents a stack is found before the motion is estimated
            reason = "--frames without a number and --z-step cut the scan by it"
            find_z_slices(recording.require("position_z", reason), recording.require("intensity"), options.z_step)
        result = reconstruct(recording, options, None if mapping or growing else load_truth(path), quiet)
        result = replace(result, notes=[*result.notes, *describe_live_frames(live)])
        origin = {"output": str(output), "recording": str(path)} | ({"live": live} if live else {})
        slices = write_scan_frames(folder, result, options).slices if options.wants_frames else None
        if slices is not None:
            result = replace(result, notes=[*result.notes, *slices.notes])
        summary: dict[str, Any] = finite(summarise(result, slices) | origin)
        summary["conclusion"] = conclude_reconstruction(summary)
        grid, detectors = result.picture.grid, result.picture.detectors
        write_tiff(folder / "image.tif", result.picture.image, grid, detectors)
        write_tiff(folder / "image_sd.tif", result.picture_sd, grid, detectors)
        write_tiff(folder / "coverage.tif", result.picture.coverage, grid)
        if result.data_share is not None:
            write_tiff(folder / "data_share.tif", result.data_share, grid)
        if options.fill_radius:
            image, mask = fill_holes(result.picture, options.fill_radius)
            write_tiff(folder / "filled.tif", image, grid, detectors)
            write_tiff(folder / "fill.tif", mask.astype(np.uint8), grid)
        if result.defects:
            write_tiff(folder / "affected.tif", result.affected.astype(np.uint8), grid)
        write_motion(folder / "motion.h5", result.motion, grid)
        if result.sample_motion is not None and result.sample_motion.moving:
            write_sample_motion(folder / "sample_motion.csv", result.sample_motion, result.intensity, grid)
        write_json(folder / "summary.json", summary)
        save_picture(folder / "image.png", result.picture, result.affected, options.fill_radius)
        (folder / "report.html").write_text(
            reconstruction_report(result, summary, options.fill_radius), encoding="utf-8"
        )
    return summary


def format_summary(summary: dict[str, Any]) -> str:
    if "recordings" in summary:
        from recon.cli.reconstruct_many import format_summary as format_many

        return format_many(summary)
    from recon.report.conclusions import condition_on_clock, describe_stack

    lines = [
        summary["conclusion"],
        f"{summary['output']}: {summary['estimator']}, {summary['samples']} samples, fill {summary['fill']:.1%}",
    ]
    condition = condition_on_clock(summary)
    lines += [_format_axis(name, summary[name], condition) for name in summary["axes"]]
    if summary["stack"]:
        lines.append(f"  {describe_stack(summary['stack'])}")
    if "live" in summary:
        lines.append(_format_live(summary["live"]))
    lines += [f"  {note}" for note in summary["notes"]]
    lines.append(f"  picture {summary['output']}/image.png, report {summary['output']}/report.html")
    return "\n".join(lines)


def _format_axis(name: str, axis: Mapping[str, Any], condition: str) -> str:
    from recon.report.conclusions import describe_slices

    line = f"  {name}: phase ±{axis['phase_sd_deg']:.3f}° (1 sd{condition})"
    line += f", bound {axis['bound_deg']:.3f}° satisfied for {axis['within_bound']:.1%} of the scan"
    if "phase_rmse_deg" in axis:
        line += f", true error {axis['phase_rmse_deg']:.3f}° rms"
    measured = axis["picture_phase_error_deg"]
    if measured["sd"] is not None:
        line += f", phase error measured in the picture {measured['value']:+.3f}° ± {measured['sd']:.3f}°"
        line += describe_slices(measured)
    line += f", amplitude {axis['amplitude_rad']:.4g} rad{_format_amplitude_sd(axis)}"
    if axis["amplitude_um"] is not None:
        line += f", {axis['amplitude_um']:.4g} µm on the sample"
    return f"{line}; sign {axis['sign']}"


def _format_amplitude_sd(axis: Mapping[str, Any]) -> str:
    sd, calibration = axis["amplitude_sd_rad"], axis["amplitude_sd_calibration_rad"]
    if axis["amplitude_from"] == "field":
        return " (the half angle of [scan], as the edges do not determine it)"
    if sd is None:
        return " (scale not known)"
    if axis["amplitude_from"] == "edges":
        return f" ± {sd:.2g} (by the stated angle of the detector, taken as exact)"
    return f" ± {sd:.2g} (calibration {calibration:.2g})"


def _format_live(live: Mapping[str, Any]) -> str:
    line = f"  live: {counted(live['frames'], 'frame')} of {1e3 * (live['frame_s'] or 0.0):.4g} ms"
    line += f", {live['dropped']} dropped"
    if live["frames"]:
        line += f", {live['latency_s']['median']:.2f} s late (at most {live['latency_s']['max']:.2f} s)"
    return f"{line}; {live['ended']}"
