"""The stage that adjusts, killed in the middle: it goes on from its last iteration, to the same bytes."""

import os
import signal
import subprocess
import sys

import numpy as np

from pipeline.stages.estimate import Scratch

KILLED = """
import os, signal, sys
from pathlib import Path
from pipeline.estimation import gauss_newton, optimise
from pipeline.stages.estimate import Scratch
from tests.estimation.simulator import Options, draw
from tests.estimation.test_adjust import _problem

class Killed(Scratch):
    left = int(sys.argv[2])

    def keep(self, name, arrays):
        super().keep(name, arrays)
        Killed.left -= 1
        if Killed.left == 0:
            os.kill(os.getpid(), signal.SIGKILL)

solved = []
solve = gauss_newton.Step.solve
gauss_newton.Step.solve = lambda self, damping: solved.append(0) or solve(self, damping)
problem = _problem(draw(3, Options(9, outliers=0.1)))
found = optimise.optimise(problem, 2.5, 60, False, Killed(Path(sys.argv[1]), "of this", 0.0), "first")
poses = b"".join(T.tobytes() for T in found.values.pose)
print(len(solved), poses.hex(), found.values.z.tobytes().hex())
"""


def _adjusted(folder, kill_after):
    done = subprocess.run(
        [sys.executable, "-c", KILLED, str(folder), str(kill_after)],
        capture_output=True,
        text=True,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)},
    )
    return done.returncode, done.stdout.split()


def test_killed_after_three_iterations_it_goes_on_to_the_same_bytes(tmp_path):
    for folder in ("undisturbed", "killed"):
        (tmp_path / folder).mkdir()
    code, (steps, *expected) = _adjusted(tmp_path / "undisturbed", -1)
    assert code == 0
    code, printed = _adjusted(tmp_path / "killed", 3)
    assert code == -signal.SIGKILL and not printed
    code, (steps_left, *found) = _adjusted(tmp_path / "killed", -1)
    assert code == 0 and found == expected
    assert int(steps_left) == int(steps) - 3
    assert [path.name for path in (tmp_path / "killed").iterdir()] == ["first-optimum.npz"]


def test_what_was_kept_for_other_inputs_or_is_torn_is_refused(tmp_path):
    arrays = {"z": np.arange(3.0), "state": np.array([1.0, np.inf])}
    Scratch(tmp_path, "of this", 0.0).keep("first 0", arrays)
    found = Scratch(tmp_path, "of this", 0.0).recall("first 0")
    assert sorted(found) == ["state", "z"]
    np.testing.assert_array_equal(found["z"], arrays["z"])
    assert Scratch(tmp_path, "of that", 0.0).recall("first 0") is None
    assert Scratch(tmp_path, "of this", 0.0).recall("first 1") is None
    file = next(tmp_path.iterdir())
    file.write_bytes(file.read_bytes()[:-40])
    assert Scratch(tmp_path, "of this", 0.0).recall("first 0") is None


def test_what_took_no_time_is_not_kept(tmp_path):
    Scratch(tmp_path, "of this").keep("first 0", {"z": np.zeros(3)})
    assert list(tmp_path.iterdir()) == []
