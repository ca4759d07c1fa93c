from dataclasses import replace

import numpy as np

from pipeline.config.site import DetectionSettings
from pipeline.detection.acceptance import judge
from pipeline.detection.found import Found

SQUARE = np.array([[0, 0], [30, 0], [30, 30], [0, 30.0]])
SETTINGS = DetectionSettings()


def found(*tags):
    """Tags as (id, left, top) with optional hamming, margin, scale."""
    rows = [{"hamming": 0, "margin": 60.0, "scale": 1.0, **(tag[3] if len(tag) > 3 else {})} for tag in tags]
    uv = np.array([SQUARE * row["scale"] + tag[1:3] for tag, row in zip(tags, rows)])
    return Found(
        family=np.full(len(tags), "tag36h11", object),
        tag_id=np.array([tag[0] for tag in tags]),
        uv=uv,
        cov=np.tile(np.eye(2), (len(tags), 4, 1, 1)),
        side_px=np.full(len(tags), 30.0),
        hamming=np.array([row["hamming"] for row in rows]),
        margin=np.array([row["margin"] for row in rows]),
    )


def statuses(*tags):
    return judge(found(*tags), {"tag36h11": {1, 2, 3}}, (480, 640), SETTINGS).tolist()


def test_each_reason_is_told():
    assert statuses(
        (1, 100, 100),
        (7, 200, 100),
        (2, 1.9, 200),
        (3, 300, 300, {"margin": 19.0}),
    ) == ["accepted", "unknown id", "border", "low margin"]
    assert statuses((1, 100, 100, {"hamming": 2})) == ["bit errors"]
    assert statuses((1, 100, 100, {"scale": 0.2})) == ["too small"]


def test_the_border_is_felt_on_all_four_sides():
    assert statuses((1, 608, 100), (2, 607, 100), (3, 100, 448)) == ["border", "accepted", "border"]


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
    tags = found((1, 100, 100, {"hamming": 1}), (2, 200, 100))
    for family, status in (
        ("tag36h11", "accepted"),
        ("tag16h5", "bit errors"),
        ("DICT_4X4_50", "bit errors"),
    ):
        named = replace(tags, family=np.full(2, family, object))
        assert judge(named, {family: {1, 2}}, (480, 640), SETTINGS).tolist() == [status, "accepted"]


def test_an_id_of_another_family_is_unknown():
    assert judge(found((1, 100, 100)), {"tag25h9": {1}}, (480, 640), SETTINGS).tolist() == ["unknown id"]
