"""The runner, with stages made up for the purpose: what runs again, what is left behind, what is refused."""

import sys
from contextlib import contextmanager
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from pipeline.errors import EstimationError
from pipeline.progress import Silence
from pipeline.runs import RunFolder
from pipeline.stages import Stage, runner
from pipeline.stages.job import Job, NamedFile, Source


class Watched:
    """Keeps what a run tells."""

    def __init__(self):
        self.started, self.finished = [], []

    @contextmanager
    def stage(self, stage, why):
        self.started.append((stage.name, why))
        yield Silence()

    def done(self, stage, manifest, ran):
        self.finished.append((stage.name, ran))


SENSORS = {"sensor": ["pot", "pot"], "time_ns": np.array([1, 2]), "raw": np.array([0.5, 0.6])}


@pytest.fixture
def house(monkeypatch, tmp_path):
    """A house of three stages: read -> smooth -> print; `knobs` steers them."""
    knobs = {"parts": ["front", "rear"], "gain": 1.0, "title": "A", "warn": [], "fail": None}

    def read(job, progress):
        for sentence in knobs["warn"]:
            progress.warn(sentence)
        job.write_table("sensors", SENSORS)
        for part in knobs["parts"]:
            job.write_bytes(f"detections/{part}.parquet", part.encode())
        return {"readings": 2}

    def smooth(job, progress):
        raw = job.read_table("sensors")["raw"]
        if knobs["fail"]:
            raise knobs["fail"]
        # A gain within one per cent gives the same result.
        job.write_json(
            "solution.json",
            {"mean": float(raw.mean()) * round(knobs["gain"], 2), "parts": job.parts("detections")},
        )
        return {}

    def page(job, progress):
        job.write_bytes("page.html", f"{knobs['title']} {job.read_json('solution.json')['mean']}".encode())
        return {"verdict": "PASS", "warned": len(job.warnings("read"))}

    stages = (
        Stage("read", 1, "reading", (), ("log",), ("sensors",), lambda job: {}),
        Stage("smooth", 1, "smoothing", ("read",), ("design",), (), lambda job: {"gain": knobs["gain"]}),
        Stage("print", 1, "printing", ("read", "smooth"), (), (), lambda job: {"title": knobs["title"]}),
    )
    for name, run in (("read", read), ("smooth", smooth), ("print", page)):
        module = ModuleType(f"pipeline.stages.{name}")
        module.run = run
        monkeypatch.setitem(sys.modules, module.__name__, module)
    monkeypatch.setattr(runner, "STAGES", stages)
    for module in (runner, sys.modules["pipeline.stages.job"]):
        monkeypatch.setattr(module, "stage_named", lambda name: next(s for s in stages if s.name == name))
    folder = RunFolder(tmp_path / "run")
    folder.create()
    source = Source("machine.toml", "beside the log", "0" * 64, Path())
    design = NamedFile(tmp_path / "design.csv", "design.csv", "d" * 64)
    job = Job(Path("a.mcap"), "1" * 64, folder, None, None, source, source, {"design": design})
    return job, knobs


def run(job):
    watched = Watched()
    assert runner.run_stale(job, watched) == [name for name, _ in watched.started]
    return [name for name, _ in watched.started]


def test_everything_once_then_nothing(house):
    job, _ = house
    assert run(job) == ["read", "smooth", "print"]
    assert run(job) == []
    assert [state.why for state in runner.states(job)] == [None, None, None]


def test_same_outputs_after_another_setting_stop_the_work_there(house):
    job, knobs = house
    run(job)
    knobs["gain"] = 1.001
    assert [state.why for state in runner.states(job)] == [None, "gain changed", "smooth is stale"]
    assert run(job) == ["smooth"]


def test_setting_and_log_and_named_file_reach_exactly_who_uses_them(house):
    job, knobs = house
    run(job)
    knobs["title"] = "B"
    assert run(job) == ["print"]
    knobs["gain"] = 2.0
    assert run(job) == ["smooth", "print"]
    from dataclasses import replace

    another = replace(job, files={"design": replace(job.files["design"], sha256="e" * 64)})
    assert run(another) == ["smooth"]
    assert run(replace(another, log_sha256="2" * 64)) == ["read"]


def test_outputs_that_are_no_longer_made_are_removed(house):
    job, knobs = house
    run(job)
    knobs["parts"] = ["front"]
    job.folder.withdraw("smooth")
    (job.folder.path / "read.manifest.json").write_text(
        (job.folder.path / "read.manifest.json").read_text().replace('"version": 1', '"version": 0')
    )
    assert run(job) == ["read", "smooth", "print"]
    assert not job.folder.file("detections/rear.parquet").exists()
    assert job.read_json("solution.json")["parts"] == ["front"]


def test_stage_that_fails_leaves_no_manifest_and_the_next_run_begins_there(house):
    job, knobs = house
    run(job)
    knobs.update(gain=3.0, fail=EstimationError("no solution"))
    with pytest.raises(EstimationError):
        runner.run_stale(job, Watched())
    assert job.folder.manifest("smooth") is None
    knobs["fail"] = None
    assert run(job) == ["smooth", "print"]


def test_warnings_are_kept_once_and_handed_on(house):
    job, knobs = house
    knobs["warn"] = ["a sensor stops", "a sensor stops", "a tag is unknown"]
    run(job)
    assert job.folder.manifest("read").warnings == ["a sensor stops", "a tag is unknown"]
    assert job.folder.manifest("print").counts["warned"] == 2


def test_stage_may_not_read_what_it_did_not_declare(house):
    job, _ = house
    run(job)
    with pytest.raises(AssertionError, match="print reads poses without needing its stage"):
        job.at(runner.STAGES[2], "f" * 64).read_table("poses")


def test_two_runs_write_the_same_bytes(house, tmp_path):
    job, _ = house
    run(job)
    from dataclasses import replace

    other = replace(job, folder=RunFolder(tmp_path / "other"))
    other.folder.create()
    run(other)
    for path in job.folder.path.rglob("*"):
        if path.is_file() and not path.name.endswith(".manifest.json"):
            assert path.read_bytes() == (other.folder.path / path.relative_to(job.folder.path)).read_bytes()
    first, second = (j.folder.manifest("print") for j in (job, other))
    assert (first.fingerprint, first.outputs) == (second.fingerprint, second.outputs)
