from dataclasses import replace

import numpy as np

from pipeline.config.site import DetectionSettings
from pipeline.detection.acceptance import ghosts, judge
from pipeline.detection.refine import REASONS
from pipeline.detection.seen import FOLLOWED, NO_TRACK, SEARCHED, Seen

SQUARE = np.array([[0, 0], [30, 0], [30, 30], [0, 30.0]])
SETTINGS = DetectionSettings()


def seen(*tags):
    """Tags as (id, left, top) with optional hamming, margin, reason, how."""
    plain = {"hamming": 0, "margin": 60.0, "reason": "", "how": SEARCHED}
    rows = [plain | (tag[3] if len(tag) > 3 else {}) for tag in tags]
    n = len(tags)
    return Seen(
        family=np.full(n, "tag36h11", object),
        tag_id=np.array([tag[0] for tag in tags]),
        uv=np.array([SQUARE + tag[1:3] for tag in tags]),
        cov=np.tile(np.eye(8), (n, 1, 1)),
        hamming=np.array([row["hamming"] for row in rows]),
        margin=np.array([row["margin"] for row in rows]),
        **dict.fromkeys(
            ("blur_px", "motion_px", "noise", "contrast", "whole", "misfit", "response"), np.ones(n)
        ),
        reason=np.array([row["reason"] for row in rows], object),
        how=np.array([row["how"] for row in rows], object),
        track=np.full(n, NO_TRACK),
    )


def statuses(*tags):
    return judge(seen(*tags), {"tag36h11": {1, 2, 3}}, SETTINGS).tolist()


def test_each_reason_is_told():
    assert statuses(
        (1, 100, 100),
        (7, 200, 100),
        (2, 1.9, 200, {"reason": "cut by the border"}),
        (3, 300, 300, {"margin": 19.0}),
    ) == ["accepted", "unknown id", "cut by the border", "low margin"]
    assert statuses((1, 100, 100, {"hamming": 2})) == ["bit errors"]
    for reason in REASONS[1:]:
        assert statuses((1, 100, 100, {"reason": reason})) == [reason]


def test_a_covered_tag_on_another_tag_or_seen_elsewhere_is_none():
    covered = {"reason": "covered", "how": FOLLOWED}
    tags = seen(
        (1, 100, 100),
        (2, 104, 98, covered),  # on tag 1
        (3, 300, 300, covered),  # alone
        (1, 400, 300, covered),  # tag 1 is elsewhere
        (2, 100, 100, covered),  # on tag 1, but in another picture
        (3, 103, 100, {"reason": "covered"}),  # a search has read it
    )
    picture = np.array([0, 0, 0, 0, 1, 0])
    status = judge(tags, {"tag36h11": {1, 2, 3}}, SETTINGS, picture)
    assert ghosts(tags, status, picture).tolist() == [False, True, False, True, False, False]


def test_of_several_reasons_the_gravest_is_told():
    """What is wrong with the decoding comes before what is wrong with the corners, and what nobody described first."""
    poor = {"reason": "covered", "margin": 5.0}
    assert statuses((1, 100, 100, poor)) == ["low margin"]
    assert statuses((1, 100, 100, {**poor, "hamming": 2})) == ["bit errors"]
    assert statuses((7, 100, 100, {**poor, "hamming": 2})) == ["unknown id"]


def test_the_same_tag_in_another_picture_is_no_second_one():
    tags = seen((1, 100, 100), (1, 300, 100), (1, 500, 100), (2, 100, 300))
    status = judge(tags, {"tag36h11": {1, 2, 3}}, SETTINGS, np.array([7, 8, 8, 8]))
    assert status.tolist() == ["accepted", "twice in one frame", "twice in one frame", "accepted"]


def test_what_the_print_does_not_fit_is_no_second_print():
    assert statuses((1, 100, 100), (1, 300, 100, {"reason": "does not fit"})) == ["accepted", "does not fit"]
    assert statuses((1, 100, 100), (1, 300, 100, {"reason": "covered"})) == ["twice in one frame"] * 2


def test_what_following_holds_for_a_covered_tag_takes_no_other_with_it():
    """On a board of equal squares it had laid the covered tag's print over the next one."""
    covered = {"reason": "covered", "how": FOLLOWED, "margin": np.nan}
    assert statuses((1, 100, 100), (1, 300, 100, covered)) == ["accepted", "covered"]


def test_a_tag_that_was_followed_has_no_margin_and_is_judged_by_its_fit():
    assert statuses((1, 100, 100, {"margin": np.nan})) == ["accepted"]


def test_nothing_seen_is_nothing_to_judge():
    none = seen((1, 100, 100)).of(np.zeros(1, bool))
    assert judge(none, {"tag36h11": {1}}, SETTINGS).tolist() == []


def test_two_of_one_id_are_both_refused():
    assert statuses((1, 100, 100), (1, 300, 100), (2, 200, 200)) == [
        "twice in one frame",
        "twice in one frame",
        "accepted",
    ]


def test_a_poor_decoding_does_not_take_a_good_one_with_it():
    assert statuses((1, 100, 100), (1, 300, 100, {"margin": 5.0})) == ["accepted", "low margin"]


def test_a_mistaken_second_one_is_refused_and_the_real_one_stays():
    """Texture that passes with a corrected bit and little contrast, as a real tag of that id is in view."""
    assert statuses((1, 100, 100), (1, 300, 100, {"hamming": 1, "margin": 25.0})) == [
        "accepted",
        "twice in one frame",
    ]
    # Two such mistakes at once change nothing.
    mistakes = [(1, 300, 100, {"hamming": 1, "margin": 25.0}), (1, 500, 300, {"hamming": 1, "margin": 29.0})]
    assert statuses(mistakes[0], (1, 100, 100), mistakes[1])[1] == "accepted"


def test_what_may_be_a_second_print_loses_both():
    twice = ["twice in one frame"] * 2
    # Clean, but in the shade: which of the two was surveyed, nobody can say.
    assert statuses((1, 100, 100), (1, 300, 100, {"margin": 25.0})) == twice
    assert statuses((1, 100, 100), (1, 300, 100, {"hamming": 1, "margin": 31.0})) == twice
    assert statuses((1, 100, 100, {"hamming": 1}), (1, 300, 100, {"hamming": 1, "margin": 25.0})) == twice


def test_short_codes_are_believed_only_without_a_wrong_bit():
    """184 tags of DICT_4X4_50 with one corrected bit stood in 504 frames of texture, none of tag36h11."""
    tags = seen((1, 100, 100, {"hamming": 1}), (2, 200, 100))
    for family, status in (
        ("tag36h11", "accepted"),
        ("tag16h5", "bit errors"),
        ("DICT_4X4_50", "bit errors"),
    ):
        named = replace(tags, family=np.full(2, family, object))
        assert judge(named, {family: {1, 2}}, SETTINGS).tolist() == [status, "accepted"]


def test_an_id_of_another_family_is_unknown():
    assert judge(seen((1, 100, 100)), {"tag25h9": {1}}, SETTINGS).tolist() == ["unknown id"]
