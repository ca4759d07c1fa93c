"""Drawn machines whose calibration logs are rendered and searched as the commands do it, several at a time."""

from __future__ import annotations

import multiprocessing
import os
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeVar

from pipeline.stages.calibration_log import CalibrationLog, searched
from pipeline.synthetic.calibration_log import record_calibration
from pipeline.synthetic.calibration_sites import CalibrationSite, calibration_site

T = TypeVar("T")


class Quiet:
    """Nobody watches."""

    @contextmanager
    def stage(self, stage: str, why: str) -> Iterator[Quiet]:
        yield self

    def done(self, stage: str, manifest: dict[str, Any], ran: bool) -> None:
        pass

    def total(self, amount: int, unit: str = "") -> None:
        pass

    def advance(self, amount: int = 1) -> None:
        pass

    def warn(self, sentence: str) -> None:
        pass


@contextmanager
def recorded(name: str, seed: int) -> Iterator[tuple[CalibrationSite, CalibrationLog]]:
    """A machine as it was drawn, and its log as `gradetrace sample-logs --site NAME` writes it, searched."""
    with tempfile.TemporaryDirectory() as folder:
        log = record_calibration(name, seed, Path(folder), jobs=1)
        with searched(log, None, None, Path(folder) / "runs", 1, Quiet()) as found:
            yield calibration_site(name, seed), found


def drawn(one: Callable[[int], T], draws: int, first: int = 0) -> list[T]:
    """What ``one`` makes of each seed, on every core. It has to be a function of a module."""
    with multiprocessing.get_context("spawn").Pool(min(os.cpu_count() or 1, draws)) as pool:
        return list(pool.imap(one, range(first, first + draws)))
