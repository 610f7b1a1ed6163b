"""The architecture: imports run downward only, estimators cannot reach the simulator, tests mirror the packages."""

import ast
from collections.abc import Iterable, Iterator
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent.parent
MAY_IMPORT = {
    "scanner": {"scanner"},
    "phantoms": {"scanner", "phantoms"},
    "estimation": {"scanner", "estimation"},
    "recon": {"scanner", "phantoms", "estimation", "recon"},
    "lissajous": {"scanner", "phantoms", "estimation", "recon", "lissajous"},
    "benchmarks/blind": {"benchmarks.blind"},
}
"""Which of the project's own packages a package may import. The blind benchmark shares no code with what it judges."""
PACKAGES = ("scanner", "phantoms", "estimation", "recon", "lissajous")
TEST_FOLDERS_BESIDE_PACKAGES = {"support", "system"}
"""``support`` holds helpers, ``system`` tests of several packages or of the whole program."""


def imported_modules(path: Path) -> Iterator[str]:
    """Full names of all that a file imports; of ``from a import b`` both a and a.b, since b may be a module."""
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module:
            assert node.level == 0, f"{path}: relative import"
            yield node.module
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


def project_package(module: str) -> str | None:
    """The package of the project that a module belongs to, None for a library."""
    first, *rest = module.split(".")
    if first in {"benchmarks", "tests"}:
        return ".".join([first, *rest[:1]])
    return first if first in PACKAGES else None


def python_files(folder: Path) -> list[Path]:
    files = list(folder.rglob("*.py"))
    assert files
    return files


def violations(files: Iterable[Path], allowed: set[str]) -> dict[str, list[str]]:
    """By file, the project's packages that it imports and may not."""
    wrong = {}
    for file in files:
        packages = {project_package(module) for module in imported_modules(file)}
        if extra := sorted(package for package in packages - allowed - {None, "benchmarks"} if package):
            wrong[str(file.relative_to(ROOT))] = extra
    return wrong


@pytest.mark.parametrize("package", MAY_IMPORT)
def test_packages_import_only_what_stands_below_them(package: str) -> None:
    assert violations(python_files(ROOT / package), MAY_IMPORT[package]) == {}


@pytest.mark.parametrize("package", PACKAGES)
def test_folders_of_a_package_do_not_import_each_other_in_a_circle(package: str) -> None:
    """A folder is one node of the graph; so is a module beside the folders."""
    folders = {path.name for path in (ROOT / package).iterdir() if (path / "__init__.py").is_file()}
    graph: dict[str, set[str]] = {}
    for file in python_files(ROOT / package):
        inside = file.relative_to(ROOT / package).with_suffix("").parts
        if inside == ("__init__",):
            continue
        for module in imported_modules(file):
            parts = module.split(".")
            if parts[0] != package or len(parts) == 1 or parts[1] == inside[0]:
                continue
            if parts[1] in folders or (ROOT / package / f"{parts[1]}.py").is_file():
                graph.setdefault(inside[0], set()).add(parts[1])
    try:
        TopologicalSorter(graph).prepare()
    except CycleError as error:
        pytest.fail(" <- ".join(error.args[1]))


def test_no_test_imports_another_test_file() -> None:
    wrong = {
        str(file.relative_to(ROOT)): sorted(modules)
        for folder in ("tests", "benchmarks")
        for file in python_files(ROOT / folder)
        if (modules := {m for m in imported_modules(file) if m.startswith("tests.") and ".support" not in m})
    }
    assert wrong == {}


def test_test_folders_mirror_the_packages() -> None:
    folders = {file.parent.relative_to(ROOT / "tests") for file in (ROOT / "tests").rglob("test_*.py")}
    for folder in folders:
        assert folder.parts, "a test file is not in one of the folders"
        if folder.parts[0] not in TEST_FOLDERS_BESIDE_PACKAGES:
            assert (ROOT / folder / "__init__.py").is_file(), f"tests/{folder} mirrors no package"


def test_generated_source_imports_only_estimation() -> None:
    from estimation.filters.kernels import HEAD

    assert "phantoms" not in HEAD
    assert "recon" not in HEAD


def test_only_scoring_reads_the_truth() -> None:
    readers = {
        str(file.relative_to(ROOT))
        for package in ("estimation", "recon", "lissajous")
        for file in (ROOT / package).rglob("*.py")
        if "read_truth" in file.read_text(encoding="utf-8")
    }
    assert readers == {"recon/evaluation.py"}
