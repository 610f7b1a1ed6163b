"""Sphinx configuration. The gallery, the tables of the reference and the API pages are made from the sources."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from sphinx.application import Sphinx

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / "docs")]

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
autodoc_default_options = {"ignore-module-all": True}  # a re-exported name is documented where it is defined
napoleon_use_ivar = True  # attributes of a dataclass are listed once, from its docstring
apidoc_separate_modules = False  # a page for each package; with one for each module, every sidebar lists hundreds
apidoc_module_first = True
apidoc_modules = [
    {"path": f"../{package}", "destination": f"api/{package}", "automodule_options": {"members", "show-inheritance"}}
    for package in ("lissajous", "scanner", "phantoms", "estimation", "recon")
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


def insert_tables(app: Sphinx, docname: str, source: list[str]) -> None:
    """Insert the generated tables into the pages that contain their names."""
    from generated_tables import with_tables

    source[0] = with_tables(source[0])


def setup(app: Sphinx) -> None:
    app.connect("source-read", insert_tables)
