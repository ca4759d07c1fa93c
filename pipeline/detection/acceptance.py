"""Which of the tags seen in a picture are believed, and why the others are not.

The refinement has its own reasons, `refine.REASONS`; those of decoding and of what is described join them here.
"""

from __future__ import annotations

from collections.abc import Mapping, Set

import numpy as np

from pipeline.config.site import DetectionSettings
from pipeline.detection.prints import hamming_limit
from pipeline.detection.refine import MISFIT, NO_CONTRAST
from pipeline.detection.seen import Seen

ACCEPTED = "accepted"
UNKNOWN_ID = "unknown id"
BIT_ERRORS = "bit errors"
LOW_MARGIN = "low margin"
TWICE = "twice in one frame"

POOR_RIVAL = 0.5
"""Part of a clean tag's margin under which another of the same id, with corrected bits, is a mistake."""

ON_IT = 0.5
"""Sides between the middles of two tags under which they are at one place."""

KnownTags = Mapping[str, Set[int]]
"""Family -> ids that machine.toml and site.toml describe."""


def judge(
    seen: Seen, known: KnownTags, settings: DetectionSettings, picture: np.ndarray | None = None
) -> np.ndarray:
    """The status of each tag: ``accepted``, or the reason why not.

    Parameters
    ----------
    seen : Seen
        n tags, as the refinement left them.
    known : mapping
        Family -> ids that are described.
    settings : DetectionSettings
        Margin and bit errors that are let pass.
    picture : (n,) int array, optional
        Which picture each tag is in; without it all are in one.

    Returns
    -------
    (n,) object array of strings
    """
    if not len(seen):
        return np.empty(0, object)
    described = np.array(
        [
            number in known.get(family, ())
            for family, number in zip(seen.family.tolist(), seen.tag_id.tolist())
        ]
    )
    # From the mildest reason to the gravest: the gravest is the one that is told.
    status = np.where(seen.reason == "", ACCEPTED, seen.reason)
    status[_doubled(seen, settings, picture)] = TWICE
    status[seen.margin < settings.min_margin] = LOW_MARGIN
    status[seen.hamming > hamming_limits(seen, settings)] = BIT_ERRORS
    status[~described] = UNKNOWN_ID
    return status


def ghosts(seen: Seen, status: np.ndarray, picture: np.ndarray) -> np.ndarray:
    """(n,) bool: rows that following took for a covered tag, and that are another tag or the same one elsewhere.

    A print that was lost behind something may fit the next print of a board as a covered one does, frame after frame:
    of 88 tags that were told as covered in the sample 70 lay on another tag that was accepted.
    """
    found = np.zeros(len(seen), bool)
    good = status == ACCEPTED
    doubtful = ~good & ~seen.decoded & (seen.reason != "")
    for frame in np.unique(picture[doubtful]).tolist():
        there = np.flatnonzero(good & (picture == frame))
        if not len(there):
            continue
        for k in np.flatnonzero(doubtful & (picture == frame)):
            same = (seen.tag_id[there] == seen.tag_id[k]) & (seen.family[there] == seen.family[k])
            away = np.linalg.norm(seen.centre[there] - seen.centre[k], axis=1)
            found[k] = bool(np.any(same | (away < ON_IT * seen.side_px[there])))
    return found


def hamming_limits(seen: Seen, settings: DetectionSettings) -> np.ndarray:
    """(n,) int, bits that may have been corrected in each tag: fewer than the settings say where codes are short."""
    limits = {
        family: min(settings.max_hamming, hamming_limit(family)) for family in set(seen.family.tolist())
    }
    return np.array([limits[family] for family in seen.family.tolist()], int)


def _doubled(seen: Seen, settings: DetectionSettings, picture: np.ndarray | None) -> np.ndarray:
    """Whether another tag of the same family and id is in the same picture: then neither can be told apart.

    The two files never describe a tag twice (`config.prints`), so there are no two that belong there. A poor decoding
    does not count: it is more likely a mistake than a second print. Poor is what would be refused by itself, and also
    what had bits corrected and not half the margin of one that had none; that one is refused and the other stays. By
    margin alone nothing is decided: of two real prints the one in the shade may be the one that was surveyed.
    What the refinement cannot lay the print over is no second print either, nor a place that only looks like the tag
    covered and that no search has decoded: following had taken the next print of a board for it.
    """
    doubled = np.zeros(len(seen), bool)
    # A tag that was followed has no margin.
    sound = ~(seen.margin < settings.min_margin) & (seen.hamming <= hamming_limits(seen, settings))
    sound &= (seen.reason != MISFIT) & (seen.reason != NO_CONTRAST)
    sound &= (seen.reason == "") | seen.decoded
    places: dict[tuple[int, str, int], list[int]] = {}
    where = np.zeros(len(seen), int) if picture is None else picture
    names = zip(where.tolist(), seen.family.tolist(), seen.tag_id.tolist(), strict=True)
    for k, (name, one) in enumerate(zip(names, sound.tolist())):
        if one:
            places.setdefault(name, []).append(k)
    for rows in places.values():
        if len(rows) == 1:
            continue
        clean = [k for k in rows if seen.hamming[k] == 0]
        doubled[rows] = True
        if len(clean) == 1:
            best = clean[0]
            others = [seen.margin[k] for k in rows if k != best]
            doubled[best] = max(others) >= POOR_RIVAL * seen.margin[best]
    return doubled
