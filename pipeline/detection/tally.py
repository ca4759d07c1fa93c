"""What became of one camera's frames and tags, counted as the table `detections` is written."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from typing import Any

import numpy as np

from pipeline.config.site import DetectionSettings
from pipeline.detection.acceptance import ACCEPTED, UNKNOWN_ID
from pipeline.detection.stillness import Stillness, Tag, facts


class Tally:
    """Counts of one camera; portions come in time order, and memory does not grow with them.

    Parameters
    ----------
    settings : DetectionSettings
        Margin up to which an unknown id is more likely a mistake than a tag.
    """

    def __init__(self, settings: DetectionSettings) -> None:
        self.frames: Counter[str] = Counter()
        """Frames by outcome."""
        self.status: Counter[str] = Counter()
        """Tags by status."""
        self.how: Counter[str] = Counter()
        """Accepted tags by how they were found."""
        self.accepted: set[Tag] = set()
        """Tags that were accepted at all."""
        self.unknown: Counter[Tag] = Counter()
        """Well decoded tags that nothing describes."""
        self.stillness = Stillness()
        self._settings = settings

    def add(self, columns: Mapping[str, np.ndarray], frames: Mapping[str, int]) -> None:
        """Count the next rows of the table `detections`, and the frames by outcome that they came from."""
        status = columns["status"]
        self.frames.update(frames)
        self.status.update(status.tolist())
        if "how" in columns:
            self.how.update(columns["how"][status == ACCEPTED].tolist())
        used = status == ACCEPTED
        self.accepted.update(zip(columns["family"][used].tolist(), columns["tag_id"][used].tolist()))
        sure = (columns["hamming"] == 0) & (columns["margin"] >= self._settings.min_margin)
        good = (status == UNKNOWN_ID) & sure
        self.unknown.update(zip(columns["family"][good].tolist(), columns["tag_id"][good].tolist()))
        self.stillness.add(columns)

    def facts(self) -> dict[str, Any]:
        """This camera's part of detection.json."""
        return {
            "frames": dict(sorted(self.frames.items())),
            "tags": dict(sorted(self.status.items())),
            "how": dict(sorted(self.how.items())),
            "pixel_noise": facts(self.stillness),
        }
