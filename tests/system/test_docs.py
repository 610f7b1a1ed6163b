"""The documentation is built without a warning and contains every effect, module, example and table."""

from __future__ import annotations

import html
import re
import subprocess
import sys
from pathlib import Path

import pytest

from scanner.terms import STAGES, catalogue

ROOT = Path(__file__).parent.parent.parent


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The built pages. The gallery is not executed here: the notebooks' own tests do that."""
    folder = tmp_path_factory.mktemp("site")
    options = ["-W", "--keep-going", "-q", "-D", "plot_gallery=0", "-d", folder / "trees"]
    command = [sys.executable, "-m", "sphinx", *options, ROOT / "docs", folder / "html"]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return folder / "html"


def words(page: Path) -> str:
    """A page's text without its tags, white space as single blanks."""
    text = re.sub(r"<[^>]*>", "", page.read_text(encoding="utf-8"))
    return " ".join(html.unescape(text).split())


@pytest.mark.slow
def test_the_catalogue_contains_every_effect(site: Path) -> None:
    page = (site / "reference" / "catalogue.html").read_text(encoding="utf-8")
    text = words(site / "reference" / "catalogue.html")
    assert re.findall(r"<h2>(\w+)", page) == [stage.capitalize() for stage in STAGES]
    for effect, term in catalogue().items():
        assert f'id="{effect}"' in page
        assert " ".join(term.source.split()) in text
        assert " ".join(re.sub(r"_(?=\w)|\^\(.*?\)", "", term.equation).split())[:12] in text
        assert all(f"{p.name}" in text for p in term.parameters)
        assert all(f'href="#{other}"' in page and apart in text for other, apart in term.confounders.items())


@pytest.mark.slow
def test_equations_are_typeset(site: Path) -> None:
    page = (site / "reference" / "catalogue.html").read_text(encoding="utf-8")
    equations = re.findall(r'<p class="equation"><i>(.*?)</i></p>', page)
    assert len(equations) == len(catalogue())
    assert "J θ'' + b θ' + b<sub>3</sub> θ²θ' + k θ = τ" in equations
    assert "I(t) = L e<sup>-t/τ</sup>" in equations
    assert not any("_" in equation or "^" in equation for equation in equations)


@pytest.mark.slow
def test_every_page_module_and_example_is_reached_from_the_index(site: Path) -> None:
    index = (site / "index.html").read_text(encoding="utf-8")
    folder = ROOT / "docs"
    pages = {path.relative_to(folder).with_suffix("") for path in folder.rglob("*.md")} - {Path("index")}
    assert pages
    assert {page for page in pages if f'href="{page.as_posix()}.html"' not in index} == set()
    for package in ("lissajous", "scanner", "phantoms", "estimation", "recon"):
        for module in (ROOT / package).rglob("[!_]*.py"):
            *parents, stem = module.relative_to(ROOT).with_suffix("").parts
            page = site / "api" / package / f"{'.'.join(parents)}.html"
            assert f'id="module-{".".join(parents)}.{stem}"' in page.read_text(encoding="utf-8")
    gallery = (site / "gallery" / "index.html").read_text(encoding="utf-8")
    for script in (ROOT / "examples").glob("[0-9]_*.py"):
        assert f'href="{script.stem}.html' in gallery


@pytest.mark.slow
def test_the_pages_contain_the_generated_tables(site: Path) -> None:
    for name, content in (("commands", "--frame-time"), ("device", "theta_th"), ("python", "lissajous.reconstruct(")):
        page = (site / "reference" / f"{name}.html").read_text(encoding="utf-8")
        assert content in words(site / "reference" / f"{name}.html")
        assert "generated:" not in page


def test_explanations_name_functions_and_modules_that_exist() -> None:
    folders = ("scanner", "phantoms", "estimation", "recon", "lissajous", "benchmarks", "examples", "tests")
    sources = [path for folder in folders for path in (ROOT / folder).rglob("*.py")]
    known = set(re.findall(r"\w+", "\n".join(path.read_text(encoding="utf-8") for path in sources)))
    known |= {path.stem for path in sources}
    for page in sorted((ROOT / "docs" / "explanation").glob("*.md")):
        named = set(re.findall(r"`(?:[\w/]*/)?([A-Za-z]\w*_\w+)(?:\.py)?`", page.read_text(encoding="utf-8")))
        assert named <= known, f"{page.name}: {sorted(named - known)}"
