"""Slices: the same bytes with any number of workers, any length of slices and after any kill."""

import multiprocessing
import os
import signal
import subprocess
import sys
import threading
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import pipeline.detection.workers as workers_module
from pipeline.config.site import DetectionSettings
from pipeline.detection.slices import Search, given_up, read_piece
from pipeline.detection.spans import slices_of
from pipeline.detection.workers import search_slices
from pipeline.errors import DetectionError
from pipeline.logs.reader import read_log

from .conftest import HEIGHT, START, STEP, WIDTH

TOPICS = {"front": "/front/image", "side": "/side/image"}
SIZES = dict.fromkeys(TOPICS, (WIDTH, HEIGHT))
KNOWN = {"tag36h11": frozenset({1}), "tag25h9": frozenset({2})}
SLICE_S = 20.0


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
    return Search(log, contents, ("tag25h9", "tag36h11"), KNOWN, SIZES, DetectionSettings())


def run(log: Path, folder: Path, workers: int, slice_s: float = SLICE_S) -> list:
    slices = slices_of(frames_table(log), TOPICS, SIZES, folder, slice_s)
    search_slices(search_of(log), slices, workers)
    return slices


def pieces(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in sorted(folder.rglob("*.parquet"))}


def test_slices_cover_every_frame_once_and_depend_on_time_alone(shift, tmp_path):
    frames = frames_table(shift)
    slices = slices_of(frames, TOPICS, SIZES, tmp_path, SLICE_S)
    for camera in TOPICS:
        mine = [part for part in slices if part.camera == camera]
        assert len(mine) == 4
        assert np.concatenate([part.frame for part in mine]).tolist() == list(range(80))
        assert all(np.ptp(part.time_ns) < SLICE_S * 1e9 for part in mine)
        # The first frames after 20, 40 and 60 s.
        assert [part.ahead and part.ahead[0] for part in mine] == [25, 50, 75, None]
        assert [len(span) for part in mine for span in part.spans()] == [26, 26, 26, 5]


def test_one_worker_and_two_give_the_same_bytes(shift, tmp_path):
    run(shift, tmp_path / "one", 1)
    run(shift, tmp_path / "two", 2)
    assert pieces(tmp_path / "one") == pieces(tmp_path / "two")
    assert len(pieces(tmp_path / "one")) == 8


def test_slices_of_any_length_give_the_same_rows(shift, tmp_path):
    """Tags are followed across spans, so what a slice does not see of its neighbours must not matter."""
    tables = []
    for slice_s in (SLICE_S, 40.0, 1000.0):
        slices = run(shift, tmp_path / str(slice_s), 1, slice_s)
        pieces = [read_piece(part).columns for part in slices]
        tables.append({name: np.concatenate([one[name] for one in pieces]) for name in pieces[0]})
    print(len(slices), "slices,", len(tables[0]["frame"]), "rows")
    for other in tables[1:]:
        for name, column in tables[0].items():
            assert column.tobytes() == other[name].tobytes() or column.tolist() == other[name].tolist(), name


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


def test_workers_that_vanish_whatever_they_do_end_the_job(shift, tmp_path, monkeypatch):
    """A log that has gone kills each worker as it starts: what a lack of memory looks like from outside."""
    monkeypatch.setattr(workers_module, "LOST_SLICES", 1)  # each start of a process takes a second
    search = search_of(shift)
    slices = slices_of(frames_table(shift), TOPICS, SIZES, tmp_path, SLICE_S)
    gone = Search(
        tmp_path / "gone.mcap", search.contents, search.families, KNOWN, search.sizes, search.settings
    )
    with pytest.raises(DetectionError, match=r"killed 1 times.*camera .front..*--jobs"):
        search_slices(gone, slices, 2)


def test_work_is_told_to_begin_when_all_is_compiled_and_before_any_slice(shift, tmp_path, monkeypatch):
    """The time that remains is reckoned from there; a first run compiles for a minute."""
    told = []
    monkeypatch.setattr(workers_module, "warm_up", lambda search: told.append("compiled"))
    slices = slices_of(frames_table(shift), TOPICS, SIZES, tmp_path, SLICE_S)
    search_slices(
        search_of(shift), slices, 1, lambda part: told.append("slice"), lambda: told.append("begun")
    )
    assert told == ["compiled", "begun"] + ["slice"] * len(slices)
    told.clear()
    search_slices(
        search_of(shift), slices, 1, lambda part: told.append("slice"), lambda: told.append("begun")
    )
    assert told == ["begun"] + ["slice"] * len(slices)


class Deadly(dict):
    """A table of sizes that ends the process which asks for the size of one camera's pictures."""

    def __getitem__(self, camera):
        if camera == "side" and multiprocessing.parent_process() is not None:
            os._exit(9)
        return super().__getitem__(camera)


class DeadlyOnce(Deadly):
    """The same, but only the first time, as when memory was short for a moment."""

    def __init__(self, sizes=(), mark=""):
        super().__init__(sizes)
        self.mark = mark

    def __reduce__(self):
        return DeadlyOnce, (dict(self), self.mark)

    def __getitem__(self, camera):
        if camera == "side" and not Path(self.mark).exists():
            Path(self.mark).touch()
            os._exit(9)
        return dict.__getitem__(self, camera)


def test_a_slice_that_ends_its_process_twice_is_skipped_and_the_rest_is_done(shift, tmp_path):
    search = replace(search_of(shift), sizes=Deadly(SIZES))
    slices = slices_of(frames_table(shift), TOPICS, SIZES, tmp_path, 1000.0)
    told = []
    search_slices(search, slices, 2, told.append)
    front, side = slices
    assert given_up(slices) == [side]
    assert read_piece(front).frames == {"searched": 80}
    assert read_piece(side).frames == {"lost with a worker": 80}
    assert np.sum(read_piece(front).columns["status"] == "accepted") == 160
    assert len(read_piece(side).columns["frame"]) == 0
    assert sorted(part.camera for part in told) == ["front", "side"]


def test_a_worker_that_dies_is_replaced_and_its_slice_repeated(shift, tmp_path):
    run(shift, tmp_path / "sound", 1, 1000.0)
    search = replace(search_of(shift), sizes=DeadlyOnce(SIZES, str(tmp_path / "mark")))
    slices = slices_of(frames_table(shift), TOPICS, SIZES, tmp_path / "died", 1000.0)
    search_slices(search, slices, 2)
    assert (tmp_path / "mark").exists()
    assert given_up(slices) == []
    assert pieces(tmp_path / "died") == pieces(tmp_path / "sound")


def test_what_is_found_is_what_was_drawn(shift, tmp_path):
    """Both described tags in every frame, searched or followed; the other one where a search comes upon it."""
    for part in run(shift, tmp_path, 1):
        columns = read_piece(part).columns
        keys = part.frame[list(part.starts)]
        for family, tag_id in (("tag36h11", 1), ("tag25h9", 2)):
            rows = (columns["family"] == family) & (columns["tag_id"] == tag_id)
            assert columns["frame"][rows].tolist() == part.frame.tolist()
            assert set(columns["status"][rows]) == {"accepted"}
            searched = rows & (columns["how"] == "searched")
            assert set(keys) <= set(columns["frame"][searched])
            assert np.all(np.isnan(columns["margin"][rows & ~searched]))
        rows = columns["tag_id"] == 9
        assert set(keys) <= set(columns["frame"][rows])
        assert set(columns["status"][rows]) == {"unknown id"}
        assert set(columns["how"][rows]) == {"searched"}
        assert columns["time_ns"].tolist() == (START + 8 * STEP * columns["frame"].astype(np.int64)).tolist()


def test_an_interrupt_while_it_is_held_comes_at_the_end_whichever_thread_the_system_gives_it_to():
    """Other threads do not hold it: while Arrow's are there, the system gives it to one of them at once."""
    stop = threading.Event()
    other = threading.Thread(target=stop.wait)
    other.start()
    handler, mask = signal.getsignal(signal.SIGINT), signal.pthread_sigmask(signal.SIG_BLOCK, ())
    reached = False
    try:
        with pytest.raises(KeyboardInterrupt), workers_module._interrupts_held():
            os.kill(os.getpid(), signal.SIGINT)
            time.sleep(0.05)
            reached = True
    finally:
        stop.set()
        other.join()
    assert reached
    assert signal.getsignal(signal.SIGINT) is handler
    assert signal.pthread_sigmask(signal.SIG_BLOCK, ()) == mask
