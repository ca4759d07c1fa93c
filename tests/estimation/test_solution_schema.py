"""What solution.json says is what its schema describes, field for field; and the page has every field."""

import copy
import json
import re
from pathlib import Path

import pytest

from pipeline import resources
from pipeline.estimation import adjust
from pipeline.estimation.repeated import Repeated
from tests.estimation.conforming import faults
from tests.estimation.faults import inject, scene
from tests.estimation.simulator import MACHINE, SITE, Options, draw, exact

SCHEMA = json.loads(resources.schema_text("artefacts/solution.schema.json"))
PAGE = Path(__file__).parents[2] / "docs" / "solution.md"


def _written(drawn, **how):
    """The diagnostics as they stand in the file."""
    return json.loads(
        json.dumps(adjust(drawn.network, drawn.observations, drawn.readings, **how).diagnostics)
    )


def _exact():
    return draw(
        13, Options(epochs=10, machine=exact(copy.deepcopy(MACHINE)), site=exact(copy.deepcopy(SITE)))
    )


def _blind():
    machine = copy.deepcopy(MACHINE)
    machine["motion"]["bucket"]["rotation"] = 2e-4  # twelve seconds within the stroke of the linkage
    return draw(7, Options(epochs=60, blind=((4.0, 8.0),), machine=machine))


LOGS = {
    "learned": lambda: _written(draw(21, Options(epochs=60)), repeated=Repeated(), learn=True),
    "one frame": lambda: _written(draw(8, Options(epochs=1, bucket_marker=True, potentiometer=False))),
    "exact files": lambda: _written(_exact()),
    "blind for a while": lambda: _written(_blind()),
    "a benchmark moved": lambda: _written(inject(scene(1, 40.0), ["benchmark"], at_s=25.0).drawn),
}


@pytest.mark.parametrize("log", LOGS)
def test_solution_json_conforms_to_its_schema(log):
    solution = LOGS[log]()
    assert faults(solution, SCHEMA, SCHEMA) == []
    assert ("learned" in solution) == (log == "learned")
    if log == "a benchmark moved":
        assert [change["static"] for change in solution["changes"]["found"]] == ["benchmark B2 pose"]


def test_what_is_missing_unknown_or_of_another_kind_is_a_fault():
    """The validator itself: each of these alone is told, with its place."""
    solution = LOGS["one frame"]()
    for break_it, told in (
        (lambda s: s.pop("cost"), "solution has no cost"),
        (lambda s: s.update(costs=1.0), "solution.costs is not in the schema"),
        (lambda s: s.update(epochs=1.5), "solution.epochs is 1.5, not ['integer']"),
        (lambda s: s.update(sigma0=float("nan")), "solution.sigma0 is nan"),
        (lambda s: s.update(chains=[[1]]), "solution.chains[0][0] is 1"),
        (lambda s: s["unknowns"].update(statics=-1), "solution.unknowns.statics is -1"),
    ):
        broken = copy.deepcopy(solution)
        break_it(broken)
        found = faults(broken, SCHEMA, SCHEMA)
        assert len(found) == 1 and found[0].startswith(told), found


def test_the_page_has_every_field_of_the_schema():
    fields = set()

    def gather(schema):
        fields.update(schema.get("properties", {}))
        for part in (*schema.get("properties", {}).values(), *schema.get("$defs", {}).values()):
            gather(part)
        for key in ("items", "additionalProperties"):
            if isinstance(schema.get(key), dict):
                gather(schema[key])
        for part in schema.get("anyOf", []):
            gather(part)

    gather(SCHEMA)
    quoted = set(re.findall(r"`([^`]+)`", PAGE.read_text(encoding="utf-8")))
    assert len(fields) > 100
    assert fields - quoted == set()
