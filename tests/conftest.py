"""One short log of a site whose truth is known, and one run of it, for the tests that need a whole job."""

import fcntl
import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import pytest

LOG = "short.mcap"


@dataclass(frozen=True)
class Done:
    """A command that has ended."""

    code: int
    out: str
    err: str

    @property
    def last(self) -> str:
        return self.out.strip().splitlines()[-1] if self.out.strip() else ""


def run_command(*arguments: object, cwd: Path | None = None) -> Done:
    """Run the command as a person would, in a process of its own, and wait for it."""
    command = [sys.executable, "-m", "pipeline", *map(str, arguments)]
    done = subprocess.run(
        command, cwd=cwd, env=quiet_environment(), capture_output=True, text=True, timeout=240
    )
    return Done(done.returncode, done.stdout, done.stderr)


def quiet_environment() -> dict[str, str]:
    """Linear algebra on one thread: the tests next door want the cores too."""
    return {**os.environ, "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}


def once(folder: Path, make: Callable[[Path], None]) -> Path:
    """A folder that is made once for all the processes of a test run."""
    with folder.with_name(f".{folder.name}.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not folder.exists():
            growing = folder.with_name(f".{folder.name}.growing")
            shutil.rmtree(growing, ignore_errors=True)
            growing.mkdir()
            make(growing)
            growing.rename(folder)
    return folder


@pytest.fixture(scope="session")
def gradetrace() -> Callable[..., Done]:
    """The command: ``gradetrace("report", log)`` -> what it said and its exit code."""
    return run_command


@pytest.fixture(scope="session")
def shared_folder(tmp_path_factory) -> Path:
    """A folder that the processes of one test run share."""
    base = tmp_path_factory.getbasetemp()
    return base.parent if os.environ.get("PYTEST_XDIST_WORKER") else base


@pytest.fixture(scope="session")
def recorded(shared_folder) -> Path:
    """Folder of a short log of a known site with the files beside it; not to be written to.

    One cycle of digging, 640x480 at 3 Hz: the least that makes a whole report, in a few seconds.
    """

    def record(folder: Path) -> None:
        from dataclasses import replace

        from pipeline.synthetic import recording, specification

        spec = replace(specification.trench(), name="short", cycles=1, rate_hz=3.0)
        recording.record(spec, 3, folder, jobs=1)

    return once(shared_folder / "recorded", record)


@pytest.fixture
def job_folder(recorded, tmp_path) -> Path:
    """A copy of the short log and the files beside it, to be spoiled, without the truth."""
    folder = tmp_path / "job"
    shutil.copytree(recorded, folder, ignore=shutil.ignore_patterns("truth"))
    return folder


@pytest.fixture(scope="session")
def finished(recorded, shared_folder) -> tuple[Path, Done]:
    """The run folder of the short log, and what the command said; not to be written to."""

    def run(folder: Path) -> None:
        done = run_command("report", recorded / LOG, "--runs", folder / "runs", "--jobs", 2)
        (folder / "out").write_text(done.out)
        (folder / "err").write_text(done.err)
        (folder / "code").write_text(str(done.code))

    folder = once(shared_folder / "finished", run)
    done = Done(
        int((folder / "code").read_text()), (folder / "out").read_text(), (folder / "err").read_text()
    )
    return folder / "runs" / "short", done
