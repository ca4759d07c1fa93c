"""Pieces of work: the same bytes with any number of workers and after any kill."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

import pipeline.detection.slices as slices_module
from pipeline.config.site import DetectionSettings
from pipeline.detection.slices import Search, read_piece, search_slices, slices_of
from pipeline.errors import DetectionError
from pipeline.logs.reader import read_log

from .conftest import HEIGHT, START, STEP, WIDTH

TOPICS = {"front": "/front/image", "side": "/side/image"}
KNOWN = {"tag36h11": frozenset({1}), "tag25h9": frozenset({2})}


def frames_table(log: Path) -> dict[str, np.ndarray]:
    with read_log(log) as reader:
        rows = sorted((f.camera, f.time_ns, f.log_time_ns) for f in reader.frames(TOPICS))
    columns = {
        "camera": np.array([row[0] for row in rows], object),
        "time_ns": np.array([row[1] for row in rows]),
        "log_time_ns": np.array([row[2] for row in rows]),
    }
    columns["frame"] = np.concatenate([np.arange(np.sum(columns["camera"] == name)) for name in TOPICS])
    return columns


def search_of(log: Path) -> Search:
    with read_log(log) as reader:
        contents = reader.contents
    sizes = dict.fromkeys(TOPICS, (WIDTH, HEIGHT))
    return Search(log, contents, ("tag25h9", "tag36h11"), KNOWN, sizes, DetectionSettings())


def run(log: Path, folder: Path, workers: int) -> list:
    slices = slices_of(frames_table(log), TOPICS, folder)
    search_slices(search_of(log), slices, workers)
    return slices


def pieces(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in sorted(folder.rglob("*.parquet"))}


def test_slices_cover_every_frame_once_and_depend_on_time_alone(shift, tmp_path):
    frames = frames_table(shift)
    slices = slices_of(frames, TOPICS, tmp_path)
    for camera in TOPICS:
        mine = [part for part in slices if part.camera == camera]
        assert len(mine) == 3
        assert np.concatenate([part.frame for part in mine]).tolist() == list(range(80))
        assert all(np.ptp(part.time_ns) < 25e9 for part in mine)


def test_one_worker_and_two_give_the_same_bytes(shift, tmp_path):
    run(shift, tmp_path / "one", 1)
    run(shift, tmp_path / "two", 2)
    assert pieces(tmp_path / "one") == pieces(tmp_path / "two")
    assert len(pieces(tmp_path / "one")) == 6


def test_a_piece_that_is_there_is_not_made_again_and_a_damaged_one_is(shift, tmp_path):
    slices = run(shift, tmp_path, 1)
    whole = pieces(tmp_path)
    slices[1].piece.write_bytes(whole["front/000001.parquet"][:-100])
    slices[2].piece.unlink()
    before = slices[0].piece.stat().st_mtime_ns
    run(shift, tmp_path, 1)
    assert pieces(tmp_path) == whole
    assert slices[0].piece.stat().st_mtime_ns == before


def test_a_killed_run_is_finished_to_the_same_bytes_and_leaves_no_process(shift, tmp_path):
    run(shift, tmp_path / "whole", 1)
    folder = tmp_path / "killed"
    script = tmp_path / "search.py"
    script.write_text(
        "import sys\nfrom pathlib import Path\nfrom tests.detection.test_slices import run\n"
        "if __name__ == '__main__':\n    run(Path(sys.argv[1]), Path(sys.argv[2]), 2)\n"
    )
    environment = os.environ | {"PYTHONPATH": str(Path(__file__).parents[2])}
    process = subprocess.Popen([sys.executable, str(script), str(shift), str(folder)], env=environment)
    deadline = time.monotonic() + 60
    while not list(folder.rglob("*.parquet")) and time.monotonic() < deadline:
        time.sleep(0.02)
    children = Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text().split()
    process.send_signal(signal.SIGKILL)
    process.wait()
    kept = pieces(folder)
    assert kept, "killed too early"
    while any(_lives(int(child)) for child in children) and time.monotonic() < deadline:
        time.sleep(0.05)
    assert not any(_lives(int(child)) for child in children)
    run(shift, folder, 2)
    assert pieces(folder) == pieces(tmp_path / "whole")


def _lives(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0] != "Z"
    except OSError:
        return False


def test_a_worker_that_vanishes_again_and_again_is_named(shift, tmp_path, monkeypatch):
    """A log that has gone kills each worker as it starts: what a lack of memory looks like from outside."""
    monkeypatch.setattr(slices_module, "LOST_WORKERS", 1)  # each start of a process takes a second
    search = search_of(shift)
    slices = slices_of(frames_table(shift), TOPICS, tmp_path)
    gone = Search(
        tmp_path / "gone.mcap", search.contents, search.families, KNOWN, search.sizes, search.settings
    )
    with pytest.raises(DetectionError, match=r"killed 1 times.*camera 'front'.*--workers"):
        search_slices(gone, slices, 2)


def test_what_is_found_is_what_was_drawn(shift, tmp_path):
    for part in run(shift, tmp_path, 1):
        columns = read_piece(part).columns
        assert columns["frame"].tolist() == np.repeat(part.frame, 3).tolist()
        for family, tag_id, status in (
            ("tag36h11", 1, "accepted"),
            ("tag25h9", 2, "accepted"),
            ("tag36h11", 9, "unknown id"),
        ):
            rows = (columns["family"] == family) & (columns["tag_id"] == tag_id)
            assert rows.sum() == len(part.frame)
            assert set(columns["status"][rows]) == {status}
        assert columns["time_ns"].tolist() == (START + 8 * STEP * columns["frame"].astype(np.int64)).tolist()
