"""Tags seen in one frame, searched or followed, as the refinement left them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace

import numpy as np

from pipeline.detection.apriltag import TagFinder
from pipeline.detection.found import sides_px
from pipeline.detection.refine import ALL_PIXELS, Refined, Refiner

SEARCHED = "searched"
FOLLOWED = "followed"
NO_TRACK = -1
PIXELS_OF_FOLLOWED = 500
"""Of each tag between the keys. Its corners are then good to 0.02 to 0.03 px, below what repeats in every frame; all
pixels would make that 0.008 to 0.015 px and take three times as long."""
SAME_SIDES = 0.4
"""Two quads of one id whose centres are nearer than this part of their side are one tag."""


@dataclass(frozen=True)
class Seen(Refined):
    """N tags of one frame; of one whose fit does not stand `uv` is the start of the refinement, and `cov` is 0."""

    family: np.ndarray
    """(n,) object array of names."""
    tag_id: np.ndarray
    """(n,) int."""
    hamming: np.ndarray
    """(n,) int, corrected bits; 0 of a tag that was followed: nothing was decoded."""
    margin: np.ndarray
    """(n,) decision margin of the decoder; NaN of a tag that was followed."""
    how: np.ndarray
    """(n,) object array: `SEARCHED` or `FOLLOWED`."""
    track: np.ndarray
    """(n,) int: which tag of the span this is; `NO_TRACK` of one that is not followed."""

    @property
    def centre(self) -> np.ndarray:
        """(n, 2) mean of each quad's corners."""
        return np.asarray(self.uv.mean(axis=1))

    @property
    def side_px(self) -> np.ndarray:
        """(n,) mean side of each quad."""
        return sides_px(self.uv)

    @property
    def decoded(self) -> np.ndarray:
        """(n,) bool: whose id a search has read off the picture."""
        return np.asarray(self.how == SEARCHED, bool)

    def of(self, rows: np.ndarray) -> Seen:
        """Some of them."""
        return Seen(**{name: getattr(self, name)[rows] for name in _SEEN})

    def on_tracks(self, track: np.ndarray) -> Seen:
        """The same, of these tracks."""
        return replace(self, track=np.asarray(track, int))


_REFINED = tuple(field.name for field in fields(Refined))
_SEEN = tuple(field.name for field in fields(Seen))


def seen_at(
    grey: np.ndarray,
    refiner: Refiner,
    family: Sequence[str] | np.ndarray,
    tag_id: Sequence[int] | np.ndarray,
    uv: np.ndarray,
    hamming: np.ndarray | None = None,
    margin: np.ndarray | None = None,
    track: Sequence[int] | None = None,
    pixels: int = PIXELS_OF_FOLLOWED,
) -> Seen:
    """Tags near some places, refined; those with a decision margin were searched, the others followed.

    Parameters
    ----------
    grey : (H, W) uint8 array
        The picture.
    refiner : Refiner
        Of its camera.
    family, tag_id : (n,) sequences
        Which tags.
    uv : (n, 4, 2) array
        Start of the refinement, px.
    hamming, margin : (n,) arrays, optional
        What the decoder said.
    track : (n,) sequence, optional
        Their tracks.
    pixels : int
        As of `Refiner.refine`.
    """
    n = len(tag_id)
    uv = np.asarray(uv, float).reshape(-1, 4, 2)
    refined = refiner.refine(grey, list(family), [int(number) for number in tag_id], uv, pixels)
    stands = np.asarray(refined.reason == "", bool)[:, None, None]
    values = {name: getattr(refined, name) for name in _REFINED}
    values["uv"] = np.where(stands, refined.uv, uv)
    values["cov"] = np.where(stands, refined.cov, 0.0)
    return Seen(
        **values,
        family=np.array([*family], object),
        tag_id=np.asarray(tag_id, int),
        hamming=np.zeros(n, int) if hamming is None else np.asarray(hamming, int),
        margin=np.full(n, np.nan) if margin is None else np.asarray(margin, float),
        how=np.full(n, FOLLOWED if margin is None else SEARCHED, object),
        track=np.full(n, NO_TRACK) if track is None else np.asarray(track, int),
    )


def search(grey: np.ndarray, finder: TagFinder, refiner: Refiner, pixels: int = ALL_PIXELS) -> Seen:
    """Every tag of a picture, refined with so many pixels; sorted by family, id and place."""
    found = finder.find(grey)
    return joined(
        [
            seen_at(
                grey,
                refiner,
                found.family,
                found.tag_id,
                found.uv,
                found.hamming,
                found.margin,
                pixels=pixels,
            )
        ]
    )


def together(parts: Sequence[Seen]) -> Seen:
    """All of some parts, in their order."""
    return Seen(**{name: np.concatenate([getattr(part, name) for part in parts]) for name in _SEEN})


def joined(parts: Sequence[Seen]) -> Seen:
    """All that is seen in one frame, sorted by family, id and place."""
    assert parts
    whole = parts[0] if len(parts) == 1 else together(parts)
    if len(whole) < 2:
        return whole
    keys = [
        (family, number, u, v)
        for family, number, (u, v) in zip(
            whole.family.tolist(), whole.tag_id.tolist(), whole.uv[:, 0].tolist(), strict=True
        )
    ]
    order = sorted(range(len(whole)), key=keys.__getitem__)
    if order == [*range(len(whole))]:
        return whole
    return whole.of(np.array(order, int))
