"""What a person types and reads: lines, exit codes, and what is done again after which change."""

import io
import json
import re
import shutil
import subprocess
import sys
import time

import pytest
from rich.console import Console

from pipeline import progress
from pipeline.runs import Manifest
from pipeline.stages import STAGES, stage_named

ORDER = ["ingest", "detect", "estimate", "track", "survey", "report"]


def ran(done):
    """Stages that did work, in order, from the lines of a run."""
    return [line.split(":")[0] for line in done.out.splitlines() if re.match(r"\w+: .* \d+\.\d s$", line)]


@pytest.fixture
def copied(finished, job_folder):
    """A log with the files beside it and a finished run of it, to be changed."""
    runs = job_folder / "runs"
    shutil.copytree(finished[0], runs / "short")
    return job_folder / "short.mcap", runs


def change(file, old, new):
    text = file.read_text()
    assert old in text, old
    file.write_text(text.replace(old, new, 1))


def test_first_run_does_every_stage_and_ends_with_report_and_verdict(finished):
    folder, done = finished
    assert (done.code, done.err) == (0, ""), done.err
    assert ran(done) == ORDER
    assert re.match(r"machine\.toml: beside the log, sha256 [0-9a-f]{12}$", done.out.splitlines()[0])
    assert re.search(r"/short/report\.html · verdict (PASS|FAIL|CANNOT TELL)$", done.last)
    assert (folder / "report.html").stat().st_size > 10_000
    assert "\x1b" not in done.out, "no control codes where nobody looks at a terminal"
    assert not [path.name for path in folder.iterdir() if path.suffix == ".partial"]


def test_lines_of_stages_have_counts(finished):
    _, done = finished
    lines = [line for line in done.out.splitlines() if line.startswith("detect: ") and line.endswith(" s")]
    assert re.search(r"\d+ frames .*[\d,]+ tags accepted .*, \d+\.\d s$", lines[0])


def test_manifest_says_what_the_result_depends_on(finished):
    folder, _ = finished
    for stage in STAGES:
        manifest = json.loads((folder / f"{stage.name}.manifest.json").read_text())
        assert manifest["stage"] == stage.name
        assert manifest["outputs"], stage.name
        assert all(re.fullmatch("[0-9a-f]{64}", digest) for digest in manifest["outputs"].values())
        assert set(manifest) == set(Manifest.__dataclass_fields__)
        assert ("log" in manifest["inputs"]) == ("log" in stage.reads)


def test_second_run_does_no_work_and_is_quick(copied, gradetrace):
    log, runs = copied
    started = time.monotonic()
    done = gradetrace("report", log, "--runs", runs)
    seconds = time.monotonic() - started
    assert (done.code, ran(done)) == (0, [])
    assert [line.split(":")[0] for line in done.out.splitlines() if "up to date" in line] == ORDER
    assert seconds < 5


def states(done):
    """Stage -> fresh or stale, from the lines of `status`."""
    lines = [line.split() for line in done.out.splitlines() if line.split()[0] in ORDER]
    return {words[0]: words[2] for words in lines}


@pytest.mark.parametrize(
    "file, old, new, first",
    [
        ("site.toml", 'title = "', 'title = "Another ', "report"),
        ("site.toml", "high_mm = ", "high_mm = 1", "survey"),
        ("checks.csv", "CP", "Cp", "survey"),
        ("site.toml", "[tolerance]\n", "[estimation]\nhuber = 3.5\n\n[tolerance]\n", "estimate"),
        ("machine.toml", "xyz_m = [0.", "xyz_m = [0.1", "estimate"),
        ("machine.toml", "width_m = 1", "width_m = 2", "estimate"),
        ("site.toml", "[tolerance]\n", "[detection]\nmin_margin = 21\n\n[tolerance]\n", "detect"),
        ("machine.toml", '/bucket/potentiometer"', '/bucket/potentiometer"\nfield = "volts"', "ingest"),
    ],
    ids=["report title", "tolerance", "check shot", "huber", "mount", "width", "margin", "field"],
)
def test_a_change_makes_stale_only_what_depends_on_it(copied, gradetrace, file, old, new, first):
    log, runs = copied
    change(log.parent / file, old, new)
    found = states(gradetrace("status", log, "--runs", runs))
    fresh, stale = ORDER[: ORDER.index(first)], [first]
    assert [found[name] for name in fresh] == ["fresh"] * len(fresh)
    assert [found[name] for name in stale] == ["stale"]
    assert found["report"] == "stale"


def test_a_report_setting_makes_a_new_page_and_nothing_else(copied, gradetrace):
    log, runs = copied
    change(log.parent / "site.toml", 'title = "', 'title = "Another ')
    done = gradetrace("report", log, "--runs", runs)
    assert (done.code, ran(done)) == (0, ["report"])
    assert "report: writing the report (site.report.title changed)" in done.out
    assert "Another " in (runs / "short" / "report.html").read_text()


def test_a_moved_mount_is_named_as_the_reason(copied, gradetrace):
    log, runs = copied
    change(log.parent / "machine.toml", "xyz_m = [0.", "xyz_m = [0.1")
    done = gradetrace("status", log, "--runs", runs)
    lines = {line.split()[0]: line for line in done.out.splitlines()}
    assert re.search(r"! stale +\S+ +machine\.cameras\.\w+\.mount\.xyz_m changed", lines["estimate"])
    assert "estimate is stale" in lines["track"]


def test_damaged_artefact_is_made_again_and_the_rest_stands(copied, gradetrace):
    log, runs = copied
    table = runs / "short" / "cutting_edge.parquet"
    whole = table.read_bytes()
    table.write_bytes(whole[:-1000])
    done = gradetrace("report", log, "--runs", runs)
    assert (done.code, ran(done)) == (0, ["track"])
    assert table.read_bytes() == whole


def test_status_of_a_log_that_was_never_run_makes_no_folder(job_folder, gradetrace):
    done = gradetrace("status", job_folder / "short.mcap", "--runs", job_folder / "runs")
    assert done.code == 0
    assert done.out.count("· missing") == 6
    assert not (job_folder / "runs").exists()


def test_status_shows_counts_and_seconds(copied, gradetrace):
    log, runs = copied
    done = gradetrace("status", log, "--runs", runs)
    assert done.out.count("✓ fresh") == 6
    assert re.search(r"detect +✓ fresh +\d+\.\d +\d+ frames", done.out)


def test_check_of_a_good_log_is_quick_and_finds_no_error(recorded, gradetrace):
    started = time.monotonic()
    done = gradetrace("check", recorded / "short.mcap")
    assert done.code == 0, done.out
    assert "✗" not in done.out
    assert done.last.endswith("is fit for a report: no error, no warnings")
    assert "tied to the survey" in done.out
    assert time.monotonic() - started < 15


def test_check_names_the_places_that_no_file_gives(job_folder, gradetrace):
    """A pose that was forgotten is no error; whoever forgot it should read so."""
    site = job_folder / "site.toml"
    name, pose = re.search(r"\[benchmarks\.([\w-]+)\][^[]*?(pose = .*\n)", site.read_text()).groups()
    change(site, pose, "")
    done = gradetrace("check", job_folder / "short.mcap")
    assert done.code == 0, done.out
    assert f"places that no file gives, for the log to tell: benchmark {name} pose" in done.out


def test_attachments_of_the_log_describe_it_when_nothing_lies_beside_it(recorded, tmp_path, gradetrace):
    for name in ("short.mcap", "design.csv", "checks.csv"):
        shutil.copy(recorded / name, tmp_path)
    done = gradetrace("status", tmp_path / "short.mcap", "--runs", tmp_path / "runs")
    assert done.code == 0, done.err
    assert "machine.toml: attachment of the log, sha256" in done.out
    assert "site.toml: attachment of the log, sha256" in done.out


def test_option_wins_over_the_file_beside_the_log(job_folder, gradetrace):
    other = job_folder / "mine.toml"
    shutil.copy(job_folder / "machine.toml", other)
    log = job_folder / "short.mcap"
    done = gradetrace("status", log, "--machine", other, "--runs", job_folder / "runs")
    assert "mine.toml: as given" in done.out
    assert "site.toml: beside the log" in done.out


@pytest.mark.parametrize(
    "arguments",
    [["report"], ["report", "x.mcap", "--wrong"], ["nothing"], ["report", "x.mcap", "--jobs", "0"]],
)
def test_wrong_usage_ends_with_2(gradetrace, arguments):
    done = gradetrace(*arguments)
    assert done.code == 2
    assert "Traceback" not in done.err


@pytest.mark.parametrize("command", ["report", "status", "check"])
def test_option_that_names_no_file_ends_with_2(recorded, gradetrace, tmp_path, command):
    done = gradetrace(command, recorded / "short.mcap", "--site", tmp_path / "none.toml")
    assert done.code == 2
    assert re.fullmatch(r"gradetrace: --site .*none\.toml: no such file\n", done.err)


def test_interrupt_is_one_line_and_130():
    script = """
import sys
from unittest import mock
from pipeline import cli
with mock.patch("pipeline.stages.job.open_job", side_effect=KeyboardInterrupt):
    sys.argv = ["gradetrace", "report", "x.mcap"]
    cli.main()
"""
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True)
    assert done.returncode == 130
    assert done.stderr == "gradetrace: interrupted; the same command goes on where this one stopped\n"


def test_defect_of_ours_keeps_its_traceback():
    script = """
import sys
from unittest import mock
from pipeline import cli
with mock.patch("pipeline.stages.job.open_job", side_effect=ZeroDivisionError):
    sys.argv = ["gradetrace", "report", "x.mcap"]
    cli.main()
"""
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True)
    assert done.returncode == 1
    assert "Traceback" in done.stderr


def test_refusal_says_that_the_page_in_the_folder_is_of_an_earlier_run(copied, gradetrace):
    log, runs = copied
    (log.parent / "checks.csv").write_text("no,shots,here\n")
    done = gradetrace("report", log, "--runs", runs)
    assert done.code == 3
    first, second = done.err.splitlines()
    assert "checks.csv" in first
    assert second == f"gradetrace: {runs}/short/report.html is of an earlier run and does not show this one"


def test_bar_on_a_terminal_ends_as_the_line_of_its_stage():
    console = Console(file=io.StringIO(), force_terminal=True, width=150, markup=False, highlight=False)
    watch, stage = progress.TerminalWatch(console), stage_named("detect")
    with watch.stage(stage, "log changed") as bar:
        bar.total(10, "frames")
        bar.advance(4)
        bar.warn("camera 'arm': 1 of 10 frames is corrupt")
    watch.done(stage, Manifest("detect", 1, "", {}, {}, {}, {}, {"frames": 10}, [], 1.25), ran=True)
    text = console.file.getvalue()
    assert "detect: finding markers (log changed)" in text
    assert "detect: warning: camera 'arm': 1 of 10 frames is corrupt" in text
    assert text.endswith("detect: 10 frames, 1.2 s\n")


def test_counts_read_as_words():
    counts = {
        "frames": 1860,
        "rejected": {"border": 3, "low margin": 38},
        "sigma0": 0.98765,
        "verdict": "PASS",
        "lost": 0,
    }
    assert progress.count_words(counts) == [
        "1,860 frames",
        "41 rejected (low margin 38, border 3)",
        "sigma0 0.988",
        "verdict PASS",
    ]


@pytest.mark.parametrize(
    "seconds, text", [(0.4, "0 s"), (89, "89 s"), (600, "10 min"), (4800, "80 min"), (7260, "2 h 1 min")]
)
def test_durations_as_people_say_them(seconds, text):
    assert progress.duration(seconds) == text


def test_plain_progress_says_an_honest_rest_every_ten_seconds():
    now, lines = [0.0], []
    plain = progress.PlainProgress("detect", lines.append, lambda: now[0])
    plain.total(1000, "frames")
    for _ in range(4):
        now[0] += 5
        plain.advance(100)
    # 20 frames a second: after 10 s 800 are left, 40 s; after 20 s 600, 30 s.
    assert lines == [
        "detect: 200 of 1,000 frames (20 %), about 40 s left",
        "detect: 400 of 1,000 frames (40 %), about 30 s left",
    ]


def test_stages_stand_in_an_order_in_which_each_finds_what_it_needs():
    assert [stage.name for stage in STAGES] == ORDER
    for number, stage in enumerate(STAGES):
        assert set(stage.needs) <= set(ORDER[:number]), stage.name
        assert stage_named(stage.name) is stage
