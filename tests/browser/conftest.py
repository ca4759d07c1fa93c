"""Debian's Chromium without a screen, told to stay off the network; without one these tests are skipped."""

import shutil
import subprocess
from pathlib import Path

import pytest

from pipeline.report import render
from tests.report.conftest import made_up_inputs

NAMES = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
FLAGS = (
    "--headless",
    "--no-sandbox",
    "--disable-gpu",
    "--disable-quic",
    "--disable-dev-shm-usage",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--disable-default-apps",
    "--hide-scrollbars",
    "--host-resolver-rules=MAP * ~NOTFOUND",
    "--virtual-time-budget=3000",
)


class Browser:
    """One short life of Chromium per call, each with a fresh profile."""

    def __init__(self, program, folder):
        self.program, self._folder, self._count = program, folder, 0

    def __call__(self, page, *flags):
        """What it prints when it opens `page`, a file, with these flags."""
        self._count += 1
        profile = self._folder / f"profile-{self._count}"
        done = subprocess.run(
            [self.program, *FLAGS, f"--user-data-dir={profile}", *flags, Path(page).as_uri()],
            capture_output=True,
            timeout=120,
            check=True,
        )
        shutil.rmtree(profile, ignore_errors=True)
        return done.stdout.decode("utf-8")


@pytest.fixture(scope="session")
def browser(tmp_path_factory):
    program = next(filter(None, map(shutil.which, NAMES)), None)
    if program is None:
        pytest.skip("no Chromium here: the page was not opened in a browser")
    return Browser(program, tmp_path_factory.mktemp("chromium"))


@pytest.fixture(scope="session")
def page():
    return render(made_up_inputs())


@pytest.fixture(scope="session")
def page_file(page, tmp_path_factory):
    file = tmp_path_factory.mktemp("page") / "report.html"
    file.write_text(page.html, encoding="utf-8")
    return file
