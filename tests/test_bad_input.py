"""Every fault of the input gets one clear sentence and its exit code: no traceback, no silent empty report."""

import html
import re
import shutil

import pytest
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer

REFUSED = 3


@pytest.fixture
def report(gradetrace, tmp_path):
    """``report(log)`` runs the whole job into a folder of the test's own."""
    return lambda log, *options: gradetrace("report", log, "--runs", tmp_path / "runs", "--jobs", 1, *options)


def refusal(done, tmp_path):
    """The one sentence of a refused job."""
    assert done.code == REFUSED, done.out + done.err
    lines = done.err.splitlines()
    assert len(lines) == 1, done.err
    assert lines[0].startswith("gradetrace: ")
    assert 20 < len(lines[0]) < 600
    assert not list(tmp_path.rglob("report.html")), "a refused job leaves no report"
    return lines[0]


def edit(file, *changes):
    text = file.read_text()
    for old, new in changes:
        assert re.search(old, text), old
        text = re.sub(old, new, text)
    file.write_text(text)


def rewrite(log, change):
    """Write a log again, each message through `change(topic, number, data)` -> data, or None to leave it out."""
    counts = {}
    copy = log.with_suffix(".new")
    with log.open("rb") as source, copy.open("wb") as target:
        reader, writer = make_reader(source), Writer(target, compression=CompressionType.NONE)
        writer.start(profile="", library="test")
        schemas, channels = {}, {}
        for attachment in reader.iter_attachments():
            writer.add_attachment(
                attachment.create_time,
                attachment.log_time,
                attachment.name,
                attachment.media_type,
                attachment.data,
            )
        for schema, channel, message in reader.iter_messages():
            if schema.id not in schemas:
                schemas[schema.id] = writer.register_schema(schema.name, schema.encoding, schema.data)
            if channel.id not in channels:
                channels[channel.id] = writer.register_channel(
                    channel.topic, channel.message_encoding, schemas[schema.id]
                )
            number = counts[channel.topic] = counts.get(channel.topic, -1) + 1
            data = change(channel.topic, number, message.data)
            if data is not None:
                writer.add_message(channels[channel.id], message.log_time, data, message.publish_time, number)
        writer.finish()
    copy.replace(log)


def words_of(folder):
    """What the page of a run says, without its markup."""
    return html.unescape(re.sub(r"<[^>]+>", "", (folder / "runs" / "short" / "report.html").read_text()))


def test_no_such_file(report, tmp_path):
    assert refusal(report(tmp_path / "none.mcap"), tmp_path).endswith("none.mcap: no such file")


def test_folder_instead_of_a_file(report, tmp_path):
    assert "is not a file; name one MCAP log" in refusal(report(tmp_path), tmp_path)


def test_empty_file(report, job_folder, tmp_path):
    log = job_folder / "short.mcap"
    log.write_bytes(b"")
    assert "is empty" in refusal(report(log), tmp_path)


@pytest.mark.parametrize(
    "content", [b"#ROSBAG V2.0\n" + b"\0" * 1000, b"time,x,y\n1,2,3\n", b"\x89MCAP0\r\n"]
)
def test_file_that_is_no_mcap(report, job_folder, tmp_path, content):
    log = job_folder / "short.mcap"
    log.write_bytes(content)
    assert str(log) in refusal(report(log), tmp_path)


def test_neither_file_nor_attachment_describes_the_machine(report, job_folder, tmp_path):
    log = job_folder / "short.mcap"
    (job_folder / "machine.toml").unlink()
    from pipeline.logs.writer import LogWriter

    with LogWriter(log) as writer:
        writer.sample("/pot", 1_700_000_000_000_000_000, 1.0)
    said = refusal(report(log), tmp_path)
    assert "no machine.toml for" in said
    assert "name it with --machine" in said


def test_no_camera_topic(report, gradetrace, job_folder, tmp_path):
    edit(job_folder / "machine.toml", ('topic = "/cab/bench/image"', 'topic = "/cab/image"'))
    log = job_folder / "short.mcap"
    said = refusal(report(log), tmp_path)
    assert "camera 'bench' reads topic '/cab/image', which is not in the log" in said
    assert "/cab/arm/image, /cab/bench/image" in said, "it names those that are there"
    done = gradetrace("check", log)
    assert (done.code, "✗ error:   " in done.out) == (3, True)


def test_unknown_marker_ids_only(report, gradetrace, job_folder, tmp_path):
    for name in ("machine.toml", "site.toml"):
        edit(job_folder / name, (r"\bid = (\d+)", r"id = 4\1"))
    log = job_folder / "short.mcap"
    said = refusal(report(log), tmp_path)
    assert "only marker ids were seen that nothing describes: tag36h11 ids" in said
    done = gradetrace("check", log)
    assert done.code == 3
    assert "no described tag was found in the frames looked at" in done.out


def test_camera_without_intrinsics(report, gradetrace, job_folder, tmp_path):
    machine = job_folder / "machine.toml"
    edit(
        machine,
        (r"(?s)\[cameras\.bench\.intrinsics\].*?\n\n", "\n"),
        ('calibration_topic = "/cab/bench/calibration"\n', 'calibration_topic = "/nowhere"\n'),
    )
    log = job_folder / "short.mcap"
    said = refusal(report(log), tmp_path)
    assert "camera 'bench'" in said
    assert "[cameras.bench.intrinsics]" in said
    assert gradetrace("check", log).code == 3


def test_intrinsics_from_the_log_need_standard_deviations(report, job_folder, tmp_path):
    edit(job_folder / "machine.toml", (r"(?s)\[cameras\.bench\.intrinsics\].*?\n\n", "\n"))
    assert "add cameras.bench.intrinsics_sigma" in refusal(report(job_folder / "short.mcap"), tmp_path)


def test_unit_that_does_not_say_which_foot(report, gradetrace, job_folder, tmp_path):
    edit(job_folder / "site.toml", (r'unit = "m"', 'unit = "ft"'))
    said = refusal(report(job_folder / "short.mcap"), tmp_path)
    assert re.search(r"site\.toml:\d+: grid\.unit: 'ft' does not say which foot", said)
    assert gradetrace("check", job_folder / "short.mcap").code == 3


def test_unknown_key(report, job_folder, tmp_path):
    edit(job_folder / "site.toml", (r"\[tolerance\]\n", "[tolerance]\nhigh_cm = 3\n"))
    said = refusal(report(job_folder / "short.mcap"), tmp_path)
    assert re.search(r"site\.toml:\d+: tolerance\.high_cm: is not a key that is known here; found 3$", said)


@pytest.mark.parametrize(
    "name, said",
    [
        ("../design.csv", "must be a file beside site.toml"),
        ("/etc/passwd", "must be a file beside site.toml"),
        ("sub/../../design.csv", "must be a file beside site.toml"),
        ("link.csv", "is a link that leads out of"),
        ("linked/design.csv", "is a link that leads out of"),
        ("none.csv", "no such file in"),
        ("truth", "is not a file"),
    ],
)
def test_design_file_outside_the_folder(report, gradetrace, job_folder, tmp_path, name, said):
    outside = tmp_path / "outside"
    outside.mkdir()
    shutil.copy(job_folder / "design.csv", outside)
    (job_folder / "sub").mkdir()
    (job_folder / "truth").mkdir()
    (job_folder / "link.csv").symlink_to(outside / "design.csv")
    (job_folder / "linked").symlink_to(outside)
    edit(job_folder / "site.toml", (r'file = "design.csv"', f'file = "{name}"'))
    sentence = refusal(report(job_folder / "short.mcap"), tmp_path)
    assert f"site.toml: design.file = '{name}': {said}" in sentence
    assert gradetrace("check", job_folder / "short.mcap").code == 3


def test_design_that_is_no_design_is_refused_before_detection(gradetrace, job_folder):
    (job_folder / "design.csv").write_text("a,b\n1,2\n")
    done = gradetrace("check", job_folder / "short.mcap")
    assert done.code == 3
    assert re.search(r"✗ error: +.*design\.csv", done.out)


@pytest.fixture(scope="module")
def spoiled(recorded, gradetrace, tmp_path_factory):
    """One run of a log with many small faults, each of which a report can be made in spite of."""
    folder = tmp_path_factory.mktemp("spoiled") / "job"
    shutil.copytree(recorded, folder, ignore=shutil.ignore_patterns("truth"))

    def change(topic, number, data):
        if topic == "/bucket/potentiometer" and number > 250:
            return None
        if not topic.endswith("/image"):
            return data
        image = CompressedImage.FromString(data)
        if topic == "/cab/arm/image" and number in (10, 11):
            image.data = image.data[: len(image.data) // 2]
        if topic == "/cab/bench/image" and number == 20:
            image.timestamp.FromNanoseconds(image.timestamp.ToNanoseconds() - 900_000_000)
        return image.SerializeToString()

    rewrite(folder / "short.mcap", change)
    text = (folder / "site.toml").read_text()
    unseen = re.search(r"(?s)\[benchmarks\.bm-near\].*?\n\n", text)[0].replace("bm-near", "bm-far")
    unseen = re.sub(r"\bid = (\d+)", r"id = 5\1", unseen)
    (folder / "site.toml").write_text(text.replace("[alignment]", unseen + "[alignment]"))
    done = gradetrace("report", folder / "short.mcap", "--runs", folder / "runs", "--jobs", 1)
    return folder, done


def test_small_faults_do_not_stop_the_report(spoiled):
    folder, done = spoiled
    assert (done.code, done.err) == (0, "")
    assert (folder / "runs" / "short" / "report.html").exists()


@pytest.mark.parametrize(
    "said",
    [
        r"the time stamps of camera 'bench' run backwards 1 times?; they were sorted",
        r"camera 'arm': 2 of \d+ frames are corrupt and were skipped",
        r"sensor 'bucket-pot' stops [\d.]+ s before the end of the log",
        r"benchmark 'bm-far' was never seen",
    ],
    ids=["backwards", "corrupt", "sensor stops", "unseen benchmark"],
)
def test_each_small_fault_is_told_on_the_way_and_on_the_page(spoiled, said):
    folder, done = spoiled
    assert re.search(f"warning: .*{said}", done.out), done.out
    assert re.search(said, words_of(folder), re.IGNORECASE), "not on the page"


def test_check_tells_small_faults_as_warnings(spoiled, gradetrace):
    folder, _ = spoiled
    done = gradetrace("check", folder / "short.mcap")
    assert done.code == 0, done.out
    assert re.search(r"! warning: sensor 'bucket-pot' stops after \d+ % of the log", done.out)
    assert "! warning: benchmark 'bm-far' is not in the frames looked at" in done.out


@pytest.fixture(scope="module")
def truncated(recorded, gradetrace, tmp_path_factory):
    """One run of a log of which the last fifth is missing."""
    folder = tmp_path_factory.mktemp("truncated") / "job"
    shutil.copytree(recorded, folder, ignore=shutil.ignore_patterns("truth"))
    log = folder / "short.mcap"
    data = log.read_bytes()
    log.write_bytes(data[: len(data) * 4 // 5])
    done = gradetrace("report", log, "--runs", folder / "runs", "--jobs", 1)
    return folder, done


def test_truncated_log_gives_a_report_of_what_is_there_and_tells_the_loss(truncated):
    folder, done = truncated
    assert (done.code, done.err) == (0, "")
    said = r"the log is not whole: it breaks off after [\d,]+ of [\d,]+ bytes: about [\d.]+ s at its end are lost"
    assert re.search(f"warning: {said}", done.out), done.out
    assert re.search(said, words_of(folder), re.IGNORECASE)


def test_truncated_log_ends_with_5_only_when_asked(truncated, gradetrace):
    folder, done = truncated
    strict = gradetrace("report", folder / "short.mcap", "--runs", folder / "runs", "--strict")
    verdict = re.search(r"verdict (.*)$", done.last)[1]
    assert strict.code == (4 if verdict == "FAIL" else 5)
    assert strict.out.count("up to date") == 6, "--strict changes the exit code, not the result"


def test_check_of_a_truncated_log_warns(truncated, gradetrace):
    done = gradetrace("check", truncated[0] / "short.mcap")
    assert "! warning: the log is not whole" in done.out


def test_run_folder_that_cannot_be_written(gradetrace, recorded, tmp_path):
    (tmp_path / "runs").write_text("a file is in the way")
    done = gradetrace("report", recorded / "short.mcap", "--runs", tmp_path / "runs" / "deeper")
    assert done.code == REFUSED
    assert re.fullmatch(
        r"gradetrace: .* cannot be written \(.*\); make its folder writable, or name another one\n", done.err
    )
