"""A log of rendered tags with the two files that describe it, small and quick."""

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pytest
import simplejpeg

from benchmarks._tag_picture import View, picture
from pipeline.logs.writer import LogWriter
from pipeline.runs import RunFolder
from pipeline.stages.job import Job, describe, named_files

START = 1_700_000_000_000_000_000
STEP = 100_000_000
WIDTH, HEIGHT = 200, 160

MACHINE = """\
format = "gradetrace/machine/1"

[machine]
id = "EX-1"

[bodies.cab]
kind = "moving"

[bodies.bucket]
kind = "joint"
parent = "cab"
axis = { xyz_m = [0, 0, 2], rpy_deg = [0, 90, 0], sigma_mm = 1.0, sigma_deg = 0.1 }

[cameras.front]
topic = "/front/image"
body = "cab"
mount = { xyz_m = [0, 0, 0], rpy_deg = [0, 0, 0], sigma_mm = 1, sigma_deg = 0.1 }
intrinsics_sigma = [1, 1, 1, 1, 0, 0, 0, 0, 0]

[cameras.side]
topic = "/side/image"
body = "cab"
mount = { xyz_m = [0, 0, 0], rpy_deg = [0, 0, 0], sigma_mm = 1, sigma_deg = 0.1 }

[cameras.side.intrinsics]
width = 200
height = 160
fx = 400
fy = 400
cx = 100
cy = 80
sigma = [1, 1, 1, 1, 0, 0, 0, 0, 0]

[markers.plate]
body = "cab"
family = "tag36h11"
tags = [{ id = 1, size_m = 0.2 }]
mount = { xyz_m = [0, 0, 0], rpy_deg = [0, 0, 0], sigma_mm = 1, sigma_deg = 0.1 }

[sensors.pot]
topic = "/pot"
joint = "bucket"
noise = 0.002
curve = { output = "angle_deg", coefficients = [0, 1], sigma = [0, 0] }

[cutting_edge]
body = "bucket"
width_m = 0.9
mount = { xyz_m = [0, 0, 0.8], rpy_deg = [0, 0, 0], sigma_mm = 2, sigma_deg = 0.2 }
"""

SITE = """\
format = "gradetrace/site/1"

[site]
id = "S"

[grid]
unit = "m"
origin = [0, 0, 0]

[benchmarks.bm]
family = "tag25h9"
tags = [{ id = 2, size_m = 0.3 }]
pose = { enh = [1, 2, 3], rpy_deg = [90, 0, 0], sigma_mm = 2, sigma_deg = 0.1 }

[alignment]
points = [[0, 0], [0, 10]]

[design]
file = "design.csv"
kind = "profile_csv"

[tolerance]
high_mm = 25
low_mm = 25
"""


def canvas(views: list[tuple[View, int, int]], rng) -> bytes:
    """A JPEG of `WIDTH` x `HEIGHT` with tags whose pictures' top-left corners are at given places."""
    grey = np.clip(rng.normal(110, 4, (HEIGHT, WIDTH)), 0, 255).astype(np.uint8)
    for view, left, top in views:
        tag, _ = picture(view, rng, fine=4)
        cut = tag[: HEIGHT - top, : WIDTH - left]
        grey[top : top + cut.shape[0], left : left + cut.shape[1]] = cut
    return simplejpeg.encode_jpeg(np.ascontiguousarray(grey[..., None]), quality=90, colorspace="GRAY")


@dataclass
class Watch:
    """Progress that keeps what it is told."""

    warnings: list[str] = field(default_factory=list)
    done: float = 0
    expected: float = 0

    def total(self, amount, unit=""):
        self.expected = amount

    def advance(self, amount=1):
        self.done += amount

    def warn(self, sentence):
        self.warnings.append(sentence)


def write_log(path: Path, n: int = 80, known: bool = True, spoil=None) -> Path:
    """N ticks of 0.8 s: two cameras that see tag36h11 id 1, tag25h9 id 2 and tag36h11 id 9, and a sensor.

    With `known` false only id 9. `spoil(camera, k, jpeg, time_ns)` gives back what is written instead.
    """
    rng = np.random.default_rng(5)
    spoil = spoil or (lambda camera, k, jpeg, time_ns: (jpeg, time_ns))
    views = [(View("tag36h11", 9, 40, 10, 0, 5, noise=1), 120, 60)]
    if known:
        views += [(View("tag36h11", 1, 30, 20, 30, 12), 5, 5), (View("tag25h9", 2, 32, 0, 0, 30), 8, 80)]
    pictures = [canvas(views, rng) for _ in range(3)]
    with LogWriter(path, chunk_size=100_000) as log:
        log.camera_calibration(
            "/front/camera_info", START, "front", WIDTH, HEIGHT, [400, 400, 100, 80, 0, 0, 0, 0, 0]
        )
        for k in range(n):
            for camera, topic in (("front", "/front/image"), ("side", "/side/image")):
                t = START + 8 * k * STEP
                jpeg, stamp = spoil(camera, k, pictures[k % 3], t)
                log.image(topic, stamp, camera, jpeg, log_time_ns=t + 1000)
            log.sample("/pot", START + 8 * k * STEP, 2.0, "V")
    return path


def open_job(
    folder: Path, log: Path, runs: str = "runs", workers: int = 1, machine: str = MACHINE, site: str = SITE
) -> Job:
    (folder / "machine.toml").write_text(machine)
    (folder / "site.toml").write_text(site)
    (folder / "design.csv").write_text("station,elevation,width,side_slope\n0,0,1,0\n10,0,1,0\n")
    machine_model, machine_source, site_model, site_source = describe(log)
    run_folder = RunFolder(folder / runs / log.stem)
    run_folder.create()
    return Job(
        log=log,
        log_sha256="0",
        folder=run_folder,
        machine=machine_model,
        site=site_model,
        machine_source=machine_source,
        site_source=site_source,
        files=named_files(site_model, site_source, run_folder),
        workers=workers,
    )


@pytest.fixture(scope="session")
def shift(tmp_path_factory) -> Path:
    """One log for all tests that only read it."""
    return write_log(tmp_path_factory.mktemp("shift") / "shift.mcap")
