"""``diagnose`` on files: recordings in, diagnosis, improved device and report out."""

from __future__ import annotations

import json
import time
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from recon.convert import open_any
from recon.output import replacing_folder
from scanner.device import Device


def diagnose_files(
    paths: Sequence[Path],
    output: Path,
    device: Path | None = None,
    terms: Path | None = None,
    mapping: Path | None = None,
    quiet: bool = False,
) -> dict[str, Any]:
    """Diagnose recordings of one device; write diagnosis.json, device.toml and report.html into ``output``.

    Args:
        mapping: what makes instruments' files recordings, see :func:`recon.convert.open_any`.

    Raises:
        BadInput: a recording, the device or the term file cannot be used.
    """
    from tqdm import tqdm

    from estimation.mismatch.diagnosis import diagnose
    from recon.diagnosis_report import diagnosis_report
    from scanner.terms import register

    began = time.perf_counter()
    if terms is not None:
        register(terms)
    with ExitStack() as stack:
        recordings = [stack.enter_context(open_any(path, mapping)) for path in paths]
        nominal = Device.load(device) if device is not None else None
        with tqdm(disable=quiet, bar_format="{elapsed} {desc}", leave=False) as bar:
            diagnosis = diagnose(recordings, nominal, bar.set_description_str)
        content = diagnosis.to_json()
        names = [recording.name for recording in recordings]
        with replacing_folder(output) as folder:
            (folder / "diagnosis.json").write_text(
                json.dumps(content, indent=1, ensure_ascii=False) + "\n", encoding="utf-8"
            )
            (folder / "device.toml").write_text(diagnosis.device.to_toml(), encoding="utf-8")
            (folder / "report.html").write_text(diagnosis_report(diagnosis, names), encoding="utf-8")
    return content | {"output": str(output), "seconds": time.perf_counter() - began}
