"""The program of `make demo`: simulate a drifting scan, reconstruct it in five ways, print where the report is.

python examples/demo.py [FOLDER]
"""

import json
import sys
import time
from pathlib import Path

import afm_spiral

import lissajous
from recon.evaluation import load_truth
from recon.io.output import finite, replacing_folder
from recon.pipeline import reconstruct
from recon.report.comparison import comparison_report, upright_picture
from recon.report.figures import data_uri, save_picture
from recon.report.page import Figure, Section
from recon.report.summary import summarise
from recon.steps.reconstruction import Options
from scanner.recording import Recording

SPIRAL = Path(__file__).parent.parent.parent / "shared" / "data" / "afm_spiral"
ESTIMATORS = {"constant phase": "constant", "EKF": "ekf", "UKF": "ukf", "tracker": "tracker"}
LEAD = (
    "A tissue picture under a resonant scanner, both axes on one electrode, 400 × 400 pixels, 60 ms at 5 MS/s. Both "
    "mirrors soften by 0.2 %, which changes their phases by 5 degrees; the bound is 0.286°."
)


def main(folder: Path) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    began = time.perf_counter()
    scan = folder / "scan.h5"
    print("simulating a scan of 60 ms (compiled once, at the first run) ...", file=sys.stderr)
    lissajous.simulate(seed=1).write(scan)
    known = load_truth(scan)
    results = {}
    with Recording.open(scan) as recording:
        for name, estimator in ESTIMATORS.items():
            print(f"reconstructing: {name} ...", file=sys.stderr)
            results[name] = reconstruct(recording, Options(estimator=estimator), known)
        # The true motion: the same recording with its true angles as reference channels.
        channels = {name: (c.read(), c.unit, c.sample_rate, c.start) for name, c in recording.channels.items()}
        channels |= {f"angle_{axis}": (values, "rad", rate, t0) for axis, (values, rate, t0) in known.angles.items()}
        with_angles = Recording.from_arrays(channels, recording.device, name="true motion")
        results["true motion"] = reconstruct(with_angles, Options(estimator="sensor"), known)
    summaries = {name: finite(summarise(result)) for name, result in results.items()}
    further = [measured_spiral(folder / "afm_spiral")] if SPIRAL.is_dir() else []
    with replacing_folder(folder) as beside:
        page = comparison_report(
            "Lissajous: from a drifting scan to a sharp picture", LEAD, results, summaries, further
        )
        (beside / "report.html").write_text(page, encoding="utf-8")
        (beside / "summary.json").write_text(json.dumps(summaries, indent=1), encoding="utf-8")
        for name, result in results.items():
            save_picture(beside / f"{name.replace(' ', '-').lower()}.png", upright_picture(result))
    for name, summary in summaries.items():
        x, y, ratio = summary["x"], summary["y"], summary["picture"]["rms"] / summaries["true motion"]["picture"]["rms"]
        print(
            f"{name:>14}: phase error {x['phase_rmse_deg']:.3f}° x, {y['phase_rmse_deg']:.3f}° y; within the bound "
            f"{x['within_bound']:.1%}, {y['within_bound']:.1%}; picture error {ratio:.2f} × that of the true motion"
        )
    print(
        f"picture: {folder / 'tracker.png'}\nreport:  {folder / 'report.html'}   ({time.perf_counter() - began:.1f} s)"
    )


def measured_spiral(folder: Path) -> Section:
    """Section of the report on the AFM's spiral, reconstructed from its sensors and from the command."""
    print("reconstructing the measured AFM spiral ...", file=sys.stderr)
    afm_spiral.main(SPIRAL, folder)
    drawing = Figure(
        data_uri((folder / "afm_spiral.png").read_bytes()), "from the position sensors, as commanded, raster scan"
    )
    text = (
        "An atomic-force microscope's spiral over a grating of 3 µm pitch, gridded at the positions of its sensors and "
        "at the commanded positions, and the raster scan of the same sample."
    )
    return Section("Measured: an AFM spiral", text, figures=[drawing], least="40rem")


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "demo-output"))
