"""What is counted of a camera is what stands in its table, whatever the portions."""

import json

import numpy as np

from pipeline.config.site import DetectionSettings
from pipeline.detection.tally import Tally
from pipeline.runs import json_bytes
from tests.detection.test_stillness import noise, rows, together


def a_camera():
    """Tag 1 stands still, tag 2 is refused for two reasons, two ids that nothing describes were read."""
    rng = np.random.default_rng(1)
    part = together(
        rows(noise(rng, 240), tag=1),
        rows(noise(rng, 10), tag=2, status="low margin"),
        rows(noise(rng, 5), tag=2, frames=np.arange(10, 15), status="covered"),
        rows(noise(rng, 3), tag=77, status="unknown id"),
        rows(noise(rng, 4), tag=78, status="unknown id"),
    )
    n = len(part["frame"])
    part["hamming"] = np.where(part["tag_id"] == 78, 1, 0)
    part["margin"] = np.full(n, 60.0)
    return part


def test_frames_tags_and_unknown_ids_are_counted_by_what_became_of_them():
    tally, part = Tally(DetectionSettings()), a_camera()
    for start in range(0, len(part["frame"]), 50):
        tally.add({name: values[start : start + 50] for name, values in part.items()}, {"searched": 48})
    tally.add({name: values[:0] for name, values in part.items()}, {"corrupt picture": 2})
    assert tally.frames == {"searched": 6 * 48, "corrupt picture": 2}
    assert tally.status == {"accepted": 240, "low margin": 10, "covered": 5, "unknown id": 7}
    # An id with corrected bits is more likely a mistake than a tag that somebody forgot to describe.
    assert tally.unknown == {("tag36h11", 77): 3}
    assert tally.stillness.at_rest == 240
    facts = tally.facts()
    assert facts["tags"] == dict(tally.status)
    assert facts["how"] == {}
    (size,) = facts["pixel_noise"]["sizes"]
    assert (size["size"], size["frames"], size["tags"]) == ("25 to 50 px", 240, 1)
    assert json.loads(json_bytes(facts)) == facts


def test_how_tags_were_found_is_counted_once_the_table_says_it():
    tally, part = Tally(DetectionSettings()), a_camera()
    part["how"] = np.where(part["frame"] % 10 == 0, "searched", "followed").astype(object)
    tally.add(part, {})
    assert tally.facts()["how"] == {"searched": 24, "followed": 216}
