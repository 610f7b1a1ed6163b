"""Arguments that several commands have."""

from __future__ import annotations

import argparse
from pathlib import Path


def add_source_arguments(parser: argparse.ArgumentParser) -> None:
    """``--mapping`` and ``--device``: what an instrument's file holds, and the device of the recording."""
    parser.add_argument("--mapping", type=Path, metavar="FILE", help="TOML: which variable is which channel")
    parser.add_argument(
        "--device", metavar="NAME|FILE", help="a named device or TOML file in place of the recording's own"
    )
