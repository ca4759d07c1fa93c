"""The log: the same bytes again, and every message where and when the truth says."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pipeline.detection.decode import decode_grey
from pipeline.errors import UsageError
from pipeline.logs.reader import read_log
from pipeline.synthetic import command, files, recording, specification, table

SAMPLE = Path(__file__).parents[2] / "sample_logs" / "trench"


def small(**changes):
    """A site with thumbnails for frames."""
    spec = replace(specification.trench(), cycles=1, rate_hz=1.5, **changes)
    return spec.scaled(160, 120, 212.0)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    path = tmp_path_factory.mktemp("one")
    recording.record(small(), 3, path, jobs=1)
    return path


def test_the_same_seed_gives_the_same_bytes_for_any_number_of_jobs(folder, tmp_path):
    recording.record(small(), 3, tmp_path, jobs=2)
    names = sorted(p.relative_to(folder) for p in folder.rglob("*") if p.is_file())
    assert names == sorted(p.relative_to(tmp_path) for p in tmp_path.rglob("*") if p.is_file())
    assert len(names) == 10
    for name in names:
        assert (folder / name).read_bytes() == (tmp_path / name).read_bytes(), name


def test_another_seed_is_another_machine_on_another_day():
    a, b = (recording.world(small(), seed) for seed in (3, 4))
    assert not np.allclose(a.truth.cameras["arm"], b.truth.cameras["arm"])
    assert not np.allclose(a.files.tool, b.files.tool)


def test_the_log_carries_frames_readings_calibrations_and_both_files(folder):
    with read_log(folder / "trench.mcap") as log:
        topics = {channel.topic: channel for channel in log.channels}
        assert topics["/cab/bench/image"].schema_name == "foxglove.CompressedImage"
        assert topics["/cab/arm/calibration"].message_count == 1
        attachments = log.attachments()
        assert attachments["machine.toml"] == (folder / "machine.toml").read_bytes()
        beside = (folder / "site.toml").read_bytes()
        # What lies beside the log knows of the ground and the buried lines as well: they were entered after the shift.
        assert beside == attachments["site.toml"] + files.afterwards_toml(small()).encode()
        assert b"[utilities.gas-main]" in beside and b"utilities" not in attachments["site.toml"]
        frames = list(log.frames({"bench": "/cab/bench/image", "arm": "/cab/arm/image"}))
        samples = list(log.samples({"pot": ("/bucket/potentiometer", "value")}))
    stamps = {name: np.array([f.time_ns for f in frames if f.camera == name]) for name in ("bench", "arm")}
    assert all(np.all(np.diff(v) > 0) for v in stamps.values())
    # The cameras run freely: no two frames at the same instant.
    assert np.abs(stamps["bench"][:, None] - stamps["arm"]).min() > 50_000_000
    assert all(f.log_time_ns > f.time_ns for f in frames)
    assert np.median(np.diff([s.time_ns for s in samples])) == pytest.approx(5e7, rel=0.05)


def test_readings_are_late_noisy_and_quantised_as_the_plan_says():
    w = recording.world(specification.trench(), seed=3)
    plan = w.spec.sensors[0]
    stamps, raw = recording.readings(w, plan)
    np.testing.assert_allclose(raw / plan.step, np.round(raw / plan.step), atol=1e-6)
    from pipeline.synthetic.excavator import raw_reading

    def expected(offset_s):
        angle = w.motion.poses(stamps / 1e9 + offset_s).joint_rad()
        return raw_reading(plan.kind, angle, w.truth, w.spec.arm.linkage_side, plan.name)

    residual = raw - expected(w.truth.time_offsets[plan.name])
    assert residual.std() == pytest.approx(np.hypot(plan.noise, plan.step / np.sqrt(12)), rel=0.08)
    assert (raw - expected(0.0)).std() > 1.5 * residual.std()


def test_the_truth_table_holds_the_edge_at_every_frame(folder):
    edge = table.read(folder / "truth" / "cutting_edge.parquet")
    known = set(edge["time_ns"].tolist())
    with read_log(folder / "trench.mcap") as log:
        for frame in log.frames({"bench": "/cab/bench/image", "arm": "/cab/arm/image"}):
            assert frame.time_ns in known
    left, right = (
        np.stack([edge[k][edge["point"] == side] for k in "enh"], -1) for side in ("left", "right")
    )
    np.testing.assert_allclose(np.linalg.norm(left - right, axis=1), 1.0, atol=3e-5)


def test_a_longer_log_has_benchmarks_along_the_way():
    spec = command.specification_of("trench", minutes=3.0, size="1280")
    w = recording.world(spec, seed=1)
    assert w.motion.duration_s >= 180
    ids = [b.board.first_id + k for b in spec.benchmarks for k in range(b.board.rows * b.board.columns)]
    assert len(ids) == len(set(ids)) and max(ids) < 587  # tags of the family
    hour = command.specification_of("trench", minutes=60.0, size="1280")
    assert max(b.board.first_id for b in hour.benchmarks) + 3 < 587
    assert hour.trench.rows[-1][0] > hour.first_station + hour.cycles * hour.step_m + hour.axis_reach


def test_what_cannot_be_made_is_refused():
    with pytest.raises(UsageError, match="no site 'moon'"):
        command.specification_of("moon")
    with pytest.raises(UsageError, match="size '4k'"):
        command.specification_of("trench", size="4k")
    with pytest.raises(UsageError, match="minutes"):
        command.specification_of("trench", minutes=0.0)


def test_the_committed_sample_keeps_to_its_size():
    assert (SAMPLE / "trench.mcap").stat().st_size < 15.5e6
    assert sum(p.stat().st_size for p in SAMPLE.rglob("*") if p.is_file()) < 16e6


@pytest.mark.slow
def test_the_committed_sample_can_be_made_again(tmp_path):
    """Every file to the byte but the log, whose pictures another processor may round otherwise: within grey values."""
    command.make(tmp_path, jobs=2)
    for path in SAMPLE.rglob("*"):
        if path.is_file() and path.suffix != ".mcap":
            assert (tmp_path / path.relative_to(SAMPLE)).read_bytes() == path.read_bytes(), path.name
    (log,) = SAMPLE.glob("*.mcap")
    found, kept = (contents_of(folder / log.name) for folder in (tmp_path, SAMPLE))
    assert found[1:] == kept[1:]
    assert [frame[:2] for frame in found[0]] == [frame[:2] for frame in kept[0]]
    furthest = typical = 0.0
    for (*_, a), (*_, b) in zip(found[0], kept[0], strict=True):
        away = np.abs(a.astype(int) - b)
        furthest, typical = max(furthest, away.max()), max(typical, away.mean())
    # One grey value that is rounded otherwise is up to a step of the JPEG's quantisation in its block.
    print(f"pictures differ by {furthest} grey values at most, {typical:.4f} in the mean of one")
    assert furthest <= 8 and typical < 0.01


def contents_of(log):
    """Camera, time and grey values of every frame; readings; attachments."""
    with read_log(log) as reader:
        frames = [
            (f.camera, f.time_ns, decode_grey(f.data, f.encoding))
            for f in reader.frames({"bench": "/cab/bench/image", "arm": "/cab/arm/image"})
        ]
        samples = list(reader.samples({"pot": ("/bucket/potentiometer", "value")}))
        return frames, samples, reader.attachments()
