"""Two reports held against each other: numbers by hand, sigmas by drawing, and refusals for what does not belong."""

import copy
import json
import re

import numpy as np
import pytest

from pipeline.errors import ArtefactError
from pipeline.report import render, report_file
from pipeline.report.difference import as_dict, changes, compare_reports, statistics, table_of
from pipeline.report.report_file import read_report
from tests.report.conftest import made_up_inputs

FILES = {"log": "a", "machine.toml": "b", "site.toml": "c", "design": "d", "checks": "e"}


def row(station, deviation, own=None, common=None, verdict="PASS"):
    return {
        "station": station,
        "deviation": deviation,
        "sigma_own": own,
        "sigma_common": common,
        "verdict": verdict,
    }


def report(rows, **more):
    """The least report.json that can be compared."""
    files = {key: {"name": f"{key} file", "sha256": digit * 64} for key, digit in FILES.items()}
    files["log"]["sha256"] = more.pop("log", "a") * 64
    return {
        "format": "gradetrace/report/1",
        "units": {"length": "m", "deviation": "mm"},
        "verdict": {"word": more.pop("verdict", "PASS")},
        "stations": {
            "columns": [{"key": "deviation", "digits": 0}, {"key": "sigma_own", "digits": 1}],
            "rows": rows,
        },
        "stations_beyond": {"columns": [], "rows": more.pop("beyond", [])},
        "identity": {
            "site": "north", "grid_unit": "m", "station_step": 0.5, "files": files,
            "alignment": {"start_station": 100.0, "end_station": 118.0, "start": [1.0, 2.0], "end": [19.0, 7.0]},
            "versions": {"gradetrace": "1.0"}, "stages": {"survey": 1},
        },
        "settings": {"site": {"tolerance": {"high_mm": 30.0}}, "machine": {"cameras": {"cab": {"xyz_m": [0, 0, 1]}}}},
        **more,
    }  # fmt: skip


@pytest.fixture
def written(tmp_path):
    count = iter(range(100))

    def write(content):
        folder = tmp_path / f"run {next(count)}"
        folder.mkdir()
        text = content if isinstance(content, str) else json.dumps(content)
        (folder / "report.json").write_text(text, encoding="utf-8")
        return folder

    return write


def compared(written, a, b):
    return compare_reports(read_report(written(a)), read_report(written(b)))


A = [row(1.0, 5.0, 3.0, 4.0), row(1.5, -8.0, 3.0, 4.0), row(2.0, 0.0, 3.0, 4.0), row(2.5, 1.0, 3.0, 4.0)]
B = [
    row(2.0, 15.0, 4.0, 7.0, "CANNOT TELL"), row(1.0, 25.0, 4.0, 7.0, "FAIL"), row(1.5, 3.6, 4.0, 7.0),
    row(3.0, None, None, None, "NOT REACHED"), row(3.5, 2.0, 4.0, 7.0),
]  # fmt: skip


def test_differences_are_b_minus_a_matched_by_station(written):
    found = compared(written, report(A), report(B, log="f"))
    assert found.station.tolist() == [1.0, 1.5, 2.0, 2.5, 3.0, 3.5]
    np.testing.assert_allclose(found.difference, [20.0, 11.6, 15.0, np.nan, np.nan, np.nan])
    assert found.verdict_b.tolist() == ["FAIL", "PASS", "CANNOT TELL", "", "NOT REACHED", "PASS"]
    # By hand: own 3 and 4 make 5; common 4 and 7 leave 3 if shared, else 9 + 16 + 16 + 49 = 90.
    np.testing.assert_allclose(found.sigma_shared[:3], np.sqrt(34.0))
    np.testing.assert_allclose(found.sigma_apart[:3], np.sqrt(90.0))
    # Twice these is 11.66 and 18.97.
    assert found.moved.tolist() == ["yes", "no", "open", "", "", ""]
    assert statistics(found) == {
        "n": 3,
        "mean": pytest.approx(46.6 / 3, abs=1e-6),
        "rms": pytest.approx(np.sqrt((400 + 134.56 + 225) / 3), abs=1e-6),
        "worst": 20.0,
        "worst_station": 1.0,
        "only_a": 1,
        "only_b": 1,
        "moved": {"yes": 1, "open": 1, "no": 1},
        "verdicts_changed": 2,
    }


def test_of_one_log_the_own_parts_may_be_shared_too(written):
    found = compared(written, report(A), report(B))
    assert found.same_log
    np.testing.assert_allclose(found.sigma_shared[:3], np.sqrt(1.0 + 9.0))
    np.testing.assert_allclose(found.sigma_apart[:3], np.sqrt(90.0))


@pytest.mark.parametrize("share", [0.0, 0.4, 0.8, 1.0])
def test_the_scatter_of_drawn_differences_lies_between_the_bounds(written, share):
    """One error that both runs have in part; the rest of each common part is the run's own business."""
    found = compared(written, report([row(1.0, 0.0, 3.0, 4.0)]), report([row(1.0, 0.0, 4.0, 7.0)], log="f"))
    rng = np.random.default_rng(4)
    n = 400_000
    both, apart = rng.normal(size=n), rng.normal(size=(2, n))
    left, right = (
        own * rng.normal(size=n) + common * (np.sqrt(share) * both + np.sqrt(1 - share) * apart[k])
        for k, (own, common) in enumerate(((3.0, 4.0), (4.0, 7.0)))
    )
    scatter = np.std(right - left)
    assert 0.995 * found.sigma_shared[0] < scatter < 1.005 * found.sigma_apart[0]
    if share in (0.0, 1.0):
        bound = found.sigma_apart[0] if share == 0 else found.sigma_shared[0]
        assert scatter == pytest.approx(bound, rel=0.005)


def test_what_the_two_rest_on_is_listed_where_it_differs(written):
    other = report(B, log="f")
    other["settings"]["machine"]["cameras"]["cab"]["xyz_m"] = [0, 0, 1.002]
    other["settings"]["site"]["survey"] = {"cell_m": 0.1}
    other["identity"]["versions"]["gradetrace"] = "1.1"
    other["identity"]["stages"]["survey"] = 2
    told = {entry["what"]: (entry["a"], entry["b"]) for entry in changes(compared(written, report(A), other))}
    assert told == {
        "log": ("log file aaaaaaaaaaaa", "log file ffffffffffff"),
        "version gradetrace": ("1.0", "1.1"),
        "version of stage survey": ("1", "2"),
        "setting machine.cameras.cab.xyz_m": ("[0, 0, 1]", "[0, 0, 1.002]"),
        "setting site.survey.cell_m": ("not there", "0.1"),
    }
    assert changes(compared(written, report(A), report(A))) == []


def refused(written, a, b):
    with pytest.raises(ArtefactError) as caught:
        compared(written, a, b)
    assert "\n" not in str(caught.value) and "cannot be compared" in str(caught.value)
    return str(caught.value)


def test_what_is_not_of_one_job_is_refused_with_every_reason(written):
    other = report(B)
    other["identity"]["site"] = "south"
    other["identity"]["files"]["design"]["sha256"] = "9" * 64
    sentence = refused(written, report(A), other)
    assert (
        "two sites ('north' and 'south')" in sentence and "two designs (design file, sha256 dddd" in sentence
    )
    other = report(B)
    other["identity"] |= {"grid_unit": "us_survey_foot"}
    other["units"] = {"length": "US ft", "deviation": "US ft"}
    assert "two units (m and us_survey_foot)" in refused(written, report(A), other)
    other = report(B)
    other["identity"]["station_step"] = 1.0
    assert "stations are 0.5 and 1 m apart" in refused(written, report(A), other)
    other = report(B)
    other["identity"]["alignment"]["end"] = [19.0, 7.001]
    assert "two alignments" in refused(written, report(A), other)


def spoiled(change):
    content = report(copy.deepcopy(A))
    change(content)
    return content


BAD = [
    ("", "is no JSON"),
    ("{", "is no JSON"),
    ('{"format": NaN}', "is no JSON"),
    ("[" * 200_000, "is no JSON"),
    ("[]", "is no report.json"),
    ("{}", "format: expected a text, found null"),
    ('{"format": "other/1"}', "is no report.json"),
    (spoiled(lambda c: c.pop("identity")), "run 'gradetrace report' again"),
    (spoiled(lambda c: c.update(stations=None)), "stations: expected an object, found null"),
    (spoiled(lambda c: c["stations"].update(rows=[1])), "rows: expected a list of objects"),
    (
        spoiled(lambda c: c["stations"]["rows"][0].update(station="1")),
        'station: expected a number, found "1"',
    ),
    (spoiled(lambda c: c["stations"]["rows"][0].update(deviation=True)), "deviation: expected a number"),
    (spoiled(lambda c: c["stations"]["rows"][0].update(deviation=10**400)), "deviation: expected a number"),
    (spoiled(lambda c: c["stations"]["rows"][0].update(sigma_own=-1)), "a negative sigma"),
    (spoiled(lambda c: c["stations"]["rows"][0].update(station=1.5)), "a station stands there twice"),
    (spoiled(lambda c: c["stations"]["rows"][0].update(verdict="<b>")), "verdict: expected PASS or FAIL"),
    (spoiled(lambda c: c["units"].update(length="furlong")), "length: expected m or mm"),
    (spoiled(lambda c: c["identity"]["files"].update(log=3)), "log: expected an object, found 3"),
    (spoiled(lambda c: c["identity"]["alignment"].update(end=[1])), "end: expected two numbers"),
]


@pytest.mark.parametrize("content, sentence", BAD, ids=[s[:40] for _, s in BAD])
def test_a_file_that_is_no_sound_report_is_refused_in_a_sentence(written, content, sentence):
    with pytest.raises(ArtefactError, match=re.escape(sentence)) as caught:
        read_report(written(content))
    assert "\n" not in str(caught.value) and "report.json: " in str(caught.value)


def test_a_file_without_bounds_is_refused(written, monkeypatch, tmp_path):
    folder = written(report(A))
    monkeypatch.setattr(report_file, "MAX_STATIONS", 3)
    with pytest.raises(ArtefactError, match="4 entries under 'rows', at most 3"):
        read_report(folder)
    monkeypatch.setattr(report_file, "MAX_SETTINGS", 1)
    monkeypatch.setattr(report_file, "MAX_STATIONS", 10)
    with pytest.raises(ArtefactError, match="more than 1 settings"):
        read_report(folder)
    monkeypatch.setattr(report_file, "MAX_BYTES", 100)
    with pytest.raises(ArtefactError, match="MB are read"):
        read_report(folder)
    with pytest.raises(ArtefactError, match="no such file; name a run folder"):
        read_report(tmp_path / "nowhere.json")


@pytest.fixture(scope="module")
def pages(tmp_path_factory):
    """A run as the page writes it, and the same site after another shift: every level 7 mm higher."""
    inputs = made_up_inputs()
    content = render(inputs).content
    other = copy.deepcopy(content)
    for entry in other["stations"]["rows"]:
        entry["deviation"] = None if entry["deviation"] is None else entry["deviation"] + 7.0
    other["identity"]["files"]["log"] = {"name": "\x1b[2Jnight.mcap", "sha256": "0" * 64}
    folders = []
    for name, each in (("day", content), ("night", other)):
        folder = tmp_path_factory.mktemp(name)
        (folder / "report.json").write_text(json.dumps(each), encoding="utf-8")
        folders.append(folder)
    return inputs, folders


def test_a_page_as_it_is_written_can_be_compared(pages):
    inputs, (day, night) = pages
    found = compare_reports(read_report(day), read_report(night / "report.json"))
    assert found.b.files["log"][0] == "\ufffd[2Jnight.mcap", "no name clears a terminal"
    stations = inputs.tables["stations"]
    np.testing.assert_allclose(found.station, stations["station"], atol=1e-5)
    np.testing.assert_allclose(found.deviation_a, 1000 * stations["deviation"], atol=6e-4)
    known = np.isfinite(stations["deviation"])
    np.testing.assert_allclose(found.difference[known], 7.0, atol=1e-9)
    # Own 3 mm each, common 4.5 mm each.
    np.testing.assert_allclose(found.sigma_shared[known], np.sqrt(18.0), atol=1e-3)
    np.testing.assert_allclose(found.sigma_apart[known], np.sqrt(18.0 + 2 * 4.5**2), atol=1e-3)
    told = as_dict(found)
    assert told["statistics"]["n"] == known.sum() == 33
    assert [entry["what"] for entry in told["changes"]] == ["log"]
    assert json.loads(json.dumps(told)) == told
    assert len(table_of(found)[1]) == 33


def test_the_command_prints_a_table_and_what_differs(pages, gradetrace):
    day, night = pages[1]
    done = gradetrace("diff", day, night)
    assert (done.code, done.err) == (0, ""), done.err
    lines = done.out.splitlines()
    assert lines[0].endswith("log shift.mcap, verdict FAIL") and "\x1b" not in done.out
    assert re.match(r"station m +A mm +B mm +B - A mm +sigma mm +beyond 2 sigma +verdict$", lines[2])
    assert re.match(r" +100\.25 +\S+ +\S+ +\+7\.0 +4\.2 to 7\.6 +no +PASS", lines[3])
    assert len([line for line in lines if "  +7.0  " in line]) == 33
    assert "B - A over 33 stations that both reached: mean +7.0 mm, RMS 7.0 mm" in done.out
    assert any(line.startswith("different: log: shift.mcap aaaaaaaaaaaa -> ") for line in lines)


def test_the_command_speaks_json_and_refuses_in_one_line(pages, gradetrace, tmp_path):
    day, night = pages[1]
    done = gradetrace("diff", day, night, "--json")
    told = json.loads(done.out)
    assert (done.code, told["format"]) == (0, "gradetrace/difference/1")
    assert told["statistics"]["mean"] == pytest.approx(7.0)
    content = json.loads((night / "report.json").read_text())
    content["identity"]["site"] = "elsewhere"
    (tmp_path / "other.json").write_text(json.dumps(content))
    done = gradetrace("diff", day, tmp_path / "other.json")
    assert (done.code, done.out) == (3, "")
    assert re.fullmatch(
        r"gradetrace: .* cannot be compared station by station: they are of two sites .*\n", done.err
    )
