"""ingest and detect on a small log: what stands in the tables, what is said of a bad log."""

import json
from contextlib import contextmanager

import numpy as np
import pytest

from benchmarks._tag_picture import View
from pipeline import tables
from pipeline.errors import ConfigError, DetectionError, LogError
from pipeline.logs.writer import LogWriter
from pipeline.stages import detect, ingest, stage_named

from .conftest import HEIGHT, MACHINE, SITE, START, STEP, WIDTH, Watch, canvas, open_job, write_log


def ingested(job):
    watch = Watch()
    counts = ingest.run(job.at(stage_named("ingest"), "f" * 64), watch)
    return counts, watch


def detected(job):
    watch = Watch()
    here = job.at(stage_named("detect"), "f" * 64)
    counts = detect.run(here, watch)
    return counts, watch, here


def both(folder, log, **options):
    job = open_job(folder, log, **options)
    ingested(job)
    return detected(job)


@contextmanager
def described_otherwise(shift, folder, **files):
    """A job of the log, ingested, with other files beside it as long as it lasts."""
    job = open_job(shift.parent, shift, runs=str(folder), **files)
    try:
        ingested(job)
        yield job
    finally:
        open_job(shift.parent, shift, runs=str(folder))


def test_a_sound_log_gives_its_tables_and_no_warning(shift, tmp_path):
    job = open_job(shift.parent, shift, runs=str(tmp_path))
    counts, watch = ingested(job)
    assert watch.warnings == []
    assert watch.done == watch.expected == 160
    assert counts["frames"] == {"front": 80, "side": 80}
    assert counts["readings"] == {"pot": 80}
    frames = tables.read_table(job.folder.file("frames.parquet"), "frames")
    front = frames["camera"] == "front"
    assert frames["frame"][front].tolist() == list(range(80))
    assert np.array_equal(frames["time_ns"][front], START + 8 * STEP * np.arange(80))
    log = json.loads(job.folder.file("log.json").read_text())
    assert log["recovery"]["complete"]
    assert (log["start_ns"], log["end_ns"]) == (START, START + 8 * STEP * 79 + 1)
    assert log["calibrations"] == {
        "front": {
            "topic": "/front/camera_info", "width": WIDTH, "height": HEIGHT,
            "fx": 400.0, "fy": 400.0, "cx": 100.0, "cy": 80.0, "distortion": [0.0] * 5,
        }
    }  # fmt: skip

    counts, watch, here = detected(job)
    assert watch.warnings == []
    assert watch.done == 160
    assert here.written == ["detections/front.parquet", "detections/side.parquet", "detection.json"]
    assert counts == {
        "frames": {"searched": 160},
        "tags accepted": {"front": 160, "side": 160},
        "tags rejected": {"unknown id": counts["tags rejected"]["unknown id"]},
        "tags at rest": {"front": 0, "side": 0},  # the tags jump by parts of a pixel
    }
    facts = json.loads(job.folder.file("detection.json").read_text())["cameras"]["side"]
    assert facts["frames"] == {"searched": 80}
    assert facts["tags"]["accepted"] == 160
    assert facts["pixel_noise"] == {"sizes": [], "tags": []}
    found = tables.read_table(job.folder.file("detections/front.parquet"), "detections")
    assert np.all(np.diff(found["frame"]) >= 0)
    assert np.bincount(found["frame"][found["status"] == "accepted"]).tolist() == [2] * 80
    # What nothing describes is told of where a search comes upon it, and not followed.
    unknown = found["status"] == "unknown id"
    assert 9 <= unknown.sum() < 80
    assert set(found["how"][unknown]) == {"searched"}


def test_what_the_still_stretches_say_is_told(shift, tmp_path, monkeypatch):
    """The sentences themselves are tested with the corners that lead to them."""
    monkeypatch.setattr(detect, "warnings", lambda camera, stillness: [f"{camera} is noisy"])
    job = open_job(shift.parent, shift, runs=str(tmp_path))
    ingested(job)
    _, watch, _ = detected(job)
    assert watch.warnings == ["front is noisy", "side is noisy"]


def spoiled(shift, folder, spoil, **options):
    """A log like `shift` with something wrong, in a folder of its own."""
    return write_log(folder / "shift.mcap", n=12, spoil=spoil, **options)


def test_a_corrupt_picture_is_skipped_counted_and_told(shift, tmp_path):
    log = spoiled(shift, tmp_path, lambda camera, k, jpeg, t: (jpeg[: len(jpeg) // 2] if k == 4 else jpeg, t))
    counts, watch, _ = both(tmp_path, log)
    assert counts["frames"] == {"searched": 22, "corrupt picture": 2}
    assert watch.warnings == [
        "camera 'front': 1 of 12 frames are corrupt and were skipped",
        "camera 'side': 1 of 12 frames are corrupt and were skipped",
    ]


def test_a_camera_whose_pictures_are_all_corrupt_ends_the_job(shift, tmp_path):
    def spoil(camera, k, jpeg, t):
        return (jpeg[: len(jpeg) // 2] if camera == "side" else jpeg), t

    log = spoiled(shift, tmp_path, spoil)
    with pytest.raises(DetectionError, match=r"'side': 12 of 12 frames"):
        both(tmp_path, log)


def test_pictures_without_a_head_end_the_job_too(shift, tmp_path):
    log = spoiled(shift, tmp_path, lambda camera, k, jpeg, t: (b"\xff\xd8" + bytes(500), t))
    with pytest.raises(DetectionError, match=r"every one of the 12 pictures of camera 'front' is corrupt"):
        ingested(open_job(tmp_path, log))


def test_unknown_ids_only_names_what_was_seen_and_what_is_described(shift, tmp_path):
    log = spoiled(shift, tmp_path, None, known=False)
    with pytest.raises(
        DetectionError, match=r"tag36h11 id 9; described are tag25h9 id 2; tag36h11 id 1; correct the ids"
    ):
        both(tmp_path, log)


def test_a_tag_that_both_files_describe_is_told_before_anything_is_searched(shift, tmp_path):
    site = SITE.replace('family = "tag25h9"', 'family = "tag36h11"').replace("id = 2", "id = 1")
    twice = pytest.raises(
        ConfigError, match=r"tag 1 of tag36h11 stands on both '\w+' and '\w+'.*correct the id"
    )
    with described_otherwise(shift, tmp_path, site=site) as job, twice:
        detected(job)


def test_a_wrong_id_is_told_beside_what_was_seen(shift, tmp_path):
    with described_otherwise(shift, tmp_path, site=SITE.replace("id = 2", "id = 3")) as job:
        _, watch, _ = detected(job)
    assert any(
        "never used: tag25h9 id 3 (3 of '" in sentence
        and "described by neither file: tag25h9 id 2" in sentence
        for sentence in watch.warnings
    ), watch.warnings


def test_a_wrong_family_is_found_out(shift, tmp_path):
    """Nothing described is in view; the tags that are belong to families nobody named."""
    machine = MACHINE.replace('family = "tag36h11"', 'family = "tagStandard41h12"')
    site = SITE.replace('family = "tag25h9"', 'family = "tagStandard41h12"')
    told = r"tag25h9 id 2; tag36h11 ids 1, 9; described are tagStandard41h12 ids 1, 2"
    other = described_otherwise(shift, tmp_path, machine=machine, site=site)
    with other as job, pytest.raises(DetectionError, match=told):
        detected(job)


def test_a_wrong_aruco_dictionary_is_found_out_and_the_smallest_that_fits_is_named(tmp_path):
    """DICT_6X6_100 stands in the picture, DICT_6X6_50 in the files; texture in between makes no names."""
    rng = np.random.default_rng(9)
    views = [(View("DICT_6X6_1000", 77, 40, 10, 0, 5), 120, 60), (View("DICT_6X6_1000", 93, 40), 5, 5)]
    jpeg = canvas(views, rng)
    log = spoiled(None, tmp_path, lambda camera, k, _, t: (jpeg, t))
    machine = MACHINE.replace('family = "tag36h11"', 'family = "DICT_6X6_50"')
    site = SITE.replace('family = "tag25h9"', 'family = "DICT_6X6_50"')
    with pytest.raises(
        DetectionError, match=r"seen that nothing describes: DICT_6X6_100 ids 77, 93; described"
    ):
        both(tmp_path, log, machine=machine, site=site)


def test_an_aruco_marker_goes_through_both_stages(tmp_path):
    rng = np.random.default_rng(10)
    views = [(View("DICT_5X5_100", 1, 40, 10, 0, 5), 120, 60), (View("DICT_5X5_100", 2, 40), 5, 5)]
    jpeg = canvas(views, rng)
    log = spoiled(None, tmp_path, lambda camera, k, _, t: (jpeg, t))
    machine = MACHINE.replace('family = "tag36h11"', 'family = "DICT_5X5_100"')
    site = SITE.replace('family = "tag25h9"', 'family = "DICT_5X5_100"')
    counts, watch, _ = both(tmp_path, log, machine=machine, site=site)
    assert watch.warnings == []
    assert counts["tags accepted"] == {"front": 24, "side": 24}


def test_two_sizes_of_one_dictionary_are_refused(tmp_path):
    log = spoiled(None, tmp_path, None)
    machine = MACHINE.replace('family = "tag36h11"', 'family = "DICT_5X5_100"')
    site = SITE.replace('family = "tag25h9"', 'family = "DICT_5X5_50"')
    with pytest.raises(
        ConfigError,
        match=r"markers.plate has tags of DICT_5X5_100 and benchmarks.bm of DICT_5X5_50.*write DICT_5X5_100 for both",
    ):
        open_job(tmp_path, log, machine=machine, site=site)


def test_stamps_that_run_backwards_are_sorted_counted_and_told(shift, tmp_path):
    def spoil(camera, k, jpeg, t):
        return jpeg, t - 3 * 8 * STEP - 1000 if camera == "front" and k == 6 else t

    log = spoiled(shift, tmp_path, spoil)
    job = open_job(tmp_path, log)
    counts, watch = ingested(job)
    assert counts["sorted messages"] == 1
    assert watch.warnings == ["the time stamps of camera 'front' run backwards 1 times; they were sorted"]
    frames = tables.read_table(job.folder.file("frames.parquet"), "frames")
    assert np.all(np.diff(frames["time_ns"][frames["camera"] == "front"]) > 0)
    found = detected(job)[2].folder.file("detections/front.parquet")
    columns = tables.read_table(found, "detections")
    times = frames["time_ns"][frames["camera"] == "front"]
    assert np.array_equal(columns["time_ns"], times[columns["frame"]])


def test_a_stamp_that_comes_twice_is_used_once(shift, tmp_path):
    log = spoiled(shift, tmp_path, lambda camera, k, jpeg, t: (jpeg, t - 8 * STEP if k == 6 else t))
    job = open_job(tmp_path, log)
    counts, watch = ingested(job)
    assert counts["frames"] == {"front": 11, "side": 11}
    assert counts["rejected messages"] == {"stamp used twice": 2}
    assert "repeat the stamp of another" in watch.warnings[0]
    assert detected(job)[0]["frames"] == {"searched": 22}


def test_stamps_of_zero_are_refused(shift, tmp_path):
    log = spoiled(shift, tmp_path, lambda camera, k, jpeg, t: (jpeg, 0 if camera == "side" else t))
    with pytest.raises(LogError, match=r"12 of 12 messages of 'side' carry no capture time"):
        ingested(open_job(tmp_path, log))


def test_a_sensor_that_stops_is_told(tmp_path):
    log = tmp_path / "shift.mcap"
    write_log(log, n=12)
    with LogWriter(log) as writer:
        source = write_log(tmp_path / "source.mcap", n=12)
        _copy_frames(source, writer)
        for k in range(30):
            writer.sample("/pot", START + k * STEP, 1.0)
    _, watch = ingested(open_job(tmp_path, log))
    assert [w for w in watch.warnings if "pot" in w] == [
        "sensor 'pot' stops 5.9 s before the end of the log, at 2023-11-14 22:13:22 UTC"
    ]


def test_a_sensor_that_is_not_there_is_told_and_the_job_goes_on(tmp_path):
    log = tmp_path / "shift.mcap"
    with LogWriter(log) as writer:
        _copy_frames(write_log(tmp_path / "source.mcap", n=12), writer)
    counts, watch = ingested(open_job(tmp_path, log))
    assert counts["readings"] == {"pot": 0}
    assert "topic '/pot' is not in the log" in watch.warnings[0]


def _copy_frames(source, writer):
    from pipeline.logs.reader import read_log

    with read_log(source) as reader:
        calibration = reader.calibrations()["/front/camera_info"]
        size = calibration.width, calibration.height
        writer.camera_calibration("/front/camera_info", START, "front", *size, calibration.intrinsics)
        for frame in reader.frames({"front": "/front/image", "side": "/side/image"}):
            writer.image(f"/{frame.camera}/image", frame.time_ns, frame.camera, frame.data)


def test_a_picture_of_another_size_than_the_intrinsics_is_refused(shift, tmp_path):
    with pytest.raises(
        LogError, match=r"'side' recorded 200 x 160 pixels, but its intrinsics are for 400 x 160"
    ):
        ingested(
            open_job(
                shift.parent, shift, runs=str(tmp_path), machine=MACHINE.replace("width = 200", "width = 400")
            )
        )


def test_a_camera_without_intrinsics_anywhere_is_named(tmp_path):
    log = tmp_path / "shift.mcap"
    with LogWriter(log) as writer:
        writer.image("/front/image", START, "front", b"\xff\xd8")
        writer.image("/side/image", START, "side", b"\xff\xd8")
    with pytest.raises(ConfigError, match=r"camera 'front' has no intrinsics"):
        ingested(open_job(tmp_path, log))


def test_a_calibration_topic_that_carries_pictures_is_refused(shift, tmp_path):
    text = MACHINE.replace(
        'topic = "/front/image"', 'topic = "/front/image"\ncalibration_topic = "/side/image"'
    )
    with pytest.raises(
        LogError,
        match=r"'/side/image' carries foxglove.CompressedImage.*calibrations are on: /front/camera_info",
    ):
        ingested(open_job(shift.parent, shift, runs=str(tmp_path), machine=text))


def test_a_cut_log_is_searched_as_far_as_it_goes_and_says_so(shift, tmp_path):
    data = shift.read_bytes()
    log = tmp_path / "cut.mcap"
    log.write_bytes(data[: len(data) * 6 // 10])
    job = open_job(tmp_path, log)
    counts, watch = ingested(job)
    assert 30 < counts["frames"]["front"] < 60
    assert any("breaks off" in warning and " s at its end are lost" in warning for warning in watch.warnings)
    recovery = json.loads(job.folder.file("log.json").read_text())["recovery"]
    assert 0 < recovery["lost_seconds"] < 15
    assert detected(job)[0]["frames"] == {"searched": sum(counts["frames"].values())}
