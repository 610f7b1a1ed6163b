"""``diagnose`` on files: recordings in, diagnosis, improved device and report out."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from recon.convert import open_any
from recon.output import check_folder, replacing_folder
from scanner.device import Device
from scanner.recording import Recording

if TYPE_CHECKING:
    from estimation.mismatch.diagnosis import Diagnosis

Progress = Callable[[str], None]


def diagnose_files(
    paths: Sequence[Path],
    output: Path,
    device: Path | None = None,
    mapping: Path | None = None,
    quiet: bool = False,
) -> dict[str, Any]:
    """Diagnose recordings of one device; write diagnosis.json, device.toml and report.html into ``output``.

    Args:
        mapping: what makes instruments' files recordings, see :func:`recon.convert.open_any`.

    Raises:
        BadInput: a recording or the device cannot be used.
    """
    from tqdm import tqdm

    from recon.diagnosis_report import diagnosis_report

    check_folder(output)
    began = time.perf_counter()
    with ExitStack() as stack:
        recordings = [stack.enter_context(open_any(path, mapping)) for path in paths]
        nominal = Device.load(device) if device is not None else None
        with tqdm(disable=quiet, bar_format="{elapsed} {desc}", leave=False) as bar:
            diagnosis = diagnose_all(recordings, nominal, bar.set_description_str)
            bar.set_description_str("report")
            page = diagnosis_report(diagnosis, [recording.name for recording in recordings])
        content = diagnosis.to_json()
        with replacing_folder(output) as folder:
            (folder / "diagnosis.json").write_text(
                json.dumps(content, indent=1, ensure_ascii=False) + "\n", encoding="utf-8"
            )
            (folder / "device.toml").write_text(diagnosis.device.to_toml(), encoding="utf-8")
            (folder / "report.html").write_text(page, encoding="utf-8")
    return content | {"output": str(output), "seconds": time.perf_counter() - began}


def diagnose_all(
    recordings: Sequence[Recording], device: Device | None = None, say: Progress = lambda text: None
) -> Diagnosis:
    """Drive to readout against the device, then the optics of every recording with an intensity against themselves.

    A device that states no mechanics predicts no motion: of its recordings the optics alone are judged.

    Raises:
        BadInput: as ``estimation.mismatch.diagnosis.diagnose``.
    """
    from estimation.mismatch.diagnosis import Diagnosis, diagnose

    nominal = device or recordings[0].device
    pictures = [recording for recording in recordings if "intensity" in recording]
    if nominal is None or not pictures or any(axis.mechanics for axis in nominal.axes.values()):
        diagnosis = diagnose(recordings, device, say)
    else:
        diagnosis = Diagnosis("consistent", (), None, nominal, None)
    for recording in pictures:
        if set(diagnosis.device.axes) == {"x", "y"}:
            say(f"optics of {recording.name}")
            diagnosis = with_optics(diagnosis, recording)
    return diagnosis


def with_optics(diagnosis: Diagnosis, recording: Recording) -> Diagnosis:
    """The diagnosis with what the picture of one recording says of the optics of the device as improved so far."""
    from estimation.estimate import estimate
    from recon.optics import judge_optics
    from recon.undo import placed, with_light

    device = diagnosis.device
    lit = with_light(recording, device)
    motion = placed(estimate(lit, device), device, lit.start)
    judged = judge_optics(motion, lit["intensity"], device)
    axes = {
        name: replace(axis, terms={**axis.terms, **judged.terms.get(name, {})}) for name, axis in device.axes.items()
    }
    return replace(
        diagnosis,
        verdict="mismatch" if judged.findings else diagnosis.verdict,
        findings=(*diagnosis.findings, *judged.findings),
        device=replace(device, axes=axes),
        optics=(*diagnosis.optics, {"recording": recording.name, "effects": judged.to_json()}),
    )
