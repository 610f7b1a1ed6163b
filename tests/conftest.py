"""Shared by all tests."""

import os
import signal
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # as the command line does

import hypothesis
import pytest

# A shell that starts a job in the background has it, and all that it starts, ignore interrupts.
signal.signal(signal.SIGINT, signal.default_int_handler)

# The first call of a compiled function takes seconds; examples are the same in every run.
hypothesis.settings.register_profile("house", deadline=None, derandomize=True, max_examples=50)
hypothesis.settings.load_profile("house")

DATA = Path(__file__).parent.parent.parent / "shared" / "data"


@pytest.fixture(scope="session")
def measured_data() -> Path:
    """Folder of measured data; a test that asks for it is skipped, and says so, where the folder is absent."""
    if not DATA.is_dir():
        pytest.skip(f"no measured data at {DATA}")
    return DATA
