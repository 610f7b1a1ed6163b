"""Searches of the diagnosis on recordings of the blind benchmark."""

from pathlib import Path

from benchmarks.blind.generator import BlindRecording, Case, generate_recording, write
from estimation.device_fit.data import prepare_run
from estimation.diagnosis.selection import SelectionResult, select_terms
from scanner.recording import Recording
from scanner.terms import catalogue


def search_blind_recording(
    case: Case, folder: Path, effects: tuple[str, ...]
) -> tuple[BlindRecording, SelectionResult]:
    """The blind recording of a case, and the result of a search among ``effects`` in it."""
    blind = generate_recording(case)
    write(blind, folder / f"{case.name}.h5")
    with Recording.open(folder / f"{case.name}.h5") as recording:
        run = prepare_run(recording, recording.device)
    return blind, select_terms([run], recording.device, {effect: catalogue()[effect] for effect in effects})
