"""What `gradetrace check` says of the files that site.toml names, before any picture is looked at."""

import shutil
from pathlib import Path

import pytest

from pipeline.config import load_site
from pipeline.preflight.files import file_findings
from pipeline.stages.job import Source

SAMPLE = Path(__file__).parents[2] / "sample_logs" / "trench"


@pytest.fixture
def said(tmp_path):
    """Levels and sentences for the sample's files, its check shots changed row by row."""

    def look(change):
        for name in ("site.toml", "design.csv"):
            shutil.copy(SAMPLE / name, tmp_path / name)
        rows = [line.split(",") for line in (SAMPLE / "checks.csv").read_text().splitlines()]
        (tmp_path / "checks.csv").write_text("\n".join(",".join(change(row)) for row in rows) + "\n")
        site = load_site((tmp_path / "site.toml").read_text(), "site.toml")
        source = Source("site.toml", "beside the log", "0" * 64, tmp_path)
        return [(finding.level, finding.sentence) for finding in file_findings(site, source)]

    return look


def test_files_that_belong_together_are_fine(said):
    found = said(lambda row: row)
    assert {level for level, _ in found} == {"ok"}
    assert found[-1][1] == "checks.csv: 17 check shots"


def test_northing_and_easting_exchanged_are_told_before_the_report(said):
    level, sentence = said(lambda row: [row[0], row[2], row[1], *row[3:]])[-1]
    assert level == "error"
    assert "with northing and easting exchanged 17 do" in sentence


def test_a_file_without_a_shot_is_no_check(said):
    level, sentence = said(lambda row: [])[-1]
    assert level == "warning" and "there is no shot in it" in sentence


def test_shots_that_lie_nowhere_near_the_floor_are_told(said):
    found = said(lambda row: [*row[:3], str(float(row[3]) / 0.3048), *row[4:]])
    assert ("warning", True) in [
        (level, "every shot lies more than 20 m above or below" in s) for level, s in found
    ]
