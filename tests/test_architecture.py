"""The floors of the house, and who may speak to which library: held by reading the source.

Imports are found anywhere, inside functions too. Each rule is shown to bite on a small made-up source.
"""

import ast
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest

PACKAGE = Path(__file__).resolve().parent.parent / "pipeline"

# From the ground up; a module may import from floors below its own, and from its own room.
FLOORS = (
    {"errors", "resources", "threads"},
    {"geometry"},
    {"config"},
    {"tables", "runs"},
    {"logs"},
    {"detection"},
    {"network"},
    {"estimation"},
    {"tracks"},
    {"surface"},
    {"calibration"},
    {"planning"},
    {"report"},
    {"stages", "progress", "preflight"},
    {"cli", "__main__"},
)
FLOOR_OF = {room: number for number, rooms in enumerate(FLOORS) for room in rooms}
NOT_IN_THE_HOUSE = {"synthetic"}
"""Makes logs with what the house is made of; only the command that runs it may know it."""

BORDERS = {
    "mcap": {"logs"},
    "mcap_protobuf": {"logs"},
    "mcap_ros2": {"logs"},
    "foxglove_schemas_protobuf": {"logs"},
    "cv2": {"detection", "calibration", "synthetic"},
    "pyarrow": {"tables", "runs", "*.table"},
    "pandas": {"tables", "runs", "*.table"},
    "matplotlib": {"report"},
    "jinja2": {"report"},
    "pydantic": {"config"},
    "pydantic_core": {"config"},
    "tomlkit": {"config"},
    "click": {"cli"},
    "rich": {"cli", "progress"},
    "simplejpeg": {"detection", "synthetic"},
    "pyapriltags": {"detection"},
    "defusedxml": {"surface"},
    "ezdxf": {"surface"},
}
FORBIDDEN_NAMES = {"utils", "util", "helpers", "helper", "common", "types", "misc"}
MAX_LINES = 420


@dataclass(frozen=True)
class Import:
    module: str
    """Who imports, dotted, without the package: `network.planar`."""
    target: str
    """What is imported, dotted: `pipeline.logs.reader`, `cv2`."""
    line: int


def imports_of(source: str, module: str) -> Iterator[Import]:
    """Every import of a source, wherever it stands, those for the type checker included."""
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            for name in node.names:
                yield Import(module, name.name, node.lineno)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{module}:{node.lineno}: relative import"
            yield Import(module, node.module, node.lineno)
            # `from pipeline import tables` names the room only here.
            if node.module == "pipeline":
                for name in node.names:
                    yield Import(module, f"pipeline.{name.name}", node.lineno)
        elif isinstance(node, ast.Call) and ast.unparse(node.func) in {
            "importlib.import_module",
            "__import__",
        }:
            argument = node.args[0]
            if isinstance(argument, ast.Constant):
                yield Import(module, str(argument.value), node.lineno)
            else:
                yield Import(module, f"dynamic {ast.unparse(argument)}", node.lineno)


def floor_faults(found: Import) -> Iterator[str]:
    """Why an import goes up the house, or next door on the same floor."""
    here = found.module.split(".")[0]
    if found.target.startswith("dynamic "):
        if found.module != "stages.runner":
            yield f"{found.module}:{found.line} imports what only running it tells ({found.target})"
        return
    if not found.target.startswith("pipeline."):
        return
    room = found.target.split(".")[1]
    if room == here or room == "__version__":
        return
    if room in NOT_IN_THE_HOUSE:
        if here != "cli":
            yield f"{found.module}:{found.line} imports the room {room}, which nothing in the house may know"
        return
    if here in NOT_IN_THE_HOUSE:
        if room in {"stages", "cli", "progress", "preflight", "report", "detection"}:
            yield f"{found.module}:{found.line} imports {room}; {here} must not share its mistakes"
        return
    if here not in FLOOR_OF:
        yield f"{found.module}: on which floor is {here}?"
    elif room not in FLOOR_OF:
        yield f"{found.module}:{found.line}: on which floor is {room}?"
    elif FLOOR_OF[room] > FLOOR_OF[here]:
        yield f"{found.module}:{found.line} ({here}) imports {found.target}, which is a later room"


def border_faults(found: Import) -> Iterator[str]:
    """Why an import of somebody else's library is not at its border."""
    allowed = BORDERS.get(found.target.split(".")[0])
    if allowed is None:
        return
    parts = found.module.split(".")
    names = {parts[0], found.module, f"*.{parts[-1]}" if len(parts) > 1 else ""}
    if not names & allowed:
        yield f"{found.module}:{found.line} imports {found.target}, which belongs in {sorted(allowed)}"


def name_faults(module: str) -> Iterator[str]:
    if bad := FORBIDDEN_NAMES & set(module.split(".")):
        yield f"{module}: nothing is called {sorted(bad)[0]}; name the noun that is missing"


def length_faults(source: str, module: str) -> Iterator[str]:
    if (lines := len(source.splitlines())) > MAX_LINES:
        yield f"{module}: {lines} lines (limit {MAX_LINES}); it wants to become two"


def faults_of(source: str, module: str) -> list[str]:
    """Every fault of one source."""
    faults = [*name_faults(module), *length_faults(source, module)]
    for found in imports_of(source, module):
        faults += [*floor_faults(found), *border_faults(found)]
    return faults


def modules() -> dict[str, Path]:
    found = {}
    for path in sorted(PACKAGE.rglob("*.py")):
        parts = path.relative_to(PACKAGE).with_suffix("").parts
        found[".".join(parts[:-1] if len(parts) > 1 and parts[-1] == "__init__" else parts)] = path
    return found


def test_the_house_stands_as_drawn():
    found = modules()
    assert len(found) > 30
    faults = [
        fault
        for module, path in found.items()
        for fault in faults_of(path.read_text(encoding="utf-8"), module)
    ]
    assert not faults, "\n" + "\n".join(faults)


def test_every_room_has_its_floor():
    rooms = {module.split(".")[0] for module in modules()} - {"__init__"}
    assert rooms <= set(FLOOR_OF) | NOT_IN_THE_HOUSE


ALLOWED = [
    ("detection.apriltag", "from pipeline.config.site import DetectionSettings"),
    ("detection.apriltag", "import cv2"),
    ("tracks.table", "import pyarrow as pa"),
    ("stages.detect", "from pipeline.detection import apriltag"),
    ("stages.runner", "import importlib\nimportlib.import_module(f'pipeline.stages.{name}')"),
    ("cli", "def sample_logs():\n    from pipeline.synthetic import main"),
    ("synthetic.recording", "from pipeline.logs.writer import LogWriter"),
    ("report.figures", "from pipeline import resources\nimport matplotlib.figure"),
    ("geometry.se3", "import numpy as np\nfrom pipeline.geometry import so3"),
]


@pytest.mark.parametrize("module, source", ALLOWED, ids=[f"{m}-{s[:24]}" for m, s in ALLOWED])
def test_what_is_allowed_passes(module, source):
    assert faults_of(source, module) == []


FORBIDDEN = [
    ("geometry.se3", "from pipeline.config import Machine", "a later room"),
    ("config.site", "import pipeline.tables", "a later room"),
    ("estimation.solve", "def f():\n    from pipeline.tracks.poses import x", "a later room"),
    ("estimation.solve", "if TYPE_CHECKING:\n    from pipeline.stages.job import Job", "a later room"),
    ("network.build", "from pipeline import estimation", "a later room"),
    ("surface.design", "from pipeline.stages import job", "a later room"),
    ("stages.detect", "from pipeline.cli import main", "a later room"),
    ("estimation.solve", "from pipeline.synthetic import truth", "nothing in the house may know"),
    ("stages.report", "import pipeline.synthetic.truth", "nothing in the house may know"),
    ("synthetic.renderer", "from pipeline.detection import apriltag", "must not share its mistakes"),
    ("network.build", "import cv2", "cv2, which belongs in"),
    ("estimation.solve", "def f():\n    import pandas as pd", "pandas, which belongs in"),
    ("stages.track", "import pyarrow.parquet as pq", "pyarrow.parquet, which belongs in"),
    ("stages.ingest", "from mcap.reader import make_reader", "mcap.reader, which belongs in"),
    ("surface.maps", "from matplotlib.figure import Figure", "matplotlib.figure, which belongs in"),
    ("stages.report", "import jinja2", "jinja2, which belongs in"),
    ("network.model", "from pydantic import BaseModel", "pydantic, which belongs in"),
    ("stages.runner", "import click", "click, which belongs in"),
    ("logs.reader", "from rich.progress import track", "rich.progress, which belongs in"),
    ("logs.reader", "import importlib\nimportlib.import_module('cv2')", "cv2, which belongs in"),
    ("logs.reader", "import importlib\nimportlib.import_module(name)", "what only running it tells"),
    ("geometry.utils", "", "nothing is called utils"),
    ("report.helpers", "", "nothing is called helpers"),
    ("attic.box", "from pipeline.errors import PipelineError", "on which floor is attic"),
    ("report.page", "x = 1\n" * 421, "421 lines"),
]


@pytest.mark.parametrize("module, source, said", FORBIDDEN, ids=[f"{m}-{s[:24]}" for m, s, _ in FORBIDDEN])
def test_what_is_forbidden_is_found(module, source, said):
    faults = faults_of(source, module)
    assert any(said in fault for fault in faults), faults


def test_relative_imports_are_refused():
    with pytest.raises(AssertionError, match="relative import"):
        faults_of("from . import so3", "geometry.se3")
