"""The graph of a job's network, from its two files and, where there is one, from what a run detected."""

from __future__ import annotations

from pathlib import Path

from pipeline import tables
from pipeline.config import Machine, load_machine, load_site
from pipeline.config.document import decode, read_file
from pipeline.config.machine import Intrinsics
from pipeline.errors import ArtefactError
from pipeline.estimation.table import observations_of, readings_of
from pipeline.network import network_of
from pipeline.network.graph import Graph, graph_of, told
from pipeline.network.sketch import svg_of
from pipeline.runs import RunFolder, atomic_write
from pipeline.stages.job import table_file

ANY_LENS = Intrinsics(width=1280, height=960, fx=1000, fy=1000, cx=639.5, cy=479.5, sigma=(0.0,) * 9)
"""For cameras whose lens stands in the log: the graph does not depend on it."""


def graph_of_files(machine_file: Path, site_file: Path, run: Path | None = None) -> Graph:
    """The graph of a network; with a run folder, of what was seen in that log.

    Raises
    ------
    ConfigError
        A file cannot be read.
    ArtefactError
        The run folder has no detections yet.
    NetworkError
        The two files do not go together.
    """
    machine = load_machine(decode(read_file(machine_file), str(machine_file)), str(machine_file))
    site = load_site(decode(read_file(site_file), str(site_file)), str(site_file))
    network = network_of(_with_lenses(machine), site)
    if run is None:
        return graph_of(network)
    folder = RunFolder(run)
    parts = [c.name for c in network.cameras if folder.file(table_file("detections", c.name)).exists()]
    sensors = folder.file(table_file("sensors"))
    if not parts or not sensors.exists():
        raise ArtefactError(
            f"{run} holds no detections of this machine's cameras; give the run folder of a log, such as runs/shift, "
            f"after 'gradetrace report' has looked at its pictures"
        )
    seen = {c: tables.read_table(folder.file(table_file("detections", c)), "detections") for c in parts}
    readings = readings_of(tables.read_table(sensors, "sensors"))
    return graph_of(network, observations_of(network, seen), readings)


def draw(graph: Graph, title: str, file: Path) -> list[str]:
    """Write the graph as SVG; what it says in words comes back."""
    atomic_write(file, svg_of(graph, title).encode("utf-8"))
    return told(graph)


def _with_lenses(machine: Machine) -> Machine:
    cameras = {
        name: c if c.intrinsics is not None else c.model_copy(update={"intrinsics": ANY_LENS})
        for name, c in machine.cameras.items()
    }
    return machine.model_copy(update={"cameras": cameras})
