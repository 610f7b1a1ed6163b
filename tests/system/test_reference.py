"""The reference contains every key and option that the program accepts, and the examples on its pages are valid."""

from __future__ import annotations

import argparse
import dataclasses
import importlib.util
import json
import re
import shlex
import subprocess
import sys
import tomllib
from pathlib import Path
from types import ModuleType

import h5py
import pytest

import lissajous
from estimation.diagnosis import diagnose, finding
from estimation.estimators import estimators
from recon import experiment_planning
from recon.cli import COMMANDS, main
from recon.io import convert, mapped_channel
from recon.io.readers import readers
from recon.study import plan, table
from scanner.channel import AMPLITUDE_CHANNELS, CHANNEL_UNITS
from scanner.device import Device
from scanner.edges import EDGE_CHANNELS
from scanner.stages import READOUTS, Capacitance, Drive, Mechanics, Scan
from tests.support import two_axis_scan
from tests.support.simulated import imaging

ROOT = Path(__file__).parent.parent.parent
DOCS = ROOT / "docs"
PAGES = sorted(DOCS.rglob("*.md"))


@pytest.fixture(scope="module")
def tables() -> ModuleType:
    """The module that makes the generated tables."""
    spec = importlib.util.spec_from_file_location("generated_tables", DOCS / "generated_tables.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def page(name: str) -> str:
    return (DOCS / "reference" / f"{name}.md").read_text(encoding="utf-8")


def missing(names: object, text: str) -> list[str]:
    """Names that the text does not contain in backquotes."""
    return [str(name) for name in names if f"`{name}`" not in text]  # type: ignore[attr-defined]


def parser_of(name: str) -> argparse.ArgumentParser:
    from recon.cli import add_command

    parser = argparse.ArgumentParser(add_help=False)
    add_command(name, parser)
    return parser


@pytest.mark.parametrize("name", COMMANDS)
def test_every_option_is_in_the_reference(name: str, tables: ModuleType) -> None:
    text = tables.with_tables(page("commands"))
    section = text.partition(f"## `lissajous {name}`")[2].partition("\n## ")[0]
    options = [option for action in parser_of(name)._actions for option in action.option_strings]
    assert "--json" in options
    assert missing(options, section) == []


def test_every_key_of_a_device_is_in_the_reference(tables: ModuleType) -> None:
    text = tables.with_tables(page("device"))
    for record in (Mechanics, Capacitance, Drive, Scan, *READOUTS.values()):
        assert missing((item.name for item in dataclasses.fields(record)), text) == []
    assert all(f'kind = "{kind}"' in text for kind in READOUTS)
    assert all(f'"{kind}"' in text for kind in Drive.KINDS)
    keys_of_device = {item.name for item in dataclasses.fields(Device)} - {
        "axes",
        "shared_tolerance",
        "extra",
        "source",
    }
    assert all(f"`{name}`" in text or f"[{name}]" in text for name in keys_of_device)


def test_every_channel_format_and_mapping_key_is_in_the_reference() -> None:
    assert missing((*CHANNEL_UNITS, *EDGE_CHANNELS, *AMPLITUDE_CHANNELS, "intensity"), page("recording")) == []
    assert (
        missing(
            (*readers(), *convert.TEXT_KEYS, *mapped_channel.CHANNEL_KEYS, *mapped_channel.EDGE_KEYS),
            page("instrument_files"),
        )
        == []
    )


def test_every_estimator_is_in_the_reference(tables: ModuleType) -> None:
    assert missing(estimators(), tables.with_tables(page("estimators"))) == []
    assert set(tables.DEMO_PHASE_ERRORS) <= set(estimators())


def test_every_public_name_is_in_the_reference() -> None:
    assert [name for name in lissajous.__all__ if not re.search(rf"\b{name}\b", page("python"))] == []


def test_every_key_of_studies_and_excitations_is_in_the_reference() -> None:
    text = page("study")
    for record in (plan.Study, plan.StudyDesign, plan.Conditions):
        assert missing((item.name for item in dataclasses.fields(record) if item.name != "recording"), text) in (
            [],
            ["designs"],
        )
    assert missing(experiment_planning.EXCITATION_KINDS, text) == []
    assert all(f"`{key}`" in text for keys in experiment_planning.EXCITATION_KINDS.values() for key in keys)


def keys(content: object) -> set[str]:
    """Keys of nested tables."""
    if isinstance(content, list):
        return set().union(*map(keys, content))
    if not isinstance(content, dict):
        return set()
    nested = (keys(value) for key, value in content.items() if key not in ("seconds_to_fill", "terms"))
    return set(content).union(*nested)


@pytest.mark.slow
def test_every_key_of_a_reconstruction_and_a_prediction_is_in_the_reference(
    tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    recording, truth = imaging()
    recording.write(tmp_path / "scan.h5", truth)
    assert main(["reconstruct", str(tmp_path / "scan.h5"), "-o", str(tmp_path / "out"), "--pixels", "60x60"]) == 0
    assert main(["predict", str(tmp_path / "scan.h5"), "-o", str(tmp_path / "predicted")]) == 0
    for folder in ("out", "predicted"):
        written = {path.name for path in (tmp_path / folder).iterdir()}
        assert missing(written, page("outputs")) == []
        summary = json.loads((tmp_path / folder / "summary.json").read_text(encoding="utf-8"))
        assert missing(keys(summary) - {"sense"}, page("outputs")) == []
    with h5py.File(tmp_path / "out" / "motion.h5") as file:
        assert missing({*file.attrs, *file, *file["x"], *file["x"].attrs}, page("outputs")) == []


@pytest.mark.parametrize("estimator", ["edges", "sine-ukf", "constant", "picture"])
def test_every_detail_of_an_estimator_is_in_the_reference(estimator: str) -> None:
    frequencies = two_axis_scan.FREQUENCIES_HZ.items()
    drives = "".join(f'[{a}.drive]\nkind = "linear"\nfrequency = {f}\n' for a, f in frequencies)
    device = Device.from_toml(two_axis_scan.READOUTS + two_axis_scan.FIELD + drives)
    channels = two_axis_scan.sensors(1) | two_axis_scan.edges(*map(two_axis_scan.crossings, "xy"))
    recording = lissajous.Recording.from_arrays(channels, device)
    info = lissajous.reconstruct(recording, estimator=estimator, pixels=(80, 80)).motion.info
    assert info
    assert missing(keys(info) - {"sync_x", "sync_y"}, page("outputs")) == []


def test_every_key_of_a_diagnosis_is_in_the_reference() -> None:
    records = (finding.Finding, finding.ParameterEstimate, finding.Rival)
    names = {item.name for record in records for item in dataclasses.fields(record)}
    device = Device.from_toml("[x.mechanics]\nJ = 1\nb = 1\nk = 1")
    names |= set(diagnose.Diagnosis("consistent", (), None, device, None).to_json())
    assert missing(names, page("outputs")) == []
    assert missing(table.COLUMN_NAMES, page("outputs")) == []


def blocks(language: str) -> list[tuple[str, str]]:
    """(page and number, content) of every fenced block of a language."""
    content_of_blocks = []
    for path in PAGES:
        texts = re.findall(rf"```{language}\n(.*?)```", path.read_text(encoding="utf-8"), re.DOTALL)
        content_of_blocks += [(f"{path.relative_to(DOCS)} {number}", text) for number, text in enumerate(texts)]
    assert content_of_blocks
    return content_of_blocks


@pytest.mark.parametrize(("where", "text"), blocks("toml"), ids=[where for where, _ in blocks("toml")])
def test_toml_blocks_on_pages_are_valid(where: str, text: str, tmp_path: Path) -> None:
    """The first line names the kind of file: a complete file, or a part of a device file."""
    kind = text.splitlines()[0].removeprefix("# ")
    (tmp_path / "file.toml").write_text(text, encoding="utf-8")
    content = tomllib.loads(text)
    if kind == "device.toml":
        device = Device.load(tmp_path / "file.toml")
        assert device.extra == {}
        assert all(axis.extra == {} for axis in device.axes.values())
        assert set(device.axes) == {"x", "y"}
        assert device.scan is not None
    elif kind == "part of a device file":
        assert all(axis.extra == {} for axis in Device.from_table(content).axes.values())
    elif kind == "mapping.toml":
        assert set(content) <= set(convert.MAPPING_KEYS)
        assert all(
            set(channel) <= {*mapped_channel.CHANNEL_KEYS, *mapped_channel.EDGE_KEYS}
            for channel in content["channels"].values()
        )
        Device.from_table(content["device"])
    elif kind == "study.toml":
        plan.read_study(tmp_path / "file.toml")
    else:
        assert kind == "excitation.toml"
        experiment_planning.read_excitation(tmp_path / "file.toml")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("where", "text"),
    [(where, text) for where, text in blocks("python") if "import lissajous\n" in text and "extending" not in where],
    ids=lambda value: value if "\n" not in value else "",
)
def test_python_on_a_page_runs(where: str, text: str, tmp_path: Path) -> None:
    recording, truth = imaging()
    recording.write(tmp_path / "scan.h5", truth)
    process = subprocess.run([sys.executable, "-c", text], cwd=tmp_path, capture_output=True, text=True)
    assert process.returncode == 0, process.stderr


def test_commands_on_pages_exist_and_take_their_options() -> None:
    """Every line of a block without a language that begins with a command parses as that command's arguments."""
    parsers = {name: parser_of(name) for name in COMMANDS}
    commands = 0
    for path in (*PAGES, ROOT / "README.md"):
        for line in shell_lines(path):
            words = shlex.split(line.partition(" #")[0])
            if words[:1] == ["reconstruct-from-recording"]:
                words = ["lissajous", "reconstruct", *words[1:]]
            if words[:1] == ["lissajous"] and not words[1].startswith("-") and len(words) > 2:
                parsers[words[1]].parse_args(words[2:])
                commands += 1
    assert commands > 25


def shell_lines(path: Path) -> list[str]:
    """Lines of the blocks without a language."""
    lines, language = [], None
    for line in path.read_text(encoding="utf-8").splitlines():
        if line.strip().startswith("```"):
            language = line.strip()[3:] if language is None else None
        elif language == "":
            lines.append(line.strip())
    return lines
