"""One sentence of the look at a log before a report."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

Level = Literal["ok", "warning", "error"]


@dataclass(frozen=True)
class Finding:
    """One sentence about the log, with what to do where something is amiss."""

    level: Level
    sentence: str
