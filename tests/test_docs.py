"""The documentation is built without a warning, and holds what it is to hold."""

from __future__ import annotations

import html
import re
import subprocess
import sys
from pathlib import Path

import pytest

from scanner.terms import STAGES, catalogue

ROOT = Path(__file__).parent.parent


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


def test_the_catalogue_holds_every_effect(site: Path) -> None:
    page = (site / "catalogue.html").read_text(encoding="utf-8")
    text = words(site / "catalogue.html")
    assert re.findall(r"<h2>(\w+)", page) == [stage.capitalize() for stage in STAGES]
    for effect, term in catalogue().items():
        assert f'id="{effect}"' in page
        assert " ".join(term.source.split()) in text
        assert " ".join(re.sub(r"_(?=\w)|\^\(.*?\)", "", term.equation).split())[:12] in text
        assert all(f"{p.name}" in text for p in term.parameters)
        assert all(f'href="#{other}"' in page and apart in text for other, apart in term.lookalikes.items())


def test_equations_are_set_not_quoted(site: Path) -> None:
    page = (site / "catalogue.html").read_text(encoding="utf-8")
    equations = re.findall(r'<p class="equation"><i>(.*?)</i></p>', page)
    assert len(equations) == len(catalogue())
    assert "J θ'' + b θ' + b<sub>3</sub> θ²θ' + k θ = τ" in equations
    assert "I(t) = L e<sup>-t/τ</sup>" in equations
    assert not any("_" in each or "^" in each for each in equations)


def test_every_page_module_and_example_is_reached_from_the_index(site: Path) -> None:
    index = (site / "index.html").read_text(encoding="utf-8")
    pages = {path.stem for path in (ROOT / "docs").glob("*.md")} - {"index"}
    assert {page for page in pages if f'href="{page}.html"' not in index} == set()
    for package in ("scanner", "phantoms", "estimation", "recon"):
        for module in (ROOT / package).glob("[!_]*.py"):
            page = site / "api" / package / f"{package}.{module.stem}.html"
            assert f'id="module-{package}.{module.stem}"' in page.read_text(encoding="utf-8")
    gallery = (site / "gallery" / "index.html").read_text(encoding="utf-8")
    for script in (ROOT / "examples").glob("[0-9]_*.py"):
        assert f'href="{script.stem}.html' in gallery
