"""Processor time of ``--follow`` by frame: after the last sample until image.tif is in place, before it, and after it.

Unlike the latency of ``python -m benchmarks.scale live`` it does not depend on other programs that run meanwhile.
Run: python -m benchmarks.live_cpu RECORDING [--frame-time 0.1] [--pixels 400 256], for instance with a recording of
``lissajous simulate --duration 1``. The first two frames, which compile and search, are left out.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from itertools import pairwise
from pathlib import Path

import numpy as np

from recon.imaging.scan_phase.bidirectional_phase import slow_period
from recon.live.live_frames import (
    FrameSums,
    LiveScan,
    add_part,
    finish_frame,
    first_picture,
    part_edges,
    replace_display_and_sd,
    replace_picture,
)
from recon.steps.reconstruction import Options
from scanner.recording import Recording


def measure_frame(
    recording: Recording, start: float, stop: float, scan: LiveScan | None, options: Options, folder: Path
) -> tuple[LiveScan, list[float]]:
    """Reconstruct a frame; return the scan, and processor times before its last part, from there to image.tif, and
    after that [s]."""
    edges = part_edges(start, stop, slow_period(scan.motion)) if scan else [start, stop]
    frame: FrameSums | None = None
    times = [time.process_time()] * 2
    for begin, end in pairwise(edges):
        times[1] = time.process_time()
        scan, frame = add_part(recording, begin, end, scan, frame, options)
    assert scan is not None
    assert frame is not None
    picture = first_picture(scan, frame, options)
    if picture is not None:
        replace_picture(folder, picture)
    times.append(time.process_time())
    scan = finish_frame(scan, frame, options)
    assert scan.estimate is not None
    replace_display_and_sd(folder, scan.estimate)
    times.append(time.process_time())
    return scan, np.diff(times).tolist()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recording", type=Path)
    parser.add_argument("--frame-time", type=float, default=0.1)
    parser.add_argument("--pixels", type=int, nargs="+", default=[400, 256])
    args = parser.parse_args()
    print("| picture | pixels | before the last part | last sample to image.tif, median (largest) | after | frames |")
    print("|---|---|---|---|---|---|")
    for width in args.pixels:
        for kind in ("mean", "kernel"):
            options, scan, times = Options(picture=kind, pixels=(width, width)), None, []
            with Recording.open(args.recording) as recording, tempfile.TemporaryDirectory() as folder:
                for number in range(round(recording.duration / args.frame_time)):
                    start = recording.start + number * args.frame_time
                    stop = start + args.frame_time
                    scan, used = measure_frame(recording, start, stop, scan, options, Path(folder))
                    times.append(used)
            before, last, after = 1e3 * np.array(times[2:]).T
            print(
                f"| {kind} | {width} | {np.median(before):.0f} ms | {np.median(last):.0f} ms ({last.max():.0f}) "
                f"| {np.median(after):.0f} ms | {last.size} |"
            )


if __name__ == "__main__":
    main()
