"""A run that was killed while it detected goes on, and ends with the bytes of a run that nobody disturbed."""

import json
import os
import signal
import subprocess
import sys
import time

import pytest


def contents(folder):
    """Every file of a run folder; of the manifests, what may not differ from run to run."""
    found = {}
    for path in sorted(folder.rglob("*")):
        name = str(path.relative_to(folder))
        if not path.is_file() or name in (".lock", ".hashes.json"):
            continue
        found[name] = path.read_bytes()
        if name.endswith(".manifest.json"):
            manifest = json.loads(found[name])
            assert manifest.pop("seconds") >= 0
            assert manifest.pop("finished_utc")
            found[name] = manifest
    return found


def pieces(run):
    return [
        path for path in run.glob(".detect-*/**/*") if path.is_file() and not path.name.endswith(".partial")
    ]


def kill_when(process, happened, limit_s=120):
    """Kill a process and all its children with SIGKILL as soon as something has happened."""
    until = time.monotonic() + limit_s
    while not happened():
        assert process.poll() is None, "it ended before it could be killed"
        assert time.monotonic() < until
        time.sleep(0.002)
    os.killpg(process.pid, signal.SIGKILL)
    assert process.wait() == -signal.SIGKILL


def start(log, runs, jobs):
    command = [sys.executable, "-m", "pipeline", "report", str(log), "--runs", str(runs), "--jobs", str(jobs)]
    return subprocess.Popen(
        command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, start_new_session=True
    )


@pytest.mark.parametrize("jobs", [pytest.param(1, marks=pytest.mark.slow), 2])
def test_killed_during_detection_the_same_command_ends_with_the_same_bytes(
    finished, recorded, tmp_path, gradetrace, jobs
):
    undisturbed, _ = finished
    log, run = recorded / "short.mcap", tmp_path / "runs" / "short"
    kill_when(start(log, tmp_path / "runs", jobs), lambda: len(pieces(run)) >= 2)
    assert not (run / "detect.manifest.json").exists()
    done_before = {path.name: path.stat().st_mtime_ns for path in pieces(run)}
    assert done_before
    done = gradetrace("report", log, "--runs", tmp_path / "runs", "--jobs", jobs)
    assert done.code == 0, done.err
    assert "ingest: up to date" in done.out
    found, expected = contents(run), contents(undisturbed)
    assert sorted(found) == sorted(expected), "leftovers, or files that are missing"
    assert [name for name in expected if found[name] != expected[name]] == []


@pytest.mark.slow
def test_killed_while_adjusting_detection_is_not_done_again(finished, recorded, tmp_path, gradetrace):
    undisturbed, _ = finished
    log, run = recorded / "short.mcap", tmp_path / "runs" / "short"
    kill_when(start(log, tmp_path / "runs", 2), (run / "detect.manifest.json").exists)
    done = gradetrace("report", log, "--runs", tmp_path / "runs")
    assert "detect: up to date" in done.out
    found, expected = contents(run), contents(undisturbed)
    assert [name for name in expected if found.get(name) != expected[name]] == []


def test_two_runs_at_once_on_one_folder_do_not_mix(recorded, tmp_path, gradetrace):
    log, run = recorded / "short.mcap", tmp_path / "runs" / "short"
    first = start(log, tmp_path / "runs", 1)
    while not (run / "ingest.manifest.json").exists():
        assert first.poll() is None
        time.sleep(0.01)
    second = gradetrace("report", log, "--runs", tmp_path / "runs")
    assert second.code == 3
    assert second.err.startswith(f"gradetrace: {run} is in use by another gradetrace (process {first.pid})")
    kill_when(first, lambda: True)


def test_ctrl_c_during_detection_is_one_line_and_130(recorded, tmp_path):
    command = [sys.executable, "-m", "pipeline", "report", str(recorded / "short.mcap")]
    process = subprocess.Popen(
        [*command, "--runs", str(tmp_path / "runs"), "--jobs", "2"],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    while not list(tmp_path.glob("runs/short/.detect-*")):
        assert process.poll() is None
        time.sleep(0.01)
    os.killpg(process.pid, signal.SIGINT)
    _, said = process.communicate(timeout=60)
    assert process.returncode == 130
    assert said == "gradetrace: interrupted; the same command goes on where this one stopped\n"
