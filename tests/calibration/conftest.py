"""What tests of calibrations share."""

import pytest

from pipeline.calibration import mounts
from pipeline.estimation.repeated import WHITE


@pytest.fixture
def white_corners(monkeypatch):
    """Drawn corners have no errors that come back; the calibration of mounts takes them so."""
    plain = mounts.adjusted
    monkeypatch.setattr(mounts, "adjusted", lambda *a, **k: plain(*a, **k, repeated=WHITE))
