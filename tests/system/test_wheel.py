"""The wheel is complete, and a missing optional package is reported with its install command."""

import subprocess
import sys
import tomllib
import zipfile
from importlib.metadata import distributions
from pathlib import Path

import pytest
from packaging.specifiers import SpecifierSet

from recon.cli import main

ROOT = Path(__file__).parent.parent.parent
PACKAGES = ("scanner", "phantoms", "estimation", "recon", "lissajous")


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> zipfile.ZipFile:
    """Built without the network, by the backend that the environment has."""
    folder = tmp_path_factory.mktemp("wheel")
    build = [sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", str(folder)]
    subprocess.run(build, cwd=ROOT, check=True, capture_output=True)
    (path,) = folder.glob("lissajous-*.whl")
    return zipfile.ZipFile(path)


def test_the_wheel_contains_every_file_of_the_packages(wheel: zipfile.ZipFile) -> None:
    suffixes = {".py", ".toml", ".yaml", ".html", ".js", ".typed"}
    expected = {path for name in PACKAGES for path in (ROOT / name).rglob("*") if path.suffix in suffixes}
    names = {name for name in wheel.namelist() if ".dist-info/" not in name}
    assert names == {path.relative_to(ROOT).as_posix() for path in expected}
    assert {f"{name}/py.typed" for name in PACKAGES} <= names
    templates = {f"recon/report/templates/{name}" for name in ("report.html", "sweeps.js")}
    assert {"scanner/devices/imaging.toml", *templates} <= names


def test_every_locked_package_runs_on_the_oldest_supported_python() -> None:
    """A release may ask for 3.11.5; a version 3.11.2 then cannot install the lock file."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    oldest = project["requires-python"].removeprefix(">=") + ".0"
    locked = {line.partition("==")[0].replace("_", "-") for line in (ROOT / "requirements.lock").read_text().split()}
    found = {d.name.replace("_", "-"): d.metadata for d in distributions() if d.name.replace("_", "-") in locked}
    assert len(found) > 0.9 * len(locked)
    required = {name: data["Requires-Python"] for name, data in found.items() if "Requires-Python" in data}
    assert {name: text for name, text in required.items() if not SpecifierSet(text).contains(oldest)} == {}


def test_the_wheel_has_the_commands_the_extras_and_the_licence(wheel: zipfile.ZipFile) -> None:
    metadata = {Path(name).name: wheel.read(name).decode() for name in wheel.namelist() if ".dist-info/" in name}
    assert "lissajous = recon.cli:main" in metadata["entry_points.txt"]
    assert "reconstruct-from-recording = recon.cli:reconstruct_main" in metadata["entry_points.txt"]
    assert "Requires-Python: >=3.11" in metadata["METADATA"]
    assert all(f"Provides-Extra: {extra}" in metadata["METADATA"] for extra in ("tdms", "scope", "dask", "parquet"))
    assert "MIT" in metadata["LICENSE"]


@pytest.mark.parametrize(
    ("arguments", "package", "extra"),
    [
        (["info", "file.tdms"], "nptdms", "tdms"),
        (["info", "file.wfm"], "RigolWFM.wfm", "scope"),
        (["blur-study", "study.toml", "-o", "out", "--scheduler", "tcp://127.0.0.1:9"], "distributed", "dask"),
        (["blur-study", "study.toml", "-o", "out", "--parquet"], "pyarrow", "parquet"),
    ],
)
def test_a_command_names_the_missing_extra(
    arguments: list[str], package: str, extra: str,
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture,
) -> None:  # fmt: skip
    monkeypatch.chdir(tmp_path)
    (tmp_path / "study.toml").write_bytes((ROOT / "examples" / "study.toml").read_bytes())
    for name in ("file.tdms", "file.wfm"):
        (tmp_path / name).write_text("x")
    monkeypatch.setitem(sys.modules, package, None)
    assert main(arguments) == 2
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 1
    assert f"pip install 'lissajous[{extra}]'" in lines[0]
    assert not (tmp_path / "out").exists()
