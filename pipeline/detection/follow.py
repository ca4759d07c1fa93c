"""Tags followed from frame to frame between two searches, forward and backward.

A search of a whole frame costs twenty times what decoding it costs, a window of one known tag a tenth. So a span of
frames is searched whole at its first and its last frame; in between it is swept with half the resolution where the
picture has moved on, and a glance with a quarter of it now and then finds what comes and goes. What is found is
followed. Forward first; what a later search found and the frames before it have not is then followed backward, until
it is met or the span ends.

A tag is looked for where its own motion, the picture's motion and its last place say, by the correlation of its cells
(`windows.locate`); the decoder looks into the window only where that fails. What counts is the refinement's word: it
fits the whole known print, and another id does not fit.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from pipeline.detection.acceptance import KnownTags
from pipeline.detection.apriltag import TagFinder
from pipeline.detection.boards import Board
from pipeline.detection.found import sides_px
from pipeline.detection.motion import Thumbnails
from pipeline.detection.places import DECODER_TRIES, Span, Track, guesses_of, in_view, nearest, reach_px
from pipeline.detection.prints import cells_across
from pipeline.detection.refine import Refiner
from pipeline.detection.seen import (
    NO_TRACK,
    SAME_SIDES,
    Seen,
    joined,
    search,
    seen_at,
)
from pipeline.detection.windows import POSSIBLE, WindowDecoder, locate

GLANCE_S = 1.5
"""Between two glances: searches of the means of 4x4 pixels. They take a twelfth of a search and miss tags under some
45 px; what comes from behind something and goes again within a span is found by them. With 5x5 pixels 118 of 5,442 rows
were missed, every 2.5 s 37 of 10,860."""
GLANCE_SHARE = 0.15
"""Part of the picture that was not in view at the last glance, from which on the next one is due."""
SWEEP_SHARE = 0.6
"""The same for sweeps: searches of the means of 2x2 pixels. They take a third of a search's time, and miss tags under
some 25 px."""
UNCERTAIN_S = 1.0
"""Between sweeps while the picture's motion cannot be told."""
LOST_EVERY = 5
"""After them a lost tag is looked for in one in so many frames; from where it is found again it is followed back.
With 3 nothing more was found, and following took 3 % longer."""
SURE = 0.6
"""Correlation of a place with which a tag that cannot be refined is still taken to be there, covered or blurred."""


class Follower:
    """Follows the tags in the frames of one camera.

    Parameters
    ----------
    finder, sweeper, glancer : TagFinder
        Search a picture: every pixel of it, a quarter and a sixteenth of them.
    refiner : Refiner
    decoder : WindowDecoder
    thumbnails : Thumbnails
        For pictures of this camera's size.
    known : mapping
        Family -> ids; others are reported where a search finds them, and not followed.
    boards : sequence of Board
        Which of them are printed together.
    """

    def __init__(
        self,
        finder: TagFinder,
        sweeper: TagFinder,
        glancer: TagFinder,
        refiner: Refiner,
        decoder: WindowDecoder,
        thumbnails: Thumbnails,
        known: KnownTags,
        boards: Sequence[Board] = (),
    ):
        self._finder, self._sweeper, self._glancer = finder, sweeper, glancer
        self._refiner, self._decoder = refiner, decoder
        self._thumbnails, self._known = thumbnails, known
        self._boards = [board for board in boards if len(board.tag_id) > 1]

    def search(self, grey: np.ndarray) -> Seen:
        """Every tag of a picture, refined."""
        return search(grey, self._finder, self._refiner)

    def follow(self, greys: Sequence[np.ndarray], time_s: np.ndarray, first: Seen, last: Seen) -> list[Seen]:
        """What is seen in each frame of a span; it depends on nothing but the arguments.

        Parameters
        ----------
        greys : sequence of n (H, W) uint8 arrays
            In order of time; two or more.
        time_s : (n,) array
            Capture stamps, from any origin.
        first, last : Seen
            What searches of the first and of the last frame found.

        Returns
        -------
        list of n Seen
        """
        span = Span(greys, time_s, self._thumbnails.drift(greys))
        self._forward(span, first, last)
        self._backward(span)
        return [joined(parts) for parts in span.seen]

    def _forward(self, span: Span, first: Seen, last: Seen) -> None:
        tracks: list[Track] = []
        self._take(span, 0, first, tracks)
        self._complete(span, 0, tracks)
        swept = glanced = 0
        for k in range(1, len(span)):
            if k == len(span) - 1:
                self._take(span, k, last, tracks)
            elif _sweep_is_due(span, swept, k):
                self._meet(span, k, self._sweeper, tracks)
                swept = glanced = k
            elif _glance_is_due(span, glanced, k):
                self._meet(span, k, self._glancer, tracks)
                glanced = k
            waiting = [track for track in tracks if track.frame != k]
            ended = _add(span, k, self._advance(span, k, waiting))
            self._complete(span, k, tracks)
            tracks = [track for track in tracks if track.number not in ended and in_view(track, span, k)]

    def _backward(self, span: Span) -> None:
        tracks: list[Track] = []
        for k in range(len(span) - 1, 0, -1):
            before = {int(number) for part in span.seen[k - 1] for number in part.track}
            waiting = {track.number for track in tracks}
            for part in span.seen[k]:
                for i in np.flatnonzero(part.track != NO_TRACK).tolist():
                    number = int(part.track[i])
                    if number not in before and number not in waiting:
                        # A track may stand twice in a frame: found by a search, and beside it by its board.
                        waiting.add(number)
                        tracks.append(_track_from(span, k, part, i))
            if not tracks:
                continue
            ended = _add(span, k - 1, self._advance(span, k - 1, tracks))
            self._complete(span, k - 1, tracks)
            ended |= before
            tracks = [track for track in tracks if track.number not in ended and in_view(track, span, k - 1)]

    def _take(self, span: Span, k: int, found: Seen, tracks: list[Track]) -> None:
        """What a search of frame k found, put on the tracks that lead to it or on new ones."""
        numbers = np.full(len(found), NO_TRACK)
        for i in range(len(found)):
            family, tag_id = str(found.family[i]), int(found.tag_id[i])
            if tag_id not in self._known.get(family, ()):
                continue
            same = [t for t in tracks if t.tag_id == tag_id and t.family == family and t.frame != k]
            near, away = nearest(same, span, k, found.uv[i])
            if near is not None and (away < float(sides_px(found.uv[i])) or near.lost):
                near.at(found.uv[i], k, span.time_s[k] - span.time_s[near.frame])
                numbers[i] = near.number
            else:
                tracks.append(Track(span.tracks, family, tag_id, found.uv[i], k))
                numbers[i] = span.tracks
                span.tracks += 1
        span.seen[k].append(found.on_tracks(numbers))

    def _meet(self, span: Span, k: int, finder: TagFinder, tracks: list[Track]) -> None:
        """Let tracks begin, or go on where they were lost, where a sweep or a glance of frame k sees described tags;
        others are told of.

        They see places; what is there the refinement says, as of all that is followed. Codes read off so few pixels
        have wrong bits: taken at their word they cost 86 of 4,591 rows of the sample log.
        """
        found = finder.find(span.greys[k])
        back = span.drift[k - 1] - span.drift[k]
        unknown = []
        for i, (family, tag_id, uv) in enumerate(zip(found.family.tolist(), found.tag_id.tolist(), found.uv)):
            if tag_id not in self._known.get(family, ()):
                unknown.append(i)
                continue
            same = [track for track in tracks if track.tag_id == tag_id and track.family == family]
            near, away = nearest(same, span, k, uv)
            if near is not None and near.frame == k - 1 and away < float(sides_px(uv)):
                continue  # it is being followed
            if near is None or not (away < float(sides_px(uv)) or near.lost):
                near = Track(span.tracks, family, tag_id, uv, k)
                tracks.append(near)
                span.tracks += 1
            # As if it had been seen there in the frame before.
            near.at(uv + back, k - 1, 0.0)
        if unknown:
            span.seen[k].append(
                seen_at(
                    span.greys[k], self._refiner, found.family[unknown], found.tag_id[unknown], found.uv[unknown],
                    found.hamming[unknown], found.margin[unknown],
                )
            )  # fmt: skip

    def _advance(self, span: Span, k: int, tracks: Sequence[Track]) -> Seen:
        """Look for some tracks in frame k; those found have moved on, the others are lost for a frame more."""
        due = [track for track in tracks if track.lost < DECODER_TRIES or track.lost % LOST_EVERY == 0]
        # In the order in which they are kept.
        due.sort(key=lambda track: (track.family, track.tag_id))
        seen = self._look(span, k, due)
        for track in tracks:
            track.lost += track.frame != k
        return seen

    def _look(self, span: Span, k: int, tracks: Sequence[Track]) -> Seen:
        grey = span.greys[k]
        if not tracks:
            return seen_at(grey, self._refiner, [], [], np.zeros((0, 4, 2)))
        guesses = [guesses_of(track, span, k) for track in tracks]
        reach = [reach_px(track, span, k) for track in tracks]
        uv, score = self._locate(grey, tracks, guesses, reach)
        strayed = [i for i in range(len(tracks)) if score[i] < SURE and not tracks[i].lost]
        if strayed and len(strayed) < len(tracks):
            # The other tags of the frame say how the camera moved, where the thumbnails could not.
            moves = [
                uv[i].mean(axis=0) - tracks[i].uv.mean(axis=0) for i in range(len(tracks)) if score[i] >= SURE
            ]
            if moves:
                common = np.median(moves, axis=0)
                again = [[tracks[i].uv + common] for i in strayed]
                few = [tracks[i] for i in strayed]
                other, better = self._locate(grey, few, again, [reach[i] for i in strayed])
                for j, i in enumerate(strayed):
                    if better[j] > score[i]:
                        uv[i], score[i] = other[j], better[j]
        tried = [i for i in range(len(tracks)) if score[i] >= POSSIBLE]
        seen = self._refined(grey, [tracks[i] for i in tried], uv[tried])
        # A fit that does not stand still tells of a tag that is covered or blurred, if its cells are where it was.
        told = np.array(
            [
                reason in ("", *STILL_THERE) and (not reason or score[i] > SURE)
                for i, reason in zip(tried, seen.reason)
            ],
            bool,
        )
        parts = [seen if told.all() else seen.of(told)]
        there = {tried[j] for j in np.flatnonzero(told)}
        decoded: list[tuple[Track, np.ndarray]] = []
        height, width = grey.shape
        for i, track in enumerate(tracks):
            place = guesses[i][0]
            if i in there or track.lost >= DECODER_TRIES:
                continue
            if np.all((place > 0) & (place < (width - 1, height - 1))):
                found = self._decoder.find(grey, track.family, track.tag_id, place, reach[i])
                if found is not None:
                    decoded.append((track, found))
        if decoded:
            parts.append(self._refined(grey, [t for t, _ in decoded], np.array([uv for _, uv in decoded])))
        seen = joined(parts)
        numbered = {track.number: track for track in tracks}
        for i, number in enumerate(seen.track.tolist()):
            moved = numbered[number]
            moved.at(seen.uv[i], k, span.time_s[k] - span.time_s[moved.frame])
        return seen

    def _complete(self, span: Span, k: int, tracks: list[Track]) -> None:
        """Look for what is missing of the boards of which a part is seen in frame k."""
        if not self._boards:
            return
        grey = span.greys[k]
        height, width = grey.shape
        there = {
            (str(part.family[i]), int(part.tag_id[i])): (part.uv[i], part.reason[i] == "")
            for part in span.seen[k]
            for i in range(len(part))
        }
        wanted = []
        for board in self._boards:
            mine = {n: there[board.family, n] for n in board.tag_id if (board.family, n) in there}
            for tag_id, uv in board.places({n: uv for n, (uv, fits) in mine.items() if fits}).items():
                if tag_id not in mine and np.all((uv > 0) & (uv < (width - 1, height - 1))):
                    wanted.append(Track(-1, board.family, tag_id, uv, k))
        if not wanted:
            return
        reach = [1.5 * track.side_px / cells_across(track.family) for track in wanted]
        uv, score = self._locate(grey, wanted, [[track.uv] for track in wanted], reach)
        likely = np.flatnonzero(score >= SURE)
        seen = self._refined(grey, [wanted[i] for i in likely], uv[likely])
        self._take(span, k, seen.of(np.flatnonzero(seen.reason == "")), tracks)

    def _locate(
        self, grey: np.ndarray, tracks: Sequence[Track], guesses: list[list[np.ndarray]], reach: list[float]
    ) -> tuple[np.ndarray, np.ndarray]:
        number = np.array([len(places) for places in guesses])
        table = np.zeros((len(tracks), int(number.max()), 4, 2))
        for i, places in enumerate(guesses):
            table[i, : len(places)] = places
        return locate(
            grey, [t.family for t in tracks], [t.tag_id for t in tracks], table, number, np.array(reach)
        )

    def _refined(self, grey: np.ndarray, tracks: Sequence[Track], uv: np.ndarray) -> Seen:
        family, tag_id = [t.family for t in tracks], [t.tag_id for t in tracks]
        return seen_at(grey, self._refiner, family, tag_id, uv, track=[t.number for t in tracks])


STILL_THERE = ("covered", "over-exposed", "under-exposed", "blurred", "cut by the border")
"""Reasons of the refinement that tell of a tag and not of its absence."""


def _add(span: Span, k: int, seen: Seen) -> set[int]:
    """Put to frame k what is not there yet; the tracks of the rest, which another track has met, end."""
    if not span.seen[k] and len(set(zip(seen.family.tolist(), seen.tag_id.tolist()))) == len(seen):
        span.seen[k].append(seen)
        return set()
    places: dict[tuple[str, int], list[np.ndarray]] = {}
    for part in span.seen[k]:
        for i, centre in enumerate(part.centre):
            places.setdefault((part.family[i], int(part.tag_id[i])), []).append(centre)
    new = np.zeros(len(seen), bool)
    for i, (centre, side) in enumerate(zip(seen.centre, seen.side_px)):
        there = places.setdefault((seen.family[i], int(seen.tag_id[i])), [])
        new[i] = all(np.hypot(*(centre - other)) > SAME_SIDES * side for other in there)
        there.append(centre)
    span.seen[k].append(seen.of(new))
    return set(seen.track[~new].tolist())


def _track_from(span: Span, k: int, part: Seen, i: int) -> Track:
    """A track that leads back from a tag seen in frame k, with the speed it had after it."""
    number = int(part.track[i])
    track = Track(number, str(part.family[i]), int(part.tag_id[i]), part.uv[i], k)
    if k + 1 < len(span):
        for later in span.seen[k + 1]:
            for j in np.flatnonzero(later.track == number).tolist():
                track.step = (later.uv[j] - part.uv[i]) / (span.time_s[k + 1] - span.time_s[k])
    return track


def _sweep_is_due(span: Span, swept: int, k: int) -> bool:
    if not np.all(span.certain[swept + 1 : k + 1]):
        return bool(span.time_s[k] - span.time_s[swept] >= UNCERTAIN_S)
    return _new_share(span, swept, k) > SWEEP_SHARE


def _glance_is_due(span: Span, glanced: int, k: int) -> bool:
    return (
        bool(span.time_s[k] - span.time_s[glanced] >= GLANCE_S) or _new_share(span, glanced, k) > GLANCE_SHARE
    )


def _new_share(span: Span, before: int, k: int) -> float:
    """Part of frame k that was not in view in an earlier frame."""
    height, width = span.greys[k].shape
    du, dv = span.drift[k] - span.drift[before]
    return 1.0 - max(1.0 - abs(float(du)) / width, 0.0) * max(1.0 - abs(float(dv)) / height, 0.0)
