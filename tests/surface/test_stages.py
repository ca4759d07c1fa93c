"""track and survey as stages: from a states table to stations, checks and survey.json."""

import json
import shutil

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from pipeline import tables
from pipeline.errors import EstimationError, SurfaceError
from pipeline.runs import RunFolder
from pipeline.stages import stage_named, survey, track
from pipeline.stages.job import Job, describe, named_files

ORIGIN = np.array([512_000.0, 4_123_000.0, 50.0])
MACHINE = """
format = "gradetrace/machine/1"
[machine]
id = "pc210"
[bodies.cab]
kind = "moving"
[bodies.bucket]
kind = "moving"
[cameras.front]
topic = "/front"
body = "cab"
mount = { xyz_m = [0, 0, 2], rpy_deg = [0, 0, 0], sigma_mm = 5, sigma_deg = 0.1 }
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
id = "trench"
[grid]
unit = "m"
origin = [512000, 4123000, 50]
[benchmarks.a]
family = "tag36h11"
tags = [{ id = 1, size_m = 0.5 }]
pose = { enh = [512001, 4123001, 51], rpy_deg = [0, 0, 0], sigma_mm = 1, sigma_deg = 0.1 }
[alignment]
points = [[512000, 4123000], [512000, 4123010]]
[design]
file = "design.csv"
kind = "profile_csv"
[tolerance]
high_mm = 30
low_mm = 30
[checks]
file = "checks.csv"
order = "PNEZD"
[survey]
station_step_m = 1.0
"""


class Watch:
    def __init__(self):
        self.warnings = []

    def total(self, amount, unit=""):
        pass

    def advance(self, amount=1):
        pass

    def warn(self, sentence):
        self.warnings.append(sentence)


def states(level=50.0, east=0.0, sigma=0.004, seen=True):
    """Two level passes north along the trench; the edge across it, x of the tool to the east."""
    t = np.concatenate([np.arange(0, 6, 0.1), 10 + np.arange(0, 6, 0.1)])
    n = 2 * len(t)
    p = np.column_stack([np.full(len(t), east), 2 + (t % 10), np.full(len(t), level - 50.0)])
    columns = {name: np.zeros(n) for name in tables.read_schema("states").column_names}
    columns["time_ns"] = np.repeat(1_750_000_000_000_000_000 + np.round(t * 1e9).astype(np.int64), 2)
    columns["body"] = np.tile(np.array(["cab", "tool"], object), len(t))
    for i, name in enumerate(("x_m", "y_m", "z_m")):
        columns[name] = np.repeat(p[:, i], 2)
    for i, name in enumerate(("qx", "qy", "qz", "qw")):
        columns[name] = np.full(n, Rotation.identity().as_quat()[i])
    columns["angle_rad"] = np.full(n, np.nan)
    columns["seen"] = np.full(n, seen)
    for axis in "xyz":
        columns[f"own_{axis}_{axis}"] = np.full(n, sigma**2)
        columns[f"common_{axis}_{axis}"] = np.full(n, 0.003**2)
    return columns


@pytest.fixture
def folder(tmp_path):
    (tmp_path / "machine.toml").write_text(MACHINE)
    (tmp_path / "site.toml").write_text(SITE)
    (tmp_path / "design.csv").write_text("station,elevation,width,side_slope\n0,50,1,0\n10,50,1,0\n")
    (tmp_path / "checks.csv").write_text(
        "".join(f"{i:03d},{4123003 + i},512000.1,50.001,FL\n" for i in range(4))
    )
    (tmp_path / "shift.mcap").write_bytes(b"not looked at")
    return tmp_path


def job_of(folder):
    log = folder / "shift.mcap"
    machine, machine_source, site, site_source = describe(log)
    run_folder = RunFolder(folder / "runs" / "shift")
    run_folder.create()
    return Job(
        log=log, log_sha256="0", folder=run_folder, machine=machine, site=site, machine_source=machine_source,
        site_source=site_source, files=named_files(site, site_source, run_folder),
    )  # fmt: skip


def run_both(folder, answer=None, **how):
    job, watch = job_of(folder), Watch()
    tables.write_table(job.folder.file("states.parquet"), "states", states(**how))
    answer = tables.empty_columns("sensitivities") if answer is None else answer
    tables.write_table(job.folder.file("sensitivities.parquet"), "sensitivities", answer)
    job.folder.file("solution.json").write_text(json.dumps({"correlation_time_s": {"median": 0.4}}))
    tracked = track.run(job.at(stage_named("track"), "f" * 64), watch)
    surveyed = survey.run(job.at(stage_named("survey"), "f" * 64), watch)
    facts = json.loads(job.folder.file("survey.json").read_text())
    return job, watch, tracked, surveyed, facts


def test_a_trench_at_its_level_passes_and_every_file_is_written(folder):
    job, watch, tracked, surveyed, facts = run_both(folder)
    assert watch.warnings == []
    assert tracked == {"poses": 240, "epochs of the cutting edge": 120, "of these bridged": 0}
    assert facts["verdict"] == "PASS" and "within tolerance" in facts["reason"]
    assert facts["counts"] == {"PASS": 5, "FAIL": 0, "CANNOT TELL": 2, "NOT REACHED": 4}
    assert surveyed["stations"] == {"PASS": 5, "CANNOT TELL": 2, "NOT REACHED": 4}
    assert facts["checks"]["n"] == 4
    stations = tables.read_table(job.folder.file("stations.parquet"), "stations")
    assert stations["station"].tolist() == [float(i) for i in range(11)]
    # Two sweeps of 4 mm cannot tell whether both were at the floor: the lower of them was 0 to 2.3 mm below their mean.
    below = stations["deviation"][2:9]
    assert np.all((below > -0.0023) & (below < 0.0001)) and np.ptp(below) < 1e-4
    assert facts["checks"]["bias"] == pytest.approx(below[0] - 0.001, abs=1e-4)
    assert np.isnan(stations["deviation"][[0, 1, 9, 10]]).all()
    # Two passes at one level: the own part is that of two looks, the common part is whole.
    assert np.allclose(stations["sigma_common"][2:9], 0.003)
    assert np.all(stations["sigma_own"][2:9] < 0.004)
    cells = tables.read_table(job.folder.file("as_built.parquet"), "as_built")
    assert set(cells["state"]) == {"cut", "never touched"}
    checks = tables.read_table(job.folder.file("checks.parquet"), "checks")
    assert checks["point"].tolist() == ["000", "001", "002", "003"]
    edge = tables.read_table(job.folder.file("cutting_edge.parquet"), "cutting_edge")
    assert edge["e"][:3].tolist() == [511_999.5, 512_000.0, 512_000.5]  # left is west, looking north


def test_an_over_dug_trench_fails_and_says_which_way(folder):
    job, _, _, _, facts = run_both(folder, level=49.9)
    assert facts["verdict"] == "FAIL"
    reasons = tables.read_table(job.folder.file("stations.parquet"), "stations")["reason"]
    assert "over-dug" in reasons[4]
    assert facts["deviation"]["worst"] == pytest.approx(-0.101, abs=0.0013)


def test_a_trench_not_yet_dug_is_not_reached_and_not_failed(folder):
    _, watch, _, _, facts = run_both(folder, level=51.2)
    assert facts["verdict"] == "CANNOT TELL"
    assert facts["counts"]["NOT REACHED"] == 11
    assert any("came no lower than 1.20 (m) above the design" in sentence for sentence in watch.warnings)
    assert facts["deviation"]["mean"] is None and facts["checks"]["n"] == 0


def responses():
    """Worn teeth lift the edge, in the second pass twice as much as in the first; one common error of 3 mm."""
    time_ns = np.unique(states()["time_ns"])
    lift = np.where(np.arange(len(time_ns)) < len(time_ns) // 2, 1.0, 2.0)
    columns = {name: np.zeros(2 * len(time_ns), np.float32) for name in ("e", "n", "h", "re", "rn", "rh")}
    columns["h"] = np.column_stack([lift, np.full(len(lift), 0.003)]).ravel().astype(np.float32)
    columns["time_ns"] = np.repeat(time_ns, 2)
    for name, words in (("source", ("wear", "common")), ("name", ("", "1")), ("component", ("", ""))):
        columns[name] = np.tile(np.array(words, object), len(time_ns))
    columns["unit"] = np.tile(np.array(("m", "sigma"), object), len(time_ns))
    return columns


def test_checks_of_every_kind_and_the_cause_that_would_explain_them(folder):
    """All stands 40 mm too high: so would a datum have it. Worn teeth would, too, were it not for the second pass."""
    (folder / "site.toml").write_text(
        SITE.replace(
            'order = "PNEZD"',
            'order = "named"\nused_in_calibration = ["CAL"]\n'
            "control.CP1 = { enh = [512000, 4123090, 50], sigma_mm = 3 }",
        )
        + '[report]\ntime_zone = "Europe/Helsinki"\n'
    )
    rows = [f"{i:03d},{4123003 + i},512000.1,{50.0 - 0.04},FL,,floor" for i in range(4)]
    rows += ["C1,4123004,512000.1,40,CAL,,floor", "E1,4123004,512000,50,CE middle,2025-06-15 18:06:41,edge"]
    (folder / "checks.csv").write_text(
        "\n".join(["point,northing,easting,elevation,code,time,kind", *rows, ""])
    )
    job, watch, _, surveyed, facts = run_both(folder, responses())
    assert watch.warnings == [] and surveyed["check shots"] == 7 and surveyed["of these compared"] == 4
    checks = tables.read_table(job.folder.file("checks.parquet"), "checks")
    assert checks["result"].tolist() == [
        *["compared"] * 4, "used in calibration", "edge not still", "edge not set down",
    ]  # fmt: skip
    assert checks["kind"].tolist() == ["floor"] * 5 + ["edge", "control"] and checks["point"][6] == "CP1"
    assert checks["time_ns"][0] > 0 and checks["time_ns"][5] == tables.NULL_INT
    found = facts["checks"]
    assert (found["n"], found["used_in_calibration"]) == (4, 1)
    assert {kind: each["n"] for kind, each in found["kinds"].items()} == {"floor": 4, "edge": 0, "control": 0}
    diagnosis = found["diagnosis"]
    # Four shots of the floor cannot tell the two: their passes are all the first or the second one.
    assert diagnosis["state"] == "cannot tell" and diagnosis["common_factors"]
    by_kind = {each["kind"]: each for each in diagnosis["candidates"]}
    assert by_kind["datum"]["value"] == pytest.approx(0.04, abs=0.002)
    lift = -by_kind["datum"]["value"] / by_kind["wear"]["value"]
    assert lift == pytest.approx(1.0, abs=0.01) or lift == pytest.approx(2.0, abs=0.01)
    assert diagnosis["telling_shot"]["kind"] == "edge"
    assert diagnosis["telling_shot"]["apart_sigmas"] > 3


def test_a_site_without_checks_has_an_empty_table_and_no_statistics(folder):
    (folder / "site.toml").write_text(SITE.replace('[checks]\nfile = "checks.csv"\norder = "PNEZD"\n', ""))
    job, watch, _, _, facts = run_both(folder)
    assert facts["checks"] is None and watch.warnings == []
    assert len(tables.read_table(job.folder.file("checks.parquet"), "checks")["point"]) == 0


def test_an_empty_file_of_checks_is_a_warning(folder):
    (folder / "checks.csv").write_text("")
    _, watch, _, _, facts = run_both(folder)
    assert facts["checks"] is None
    assert watch.warnings == ["checks.csv holds no check shots: there is no independent check of this report"]


def test_what_is_wrong_with_site_files_is_one_sentence(folder):
    (folder / "checks.csv").write_text("1,512000,4123004,50,FL\n2,512000,4123005,50,FL\n")
    with pytest.raises(SurfaceError, match=r"Write checks\.order = 'PENZD'"):
        run_both(folder)
    with pytest.raises(SurfaceError, match=r"no nearer than 80\.0 m"):
        (folder / "checks.csv").write_text("")
        run_both(folder, east=80.0)
    with pytest.raises(SurfaceError, match="never seen"):
        run_both(folder, seen=False)


def test_states_without_the_cutting_edge_say_what_is_missing(folder):
    job = job_of(folder)
    columns = states()
    cab = columns["body"] == "cab"
    tables.write_table(
        job.folder.file("states.parquet"), "states", {name: values[cab] for name, values in columns.items()}
    )
    with pytest.raises(EstimationError, match=r"no state of the cutting edge.*cutting_edge\.body = 'bucket'"):
        track.run(job.at(stage_named("track"), "f" * 64), Watch())


def test_the_same_input_gives_the_same_bytes(folder):
    names = ("poses.parquet", "cutting_edge.parquet", "as_built.parquet", "stations.parquet", "survey.json")
    found = []
    for _ in range(2):
        job = run_both(folder)[0]
        found.append([job.folder.file(name).read_bytes() for name in names])
        shutil.rmtree(folder / "runs")
    assert found[0] == found[1]
