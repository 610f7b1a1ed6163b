"""Sphinx: the pages of this folder; gallery, catalogue and API are made from the sources."""

from __future__ import annotations

import html
import re
import sys
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from sphinx.application import Sphinx

    from scanner.terms import Term

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

project = "lissajous"
copyright = "MIT licence"
extensions = [
    "myst_parser",
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",
    "sphinx.ext.apidoc",
    "sphinx_gallery.gen_gallery",
]
html_theme = "furo"
html_title = "lissajous"
html_copy_source = False
html_show_sphinx = False
exclude_patterns = ["html", "api/*/modules.rst"]
suppress_warnings = ["ref.python"]  # two classes are named Figure; a signature that names one links to the first
smartquotes = False  # they would turn θ' into a quotation

myst_heading_anchors = 3

autodoc_member_order = "bysource"
autodoc_typehints = "signature"
autodoc_default_options = {"ignore-module-all": True}  # what a package passes on stands where it is defined
napoleon_use_ivar = True  # a dataclass has its attributes once, as its docstring tells them
apidoc_separate_modules = True
apidoc_module_first = True
apidoc_modules = [
    {"path": f"../{package}", "destination": f"api/{package}", "automodule_options": {"members", "show-inheritance"}}
    for package in ("scanner", "phantoms", "estimation", "recon")
]

sphinx_gallery_conf = {
    "examples_dirs": "../examples",
    "gallery_dirs": "gallery",
    "filename_pattern": r"/\d_\w+\.py$",
    "ignore_pattern": r"(^|/)[a-z]\w*\.py$",  # programs for measured data, which is not part of the project
    "within_subsection_order": "FileNameSortKey",
    "write_computation_times": False,
    "download_all_examples": False,
    "remove_config_comments": True,
    "show_memory": False,
    "min_reported_time": 1e9,
}


def written(equation: str) -> str:
    """An equation's text as HTML: ``_i`` and the number of a letter lowered, ``^(..)`` and ``^2`` raised."""
    text = html.escape(equation, quote=False)
    text = re.sub(r"_([A-Za-z0-9]+)|(?<=[A-Za-zα-ω])(\d)(?![A-Za-z0-9])", r"<sub>\1\2</sub>", text)
    return re.sub(r"\^(?:\(([^)]*)\)|(\d))", r"<sup>\1\2</sup>", text)


def entry(term: Term) -> str:
    """One effect of the catalogue, in Markdown."""
    units = ", ".join(f"`{p.name}`" + ("" if p.unit == "1" else f" [{written(p.unit)}]") for p in term.parameters)
    lines = [
        f"### {term.effect}",
        f'<p class="equation"><i>{written(term.equation)}</i></p>',
        f"Parameters: {units}. Source: {term.source}.",
        *(f"- Looks like [{other}](#{other}): {apart}." for other, apart in term.lookalikes.items()),
    ]
    return "\n\n".join(lines[:3]) + "\n\n" + "\n".join(lines[3:])


def with_catalogue(app: Sphinx, docname: str, source: list[str]) -> None:
    """The page ``catalogue`` goes on with every term, stage by stage, as the term files tell them."""
    if docname != "catalogue":
        return
    from scanner.terms import STAGES, catalogue

    for stage in STAGES:
        entries = [entry(term) for term in catalogue().values() if term.stage == stage]
        source[0] += "\n\n".join([f"\n## {stage.capitalize()}", *entries, ""])


def setup(app: Sphinx) -> None:
    app.connect("source-read", with_catalogue)
