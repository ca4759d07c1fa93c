"""Content decides what is stale; what is written appears whole; one process at a time."""

import json
import os
import subprocess
import sys
import textwrap
from dataclasses import replace

import numpy as np
import pytest

from pipeline import runs
from pipeline.errors import ArtefactError
from pipeline.runs import Manifest, RunFolder, atomic_file, atomic_write

INPUTS = {"log": "a" * 64}
SETTINGS = {"cameras": {"front": "/front"}, "detection": {"quad_decimate": 1.0}}
SCHEMAS = {"frames": 1}


@pytest.fixture
def folder(tmp_path):
    """A run folder in which a stage is done."""
    folder = RunFolder(tmp_path / "runs" / "trench")
    folder.create()
    atomic_write(folder.file("out/front.parquet"), b"rows")
    outputs = {"out/front.parquet": runs.sha256_of_file(folder.file("out/front.parquet"))}
    print_ = runs.fingerprint(1, INPUTS, SETTINGS, SCHEMAS)
    folder.write_manifest(Manifest("look", 1, print_, INPUTS, SETTINGS, SCHEMAS, outputs, {"frames": 3}))
    return folder


def why(folder, version=1, inputs=INPUTS, settings=SETTINGS, schemas=SCHEMAS):
    return folder.why_stale("look", version, inputs, settings, schemas)


def test_nothing_is_stale_when_nothing_changed(folder):
    assert why(folder) is None


def test_a_stage_that_never_ran_is_stale(folder):
    assert folder.why_stale("other", 1, {}, {}, {}) == "never run"


@pytest.mark.parametrize(
    "change, said",
    [
        ({"version": 2}, "made by another version of the stage"),
        ({"schemas": {"frames": 2}}, "made with another version of the table schemas"),
        ({"inputs": {"log": "b" * 64}}, "log changed"),
        ({"inputs": {**INPUTS, "design": "c" * 64}}, "design changed"),
        ({"settings": {**SETTINGS, "detection": {"quad_decimate": 2.0}}}, "detection.quad_decimate changed"),
        ({"settings": {"cameras": {}, "detection": {"quad_decimate": 1.0}}}, "cameras.front changed"),
    ],
)
def test_each_change_makes_it_stale_and_is_named(folder, change, said):
    assert why(folder, **change) == said


def test_dates_and_order_of_keys_make_nothing_stale(folder):
    os.utime(folder.file("out/front.parquet"), (1, 1))
    assert why(folder, settings=dict(reversed(SETTINGS.items()))) is None


def test_output_that_is_gone_or_was_touched_up_makes_it_stale(folder):
    output = folder.file("out/front.parquet")
    before = output.stat()
    output.write_bytes(b"ROWS")
    os.utime(output, ns=(before.st_atime_ns, before.st_mtime_ns))  # same size, same date: only content tells
    assert why(folder) == "out/front.parquet is not what the stage wrote"
    output.unlink()
    assert why(folder) == "out/front.parquet is missing"


@pytest.mark.parametrize("content", [b"", b"{", b"[]", b'{"stage": "look"}', b"\xff\xfe"])
def test_manifest_that_cannot_be_read_counts_as_none(folder, content):
    folder.file("look.manifest.json").write_bytes(content)
    assert why(folder) == "never run"


def test_edited_manifest_does_not_fit_its_fingerprint(folder):
    manifest = folder.manifest("look")
    folder.write_manifest(replace(manifest, fingerprint="0" * 64))
    assert why(folder) == "its manifest does not fit its fingerprint"


def test_fingerprint_distinguishes_what_json_distinguishes():
    prints = {
        runs.fingerprint(1, {}, {"a": value}, {}) for value in (1, "1", 1.5, True, None, [1], {"a": 1}, 1e-17)
    }
    assert len(prints) == 8


def test_json_bytes_are_stable_and_valid_json_for_numpy_and_nan():
    value = {"b": np.float64(0.1), "a": np.arange(3), "nan": float("nan"), "deep": [np.nan, np.int32(7)]}
    text = runs.json_bytes(value)
    assert text == runs.json_bytes(value)
    assert json.loads(text) == {"b": 0.1, "a": [0, 1, 2], "nan": None, "deep": [None, 7]}


def test_interrupted_write_leaves_the_old_file_and_nothing_else(tmp_path):
    path = tmp_path / "file"
    atomic_write(path, b"old")
    with pytest.raises(KeyboardInterrupt), atomic_file(path) as stream:
        stream.write(b"new")
        raise KeyboardInterrupt
    assert path.read_bytes() == b"old"
    assert [file.name for file in tmp_path.iterdir()] == ["file"]


def test_defect_of_ours_while_writing_keeps_its_type(tmp_path):
    with pytest.raises(ZeroDivisionError), atomic_file(tmp_path / "file"):
        1 / 0  # noqa: B018


def test_folder_that_cannot_be_made_is_told(tmp_path):
    (tmp_path / "runs").write_bytes(b"a file is in the way")
    with pytest.raises(
        ArtefactError, match=r"cannot be written .*make its folder writable, or name another one"
    ):
        atomic_write(tmp_path / "runs" / "trench" / "x", b"")
    with pytest.raises(ArtefactError, match="cannot be written"):
        RunFolder(tmp_path / "runs" / "trench").create()


def test_kill_during_a_write_leaves_the_old_file_and_the_next_start_cleans_up(tmp_path):
    folder = RunFolder(tmp_path)
    atomic_write(folder.file("table"), b"old")
    script = f"""
        import os, signal
        from pathlib import Path
        from pipeline.runs import atomic_file
        with atomic_file(Path({str(tmp_path)!r}) / "table") as stream:
            stream.write(b"new" * 100_000)
            os.kill(os.getpid(), signal.SIGKILL)
    """
    done = subprocess.run([sys.executable, "-c", textwrap.dedent(script)])
    assert done.returncode == -9
    assert folder.file("table").read_bytes() == b"old"
    assert len(list(tmp_path.glob(".*.partial"))) == 1
    with folder.locked():
        assert not list(tmp_path.glob(".*.partial"))


def test_second_process_on_one_folder_is_told_who_holds_it(tmp_path):
    folder = RunFolder(tmp_path / "trench")
    script = f"""
        from pathlib import Path
        from pipeline.errors import PipelineError
        from pipeline.runs import RunFolder
        try:
            with RunFolder(Path({str(folder.path)!r})).locked():
                print("got it")
        except PipelineError as error:
            print(error)
    """

    def other():
        return subprocess.run(
            [sys.executable, "-c", textwrap.dedent(script)], capture_output=True, text=True, check=True
        ).stdout

    with folder.locked():
        assert f"in use by another gradetrace (process {os.getpid()})" in other()
    assert other() == "got it\n"


def test_scratch_is_found_again_only_under_the_same_fingerprint(tmp_path):
    folder = RunFolder(tmp_path)
    first = folder.scratch("detect", "1" * 64)
    (first / "piece").write_bytes(b"done")
    assert (folder.scratch("detect", "1" * 64) / "piece").exists()
    second = folder.scratch("detect", "2" * 64)
    assert not list(second.iterdir())
    assert not first.exists()
    folder.clear_scratch("detect")
    assert not second.exists()


def test_outputs_that_a_stage_no_longer_makes_are_removed_with_their_folder(folder):
    folder.remove(["out/front.parquet", "never/was"])
    assert not folder.file("out").exists()
    assert folder.path.exists()


def test_hash_of_a_large_file_is_kept_but_every_change_is_noticed(tmp_path, monkeypatch):
    monkeypatch.setattr(runs, "ALWAYS_HASHED_BYTES", 10)
    folder = RunFolder(tmp_path / "run")
    folder.create()
    log = tmp_path / "shift.mcap"
    log.write_bytes(b"x" * 100)
    hashed = []
    first = folder.hash_file(log, hashed.append)
    assert folder.hash_file(log, hashed.append) == first == runs.sha256_of_file(log)
    assert hashed == [100], "the second time the kept hash is used"
    stat = log.stat()
    log.write_bytes(b"y" * 100)
    os.utime(log, ns=(stat.st_atime_ns, stat.st_mtime_ns))  # ctime cannot be set back
    assert folder.hash_file(log, hashed.append) == runs.sha256_of_file(log) != first


@pytest.mark.parametrize("content", [b"", b"[]", b'{"x": 1}', b"null"])
def test_damaged_cache_of_hashes_costs_one_hashing(tmp_path, monkeypatch, content):
    monkeypatch.setattr(runs, "ALWAYS_HASHED_BYTES", 10)
    folder = RunFolder(tmp_path)
    folder.file(".hashes.json").write_bytes(content)
    log = tmp_path / "shift.mcap"
    log.write_bytes(b"x" * 100)
    assert folder.hash_file(log) == runs.sha256_of_file(log)
    assert folder.hash_file(log) == runs.sha256_of_file(log)
