"""Settings of every test run, and the fixture of measured data."""

import os
import signal
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # as the command line does

import hypothesis
import pytest

from tests.support.measured_data import MEASURED_DATA

# A shell makes its background jobs, and their children, ignore SIGINT. The interrupt tests need the default.
signal.signal(signal.SIGINT, signal.default_int_handler)

# The first call of a compiled function takes seconds, so there is no deadline. Examples are the same in every run.
hypothesis.settings.register_profile("lissajous", deadline=None, derandomize=True, max_examples=50)
hypothesis.settings.load_profile("lissajous")


@pytest.fixture(scope="session")
def measured_data() -> Path:
    """Folder of measured data. Where it is absent, tests that use it are skipped with that reason."""
    if not MEASURED_DATA.is_dir():
        pytest.skip(f"no measured data at {MEASURED_DATA}")
    return MEASURED_DATA
