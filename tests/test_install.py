"""What a person gets who installs gradetrace: a lock that can be trusted, and a wheel that is complete."""

import os
import re
import shutil
import subprocess
import sys
import sysconfig
import tomllib
from pathlib import Path

import pytest

CHECKOUT = Path(__file__).resolve().parent.parent
LOCKS = ["requirements.lock", "requirements-dev.lock"]


def requirements(lock):
    """The entries of a lock, one line of text for each, by the name of what is required."""
    text = (CHECKOUT / lock).read_text(encoding="utf-8")
    lines = [line for line in text.splitlines() if not line.lstrip().startswith("#")]
    entries = "\n".join(lines).replace("\\\n", " ").splitlines()
    return [entry for entry in entries if entry.strip()]


def uv():
    """The uv that the Makefile set up, or else the one on the path."""
    ours = CHECKOUT / ".tools/bin/uv"
    found = str(ours) if ours.exists() else shutil.which("uv")
    if found is None:
        pytest.skip("the wheel is not tried: no uv here (`make setup` brings one)")
    return found


def run(*command, cwd=CHECKOUT):
    # PYTHONPATH and the like would let the checkout shine through into the folder that is tried.
    env = {key: value for key, value in os.environ.items() if not key.startswith(("PYTHON", "VIRTUAL_ENV"))}
    done = subprocess.run([str(part) for part in command], cwd=cwd, env=env, capture_output=True, text=True)
    assert done.returncode == 0, f"{command}\n{done.stdout}\n{done.stderr}"
    return done.stdout


@pytest.mark.parametrize("lock", LOCKS)
def test_every_requirement_is_pinned_and_hashed(lock):
    entries = requirements(lock)
    assert len(entries) > 20
    for entry in entries:
        assert re.match(r"[a-z0-9-]+==\d\S*( ;[^@]*?)? +--hash=sha256:[0-9a-f]{64}\b", entry), entry


@pytest.mark.parametrize("lock", LOCKS)
def test_lock_names_no_package_host_and_no_path(lock):
    text = (CHECKOUT / lock).read_text(encoding="utf-8")
    for suspect in [
        "://",
        "--index-url",
        "--extra-index-url",
        "--find-links",
        "--trusted-host",
        " @ ",
        "file:",
        "\n-",
    ]:
        assert suspect not in text, suspect


def test_locks_hold_what_the_project_asks_for():
    project = tomllib.loads((CHECKOUT / "pyproject.toml").read_text(encoding="utf-8"))
    asked = project["project"]["dependencies"]
    asked_dev = [item for item in project["dependency-groups"]["dev"] if isinstance(item, str)]

    def names(items):
        return {re.match(r"[A-Za-z0-9_.-]+", item)[0].lower().replace("_", "-") for item in items}

    runtime, development = (names(requirements(lock)) for lock in LOCKS)
    assert names(asked) <= runtime
    assert names(asked_dev) <= development


def test_development_lock_holds_the_runtime_lock():
    assert set(requirements(LOCKS[0])) <= set(requirements(LOCKS[1]))


@pytest.fixture(scope="module")
def installed(tmp_path_factory):
    """The folder of an environment that has the wheel and, from the environment of the tests, what it needs."""
    folder = tmp_path_factory.mktemp("install")
    run(sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", folder / "dist")
    (wheel,) = (folder / "dist").glob("*.whl")
    environment = folder / "environment"
    run(uv(), "venv", "--quiet", "--no-project", "--python", sys.executable, environment)
    run(uv(), "pip", "install", "--quiet", "--no-deps", "--python", environment / "bin/python", wheel)
    # A .pth file shows it the dependencies. Those of the folder that is named there are not read in
    # turn, so the editable install of the checkout stays out.
    (site_packages,) = environment.glob("lib/python*/site-packages")
    (site_packages / "dependencies.pth").write_text(sysconfig.get_path("purelib") + "\n", encoding="utf-8")
    return environment


def test_wheel_runs_in_an_empty_folder(installed, tmp_path):
    assert "Usage: gradetrace" in run(installed / "bin/gradetrace", "--help", cwd=tmp_path)
    assert "Usage: gradetrace" in run(installed / "bin/python", "-m", "pipeline", "--help", cwd=tmp_path)
    where = run(installed / "bin/python", "-c", "import pipeline; print(pipeline.__file__)", cwd=tmp_path)
    assert Path(where.strip()).is_relative_to(installed)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("kind", ["schema", "template"])
def test_wheel_carries_the_files_of_the_checkout(installed, tmp_path, kind):
    question = f"from pipeline import resources; print(resources.{kind}_folder())"
    carried = Path(run(installed / "bin/python", "-c", question, cwd=tmp_path).strip())
    assert carried.is_relative_to(installed)

    def contents(folder):
        return {path.relative_to(folder): path.read_bytes() for path in folder.rglob("*") if path.is_file()}

    assert contents(carried)
    assert contents(carried) == contents(CHECKOUT / f"{kind}s")


def test_checkout_finds_its_own_schemas_and_templates():
    from pipeline import resources

    assert resources.schema_folder() == CHECKOUT / "schemas"
    assert resources.template_folder() == CHECKOUT / "templates"


def test_help_costs_less_than_300_ms():
    # Processor time, since the tests next door may keep the cores busy; the best of five, since the
    # first may have to compile. A wait for the disk would be missed, the import of pandas (2 s) is not.
    def cpu_s():
        process = subprocess.Popen(
            [sys.executable, "-m", "pipeline", "--help"], stdout=subprocess.DEVNULL, cwd=CHECKOUT
        )
        _, status, usage = os.wait4(process.pid, 0)
        process.returncode = os.waitstatus_to_exitcode(status)
        assert process.returncode == 0
        return usage.ru_utime + usage.ru_stime

    assert min(cpu_s() for _ in range(5)) < 0.3


@pytest.mark.parametrize("first", ["import pipeline, numba", "import numba, pipeline"])
def test_compiled_code_lies_in_a_folder_of_its_own_whoever_loads_the_compiler(first):
    """Numba keeps it by file and does not see that a function called from another file has changed."""
    code = f"import os; os.environ.pop('NUMBA_CACHE_DIR', None); {first}; print(numba.config.CACHE_DIR)"
    folder = run(sys.executable, "-c", code).strip()
    print(folder)
    assert Path(folder).name.startswith("compiled-")
