"""Pictures of some moments, read from a small log whose frames tell which they are."""

import dataclasses
import io

import cv2
import numpy as np
import pytest
import simplejpeg
from PIL import Image

from pipeline import tables
from pipeline.logs import reader as log_reader
from pipeline.logs.writer import LogWriter
from pipeline.report.moments import Moment
from pipeline.runs import Manifest, RunFolder
from pipeline.stages import pictures, report, stage_named
from pipeline.stages.job import Job, describe, open_job

SECOND = 1_000_000_000
T0 = 1_750_000_000 * SECOND
FRAMES, RATE = 300, 10
DELAY = {"left": 20_000_000, "right": 55_000_000, "third": 1_000_000}
MACHINE = """
format = "gradetrace/machine/1"
[machine]
id = "m"
[bodies.cab]
kind = "moving"
[bodies.bucket]
kind = "moving"
[cameras.left]
topic = "/left"
body = "cab"
mount = { xyz_m = [0, 0, 2], rpy_deg = [0, 0, 0], sigma_mm = 5, sigma_deg = 0.1 }
[cameras.right]
topic = "/right"
body = "cab"
mount = { xyz_m = [0, 1, 2], rpy_deg = [0, 0, 0], sigma_mm = 5, sigma_deg = 0.1 }
[cameras.third]
topic = "/third"
body = "cab"
mount = { xyz_m = [0, 2, 2], rpy_deg = [0, 0, 0], sigma_mm = 5, sigma_deg = 0.1 }
[markers.board]
family = "tag36h11"
body = "bucket"
tags = [{ id = 7, size_m = 0.3 }]
mount = { xyz_m = [0, 0, 0], rpy_deg = [0, 0, 0], sigma_mm = 5, sigma_deg = 0.1 }
[cutting_edge]
body = "bucket"
width_m = 1.0
mount = { xyz_m = [0, 0, 1], rpy_deg = [0, 0, 0], sigma_mm = 5, sigma_deg = 0.1 }
"""
SITE = """
format = "gradetrace/site/1"
[site]
id = "s"
[grid]
unit = "m"
origin = [0, 0, 0]
[benchmarks.a]
family = "tag36h11"
tags = [{ id = 1, size_m = 0.5 }]
pose = { enh = [1, 1, 1], rpy_deg = [0, 0, 0], sigma_mm = 1, sigma_deg = 0.1 }
[alignment]
points = [[0, 0], [0, 10]]
[design]
file = "design.csv"
kind = "profile_csv"
[tolerance]
high_mm = 30
low_mm = 30
"""


def grey(k):
    """A picture whose grey value is its number."""
    return np.full((48, 64), k % 250, np.uint8)


def stamp(k, camera):
    return T0 + k * SECOND // RATE + {"left": 0, "right": 3_000_000, "third": 5_000_000}[camera]


def value_of(view):
    return float(np.asarray(Image.open(io.BytesIO(view.jpeg)), float).mean())


def columns(name, **given):
    """Columns of a table: those given, and zeros."""
    n = len(next(iter(given.values())))
    found = {}
    for column in tables.read_schema(name).columns:
        default = np.array(["x"] * n, object) if column.type == "string" else np.zeros(n, column.type)
        found[column.name] = np.asarray(given.get(column.name, default))
    return found


UV = np.array([[10.0, 10], [20, 10], [20, 20], [10, 20]])
RESIDUAL = np.array([[0.1, 0.2], [-0.3, 0.1], [0.0, -0.1], [0.2, 0.0]])


@pytest.fixture
def job(tmp_path):
    """Three cameras at 10 Hz for 30 s: JPEG, raw, and one that sees nothing; tag 7 is used, tag 1 covered."""
    (tmp_path / "machine.toml").write_text(MACHINE)
    (tmp_path / "site.toml").write_text(SITE)
    log = tmp_path / "shift.mcap"
    with LogWriter(log, chunk_size=20_000) as writer:
        for k in range(FRAMES):
            if k == 123:
                # A driver that sends an old picture again: received in the same instant, stamped earlier.
                again = simplejpeg.encode_jpeg(grey(222)[..., None], 95, "GRAY", "Gray")
                writer.image(
                    "/left", stamp(100, "left"), "left", again, log_time_ns=stamp(k, "left") + DELAY["left"]
                )
            writer.image(
                "/left",
                stamp(k, "left"),
                "left",
                simplejpeg.encode_jpeg(grey(k)[..., None], 95, "GRAY", "Gray"),
                log_time_ns=stamp(k, "left") + DELAY["left"],
            )
            writer.raw_image(
                "/right", stamp(k, "right"), "right", grey(k), stamp(k, "right") + DELAY["right"]
            )
            third = simplejpeg.encode_jpeg(grey(k)[..., None], 95, "GRAY", "Gray")
            writer.image(
                "/third", stamp(k, "third"), "third", third, log_time_ns=stamp(k, "third") + DELAY["third"]
            )
    folder = RunFolder(tmp_path / "runs")
    folder.create()
    machine, machine_source, site, site_source = describe(log)
    at = stage_named("report")
    made = Job(log, "0" * 64, folder, machine, site, machine_source, site_source, {}).at(at, "f" * 64)
    cameras = list(machine.cameras)
    rows = [(camera, k) for camera in cameras for k in range(FRAMES)]
    times = np.array([stamp(k, camera) for camera, k in rows])
    received = times + np.array([DELAY[camera] for camera, _ in rows])
    frames = columns(
        "frames",
        camera=np.array([camera for camera, _ in rows], object),
        frame=np.array([k for _, k in rows], np.int32),
        time_ns=times,
        log_time_ns=received,
    )
    made.write_table("frames", frames)
    outputs = {}
    for camera, tags in (("left", (7, 1)), ("right", (7,)), ("third", ())):
        numbers = np.repeat(np.arange(FRAMES), len(tags))
        n = len(numbers)
        corner = {f"{axis}{c}": np.full(n, UV[c, i]) for c in range(4) for i, axis in enumerate("uv")}
        found = columns(
            "detections",
            time_ns=np.array([stamp(k, camera) for k in numbers], np.int64),
            tag_id=np.tile(np.array(tags, np.int32), FRAMES),
            family=np.array(["tag36h11"] * n, object),
            status=np.tile(np.array(["accepted" if t == 7 else "covered" for t in tags], object), FRAMES),
            **corner,
        )
        made.write_table("detections", found, part=camera)
        outputs[f"detections/{camera}.parquet"] = "0"
    folder.write_manifest(Manifest("detect", 1, "f", {}, {}, {}, outputs, {}))
    pairs = [(camera, k, c) for camera in ("left", "right") for k in range(FRAMES) for c in range(4)]
    adjusted = columns(
        "residuals",
        camera=np.array([camera for camera, _, _ in pairs], object),
        time_ns=np.array([stamp(k, camera) for camera, k, _ in pairs]),
        marker=np.array(["board"] * len(pairs), object),
        tag_id=np.full(len(pairs), 7, np.int32),
        corner=np.array([c for *_, c in pairs], np.int32),
        residual_u=np.array([RESIDUAL[c, 0] for *_, c in pairs]),
        residual_v=np.array([RESIDUAL[c, 1] for *_, c in pairs]),
        normalised=np.array([1.0 + c for *_, c in pairs]),
        weight=np.array([1.0 - 0.1 * c for *_, c in pairs]),
    )
    made.write_table("residuals", adjusted)
    made.write_json("log.json", {"cameras": {camera: {"topic": f"/{camera}"} for camera in cameras}})
    return made


def moment(seconds, station=1.0):
    return Moment(station, 0.05, 0.01, "FAIL", T0 + round(seconds * SECOND), 5, 9)


def test_the_frames_nearest_to_the_moment_are_shown_of_jpeg_and_of_raw_cameras(job):
    left, right = pictures.views_of(job, [moment(12.34)])
    assert (left.camera, right.camera) == ("left", "right")
    assert (left.time_ns, right.time_ns) == (stamp(123, "left"), stamp(123, "right"))
    assert value_of(left) == pytest.approx(123, abs=1) and value_of(right) == pytest.approx(123, abs=1)
    assert (left.width, left.height, left.why) == (64, 48, "")


def test_a_frame_further_than_a_second_away_is_none(job):
    """Two seconds after the last frame."""
    views = pictures.views_of(job, [moment(FRAMES / RATE + 2)])
    assert [view.why for view in views] == [
        f"camera '{camera}' took no picture within a second of it" for camera in ("left", "right")
    ]
    assert all(view.jpeg == b"" for view in views)


def test_corners_are_predicted_where_observed_minus_residual_lies(job):
    left, right = pictures.views_of(job, [moment(12.3)])
    assert left.tags["tag"].tolist() == ["tag36h11 7", "tag36h11 1"]
    assert left.tags["marker"].tolist() == ["board", "a"]
    assert left.tags["status"].tolist() == ["accepted", "covered"]
    assert left.tags["uv"][0] == pytest.approx(UV)
    assert left.tags["predicted"][0] == pytest.approx(UV - RESIDUAL)
    assert np.isnan(left.tags["predicted"][1]).all()
    assert (left.tags["normalised"][0], left.tags["weight"][0]) == pytest.approx((4.0, 0.7))
    assert right.tags["tag"].tolist() == ["tag36h11 7"]


def test_two_stations_of_one_frame_share_its_picture(job):
    views = pictures.views_of(job, [moment(12.34, 1.0), moment(12.31, 2.0), moment(20.0, 3.0)])
    assert [view.stations for view in views] == [(1.0, 2.0), (1.0, 2.0), (3.0,), (3.0,)]


def test_only_the_chunks_of_the_moments_are_read(job, monkeypatch):
    loaded = []
    real = log_reader.load_span
    monkeypatch.setattr(
        log_reader, "load_span", lambda file, span: (loaded.append(span), real(file, span))[1]
    )
    views = pictures.views_of(job, [moment(3.0), moment(12.3), moment(25.0)])
    assert all(view.jpeg for view in views)
    with log_reader.read_log(job.log) as reader:
        every = len(reader.contents.spans)
    assert every > 50 and len(loaded) <= 3 * 2 * 2


def cut(job, share=0.7):
    data = job.log.read_bytes()
    job.log.write_bytes(data[: int(share * len(data))])


def test_a_log_that_was_cut_off_is_searched_if_it_is_small(job):
    cut(job)
    early, _, late, _ = pictures.views_of(job, [moment(12.3), moment(29.0)])
    assert value_of(early) == pytest.approx(123, abs=1)
    assert late.jpeg == b"" and late.why == "its picture cannot be read from the log"


def test_a_large_log_without_an_index_is_not_searched(job, monkeypatch):
    cut(job)
    monkeypatch.setattr(pictures, "MAX_WALKED_BYTES", 1000)
    monkeypatch.setattr(pictures, "read_contents", lambda path: pytest.fail("the whole log was walked"))
    for view in pictures.views_of(job, [moment(12.3)]):
        assert view.why.startswith("shift.mcap has no index") and view.jpeg == b"" and len(view.tags["tag"])


def test_a_picture_that_is_corrupt_is_a_sentence(job):
    data = job.log.read_bytes()
    start = data.index(simplejpeg.encode_jpeg(grey(123)[..., None], 95, "GRAY", "Gray"))
    broken = bytearray(data)
    broken[start : start + 2] = b"XX"
    for view in pictures.views_of(job, [moment(12.3)]):
        assert view.jpeg
    job.log.write_bytes(broken)
    left, _ = pictures.views_of(job, [moment(12.3)])
    # The chunk's CRC tells, or the decoder: either way a sentence.
    assert left.jpeg == b"" and left.why


def test_a_log_that_is_gone_is_a_sentence_without_a_folder(job):
    job.log.unlink()
    for view in pictures.views_of(job, [moment(12.3)]):
        assert view.why.startswith("shift.mcap: no such file") and str(job.log.parent) not in view.why


def test_of_three_cameras_those_with_the_most_tags_are_shown(job):
    third = dict(job.read_table("detections", part="left"))
    third["time_ns"] = third["time_ns"] + 5_000_000
    job.write_table("detections", third, part="third")
    views = pictures.views_of(job, [moment(12.3)])
    assert [view.camera for view in views] == ["left", "third"]  # two tags each, the right one has one


def test_a_run_without_residuals_shows_what_was_found(job):
    job.folder.file("residuals.parquet").unlink()
    left, _ = pictures.views_of(job, [moment(12.3)])
    assert left.jpeg and np.isnan(left.tags["predicted"]).all()


def test_the_same_log_gives_the_same_views(job):
    first, again = (pictures.views_of(job, [moment(12.3), moment(3.0)]) for _ in range(2))
    for one, other in zip(first, again):
        for field in dataclasses.fields(one):
            if field.name != "tags":
                assert getattr(one, field.name) == getattr(other, field.name)


def test_predicted_corners_of_a_board_are_the_picture_of_a_plane(recorded, finished):
    """One homography must carry a flat board onto the corners that the solution predicts, lens taken off.

    To those that were detected it fits only as well as they were measured; to the observed plus the residual, as with
    a sign turned, worse still. Fitted by OpenCV from the board as machine.toml and site.toml describe it.
    """
    run_folder, _ = finished
    job = open_job(recorded / "short.mcap", runs=run_folder.parent).at(stage_named("report"), "f" * 64)
    misfits = []
    for view in report.gather(job).views:
        lens = job.machine.cameras[view.camera].intrinsics
        K = np.array([[lens.fx, 0, lens.cx], [0, lens.fy, lens.cy], [0, 0, 1]])
        for name, board in [*job.machine.markers.items(), *job.site.benchmarks.items()]:
            corners = {
                f"{board.family} {tag.id}": np.array(tag.corners(), float)[:, :2] for tag in board.tags
            }
            known = np.isfinite(view.tags["predicted"]).all(axis=(1, 2)) & (view.tags["marker"] == name)
            if known.sum() < 3:
                continue
            plane = np.concatenate([corners[tag] for tag in view.tags["tag"][known]])
            uv, predicted = view.tags["uv"][known], view.tags["predicted"][known]
            row = []
            for points in (predicted, uv, 2 * uv - predicted):
                flat = cv2.undistortPoints(points.reshape(-1, 1, 2), K, np.array(lens.distortion), P=K)
                H, _ = cv2.findHomography(plane, flat)
                row.append(np.sqrt(np.mean((cv2.perspectiveTransform(plane[:, None], H) - flat) ** 2)))
            misfits.append(row)
    right, measured, turned = np.sqrt(np.mean(np.array(misfits) ** 2, axis=0))
    assert len(misfits) >= 4
    # Not zero: a constant error of each corner is among the unknowns, and predicted with it.
    assert right < 0.7 * measured < 0.7 * turned
