"""Which of the tags found in a picture are believed, and why the others are not."""

from __future__ import annotations

from collections.abc import Mapping, Set

import numpy as np

from pipeline.config.site import DetectionSettings
from pipeline.detection.found import Found
from pipeline.detection.noise import widths_across
from pipeline.detection.prints import hamming_limit
from pipeline.detection.refine import MISFIT, NO_CONTRAST
from pipeline.detection.seen import Seen

ACCEPTED = "accepted"
UNKNOWN_ID = "unknown id"
BIT_ERRORS = "bit errors"
LOW_MARGIN = "low margin"
TOO_SMALL = "too small"
BORDER = "border"
TWICE = "twice in one frame"

BORDER_PX = 2.0
"""A corner this near to the border of the picture was fitted to edges that are cut off."""
MIN_WIDTH_PX = 8.0
"""Width across the narrow way below which the noise of a corner was not measured."""

POOR_RIVAL = 0.5
"""Part of a clean tag's margin under which another of the same id, with corrected bits, is a mistake."""

KnownTags = Mapping[str, Set[int]]
"""Family -> ids that machine.toml and site.toml describe."""


def judge(
    found: Found | Seen, known: KnownTags, shape: tuple[int, int], settings: DetectionSettings
) -> np.ndarray:
    """The status of each tag: ``accepted``, or the reason why not.

    Parameters
    ----------
    found : Found or Seen
        n tags of one picture, as a search found them or as the refinement left them; the refinement gives its reasons.
    known : mapping
        Family -> ids that are described.
    shape : (int, int)
        Height and width of the picture.
    settings : DetectionSettings
        Margin and bit errors that are let pass.

    Returns
    -------
    (n,) object array of strings
    """
    status = np.full(len(found), ACCEPTED, object)
    if not len(found):
        return status
    described = np.array(
        [int(number) in known.get(family, ()) for family, number in zip(found.family, found.tag_id)]
    )
    # From the mildest reason to the gravest: the gravest is the one that is told.
    if isinstance(found, Seen):
        status = np.where(found.reason == "", status, found.reason)
    else:
        limits = np.array([shape[1], shape[0]]) - 1 - BORDER_PX
        status[np.any((found.uv < BORDER_PX) | (found.uv > limits), axis=(1, 2))] = BORDER
        status[widths_across(found.uv).min(axis=1) < MIN_WIDTH_PX] = TOO_SMALL
    status[_doubled(found, settings)] = TWICE
    status[found.margin < settings.min_margin] = LOW_MARGIN
    status[found.hamming > hamming_limits(found, settings)] = BIT_ERRORS
    status[~described] = UNKNOWN_ID
    return status


def hamming_limits(found: Found | Seen, settings: DetectionSettings) -> np.ndarray:
    """(n,) int, bits that may have been corrected in each tag: fewer than the settings say where codes are short."""
    return np.array([min(settings.max_hamming, hamming_limit(family)) for family in found.family], int)


def _doubled(found: Found | Seen, settings: DetectionSettings) -> np.ndarray:
    """Whether another tag of the same family and id is in the picture: then neither can be told apart.

    The two files never describe a tag twice, so there are no two that belong there. A poor decoding does not count:
    it is more likely a mistake than a second print. Poor is what would be refused by itself, and also what had bits
    corrected and not half the margin of one that had none; that one is refused and the other stays. By margin alone
    nothing is decided: of two real prints the one in the shade may be the one that was surveyed.
    What the refinement cannot lay the print over is no second print either.
    """
    doubled = np.zeros(len(found), bool)
    # A tag that was followed has no margin.
    sound = ~(found.margin < settings.min_margin) & (found.hamming <= hamming_limits(found, settings))
    if isinstance(found, Seen):
        sound &= (found.reason != MISFIT) & (found.reason != NO_CONTRAST)
    places: dict[tuple[str, int], list[int]] = {}
    for k in np.flatnonzero(sound).tolist():
        places.setdefault((found.family[k], int(found.tag_id[k])), []).append(k)
    for rows in places.values():
        if len(rows) == 1:
            continue
        clean = [k for k in rows if found.hamming[k] == 0]
        doubled[rows] = True
        if len(clean) == 1:
            best = clean[0]
            others = [found.margin[k] for k in rows if k != best]
            doubled[best] = max(others) >= POOR_RIVAL * found.margin[best]
    return doubled
