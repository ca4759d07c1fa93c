"""Recorded data that this project did not make: `../shared/data` beside the checkout, or $GRADETRACE_REAL_DATA."""

import os
from pathlib import Path

import pytest

BESIDE = Path(__file__).resolve().parents[3] / "shared" / "data"


@pytest.fixture(scope="session")
def real_data() -> Path:
    """The folder of recorded data; tests that ask for it are skipped where there is none."""
    folder = Path(os.environ.get("GRADETRACE_REAL_DATA") or BESIDE)
    if not folder.is_dir():
        pytest.skip("no recorded data: neither ../shared/data nor $GRADETRACE_REAL_DATA is there")
    return folder
