"""The house: imports run downward only, and estimators cannot reach the simulator."""

import ast
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
MAY_IMPORT = {
    "scanner": {"scanner"},
    "phantoms": {"scanner", "phantoms"},
    "estimation": {"scanner", "estimation"},
    "recon": {"scanner", "phantoms", "estimation", "recon"},
}


def imported_packages(path: Path) -> set[str]:
    names = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            names |= {alias.name.split(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            names.add(node.module.split(".")[0])
    return names & set(MAY_IMPORT)


@pytest.mark.parametrize("package", MAY_IMPORT)
def test_imports_run_downward_only(package: str) -> None:
    files = list((ROOT / package).rglob("*.py"))
    assert files
    wrong = {str(f.relative_to(ROOT)): sorted(imported_packages(f) - MAY_IMPORT[package]) for f in files}
    assert {name: extra for name, extra in wrong.items() if extra} == {}


def test_generated_source_imports_only_estimation() -> None:
    from estimation.kernels import HEAD

    assert "phantoms" not in HEAD
    assert "recon" not in HEAD


def test_only_scoring_reads_the_truth() -> None:
    readers = {
        str(f.relative_to(ROOT))
        for package in ("estimation", "recon")
        for f in (ROOT / package).rglob("*.py")
        if "read_truth" in f.read_text(encoding="utf-8")
    }
    assert readers == {"recon/score.py"}
