"""A belt's joint has no angle of its own: what the file may say of it."""

import copy

import pytest
from pydantic import ValidationError

from pipeline.config import Machine
from tests.estimation.simulator import MACHINE


def _machine(follows, sensor_joint="bucket"):
    document = copy.deepcopy(MACHINE)
    axis = document["bodies"]["bucket"]["axis"]
    document["bodies"]["flip"] = {"kind": "joint", "parent": "stick", "axis": axis, "follows": follows}
    document["sensors"]["pot"]["joint"] = sensor_joint
    return Machine.model_validate(document)


def test_a_belt_names_the_joint_that_drives_it():
    assert _machine({"joint": "bucket", "ratio": 0.5}).bodies["flip"].follows.joint == "bucket"


@pytest.mark.parametrize(
    "follows, joint, said",
    [
        ({"joint": "stick"}, "bucket", "'stick', which is no body of kind 'joint'"),
        ({"joint": "flip"}, "bucket", "'flip', which has no angle of its own"),
        ({"joint": "bucket", "ratio": 0.0}, "bucket", "would not turn at all"),
        ({"joint": "bucket", "ratio": 2.0}, "bucket", "less than or equal to 1"),
        ({"joint": "bucket"}, "flip", "has no angle of its own: name 'bucket'"),
    ],
)
def test_what_a_belt_cannot_be_is_refused_in_words(follows, joint, said):
    with pytest.raises(ValidationError, match=said):
        _machine(follows, joint)
