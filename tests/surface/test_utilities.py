"""From site.toml and LandXML pipes to verdicts, the table and survey.json."""

import json
from dataclasses import replace

import numpy as np
import pytest

from pipeline import tables
from pipeline.config import load_site
from pipeline.errors import ConfigError, SurfaceError
from pipeline.stages import stage_named
from pipeline.stages.runner import plan
from pipeline.surface import utilities
from pipeline.surface.landxml import LandXml, XmlPipe
from pipeline.surface.utilities import pipes_of, read_utilities, verdict_of
from tests.surface.test_stages import SITE, folder, job_of, run_both  # noqa: F401

# The edge, a metre wide across easting 512000, goes twice from northing 4123002 to 4123008 at the level 50.
LINES = """
[utilities.main]
kind = "gas"
points = [[511990, 4123005.3, 49.4], [512010, 4123005.3, 49.4]]
radius_mm = 100
sigma_mm = [40, 30]
[utilities.drain]
kind = "sewer"
points = [[512000.45, 4123000, 49.9], [512000.45, 4123003, 49.95], [512003, 4123003, 50]]
radius_mm = 75
sigma_mm = 20
clearance_mm = 300
[utilities.street]
kind = "water"
points = [[512030, 4123000, 49], [512030, 4123010, 49]]
radius_mm = 50
sigma_mm = 100
"""
PIPES = """
[utilities.pipes]
kind = "sewer"
file = "pipes.xml"
network = "storm"
sigma_mm = 20
"""


def site_with(text, unit="m"):
    return load_site(SITE.replace('unit = "m"', f'unit = "{unit}"') + text, "site.toml")


def test_the_stage_finds_each_line_and_says_how_near(folder):  # noqa: F811
    (folder / "site.toml").write_text(SITE + LINES)
    job, watch, _, surveyed, facts = run_both(folder)
    assert watch.warnings == []
    assert surveyed["utilities"] == {"STRIKE LIKELY": 1, "NEAR MISS": 1, "NOT APPROACHED": 1}
    assert facts["utilities"]["reach"] == 2.0
    main, drain, street = facts["utilities"]["lines"]
    # 600 mm below the edge, less its radius; 30 mm of the line, 4 own and 3 common of the edge, all vertical.
    assert main["distance"] == pytest.approx(0.5, abs=1e-6)
    assert [main[k] for k in ("sigma_own", "sigma_common", "sigma_line")] == pytest.approx(
        [0.004, 0.003, 0.03]
    )
    sigma = np.sqrt(0.004**2 + 0.003**2 + 0.03**2)
    # Horizontal errors, 40 mm, lengthen a distance of 0.6 m by 40² / (2 x 0.55) = 1.5 mm.
    assert main["bound"] == pytest.approx(0.5 - 1.645 * sigma - 0.0015, abs=4e-4)
    assert main["station"] == pytest.approx(5.3, abs=1e-3) and main["approaches"]["NEAR MISS"] == 2
    assert main["verdict"] == "NEAR MISS" and main["unseen"]["stretches"] == 1
    # The drain runs 67 mm under the edge's right half where the first pass begins, by 3 / 4 of its way up its fall.
    assert drain["verdict"] == "STRIKE LIKELY" and drain["distance"] == pytest.approx(0.05 - 0.075, abs=2e-3)
    assert drain["offset"] == pytest.approx(0.45, abs=0.06)
    assert street["verdict"] == "NOT APPROACHED" and street["approaches"]["NEAR MISS"] == 0
    # From the edge's right end: 29.5 m east, 1 m up.
    assert street["distance"] == pytest.approx(np.hypot(29.5, 1.0) - 0.05, abs=1e-6)
    rows = tables.read_table(job.folder.file("utilities.parquet"), "utilities")
    assert rows["utility"].tolist() == ["main"] * 2 + ["drain"] * 2 + ["street"]
    assert rows["nearest"].tolist() == [True, False, True, False, True]
    assert rows["verdict"][0] == "NEAR MISS" and rows["verdict"][-1] == "NOT APPROACHED"
    assert (rows["e"][0], rows["h"][0]) == (pytest.approx(512_000, abs=0.51), pytest.approx(50.0, abs=1e-6))
    assert rows["axis_h"][0] == pytest.approx(49.4) and rows["axis_n"][0] == pytest.approx(4_123_005.3)


def test_a_log_that_never_saw_the_edge_near_a_line_clears_nothing():
    assert verdict_of(0.0, -0.1, 0.5) == "STRIKE LIKELY"
    assert verdict_of(0.05, 0.0, 0.5) == "STRIKE POSSIBLE"
    assert verdict_of(0.6, 0.499, 0.5) == "NEAR MISS"
    assert verdict_of(0.6, 0.5, 0.5) == "CLEAR"
    assert verdict_of(2.0, 1.9, 0.5) == "NOT APPROACHED"


def test_a_site_without_utilities_has_an_empty_table(folder):  # noqa: F811
    job, _, _, surveyed, facts = run_both(folder)
    assert facts["utilities"] is None and "utilities" not in surveyed
    assert len(tables.read_table(job.folder.file("utilities.parquet"), "utilities")["utility"]) == 0


def test_lines_are_read_in_the_unit_of_the_grid():
    unit = 1200 / 3937
    (found,) = read_utilities(site_with(LINES.split("[utilities.drain]")[0], "us_survey_foot"), {})
    assert np.allclose(found.line.start, np.array([[511990, 4123005.3, 49.4]]) * unit, rtol=0, atol=1e-6)
    assert found.line.radius.tolist() == [0.1] and found.line.clearance == 0.5


def storm(unit="m", diameter=0.4):
    pipes = (
        XmlPipe("storm", "P1", (512000.0, 4123000.0, 49.0), (512000.0, 4123005.0, 48.9), diameter),
        XmlPipe("storm", "P2", (512000.0, 4123005.0, 48.9), (512003.0, 4123009.0, 48.8), 0.3),
        XmlPipe("water", "W1", (512000.0, 4123000.0, 48.0), (512000.0, 4123005.0, 48.0), 0.1),
    )
    return LandXml("pipes.xml", unit, unit, (), (), pipes)


def test_the_axis_of_a_pipe_lies_half_its_inside_diameter_above_its_invert():
    site = site_with(PIPES)
    start, end, radius = pipes_of(storm(), site.utilities["pipes"], site, "pipes")
    assert start.tolist() == [[512000, 4123000, 49.2], [512000, 4123005, 49.05]]
    assert end[:, 2].tolist() == pytest.approx([49.1, 48.95]) and radius.tolist() == [0.2, 0.15]
    outer = site.utilities["pipes"].model_copy(update={"radius_mm": 250.0})
    start, _, radius = pipes_of(storm(diameter=None), outer, site, "pipes")
    assert radius.tolist() == [0.25, 0.25] and start[:, 2].tolist() == pytest.approx([49.25, 49.05])


def test_pipes_are_read_from_the_file_that_site_toml_names(folder):  # noqa: F811
    """In feet, as LandXML states diameters of a file in feet: inches."""
    unit = 1200 / 3937
    (folder / "pipes.xml").write_text(
        '<LandXML><Units><Imperial linearUnit="USSurveyFoot" diameterUnit="inch"/></Units><PipeNetworks>'
        '<PipeNetwork name="storm"><Structs>'
        '<Struct name="A"><Center>4123000 512000</Center><Invert elev="49.2" flowDir="out" refPipe="P1"/></Struct>'
        '<Struct name="B"><Center>4123010 512001</Center><Invert elev="49" flowDir="in" refPipe="P1"/></Struct>'
        '</Structs><Pipes><Pipe name="P1" refStart="A" refEnd="B"><CircPipe diameter="12"/></Pipe></Pipes>'
        "</PipeNetwork></PipeNetworks></LandXML>"
    )
    site = site_with(PIPES, "us_survey_foot")
    (found,) = read_utilities(site, {"utilities.pipes": folder / "pipes.xml"})
    # The invert plus six inches: they and a US survey foot differ by 2 in a million, far under what is held here.
    assert found.line.start / unit == pytest.approx(np.array([[512000, 4123000, 49.7]]), abs=1e-5)
    assert found.line.end / unit == pytest.approx(np.array([[512001, 4123010, 49.5]]), abs=1e-5)
    assert found.line.radius[0] == pytest.approx(0.1524, abs=1e-6)


def test_files_of_pipes_that_cannot_be_used_are_one_sentence(monkeypatch, folder):  # noqa: F811
    site = site_with(PIPES)
    pipes = site.utilities["pipes"]
    with pytest.raises(SurfaceError, match=r"its unit is 'foot'.*grid.unit"):
        pipes_of(replace(storm(), unit="international_foot", unit_as_written="foot"), pipes, site, "pipes")
    with pytest.raises(SurfaceError, match=r"holds no network 'gas', but 'storm', 'water'"):
        pipes_of(storm(), pipes.model_copy(update={"network": "gas"}), site, "pipes")
    with pytest.raises(SurfaceError, match=r"holds no pipe, but no pipes at all"):
        pipes_of(replace(storm(), placed_pipes=()), pipes.model_copy(update={"network": None}), site, "pipes")
    with pytest.raises(SurfaceError, match=r"no diameter of pipe 'P1'; give radius_mm of utilities.pipes"):
        pipes_of(storm(diameter=None), pipes, site, "pipes")
    swapped = tuple(replace(p, start=(p.start[1], p.start[0], p.start[2])) for p in storm().pipes)
    with pytest.raises(SurfaceError, match=r"pipe 'P2' lies 5,\d\d\d km from grid.origin"):
        pipes_of(replace(storm(), placed_pipes=swapped), pipes, site, "pipes")
    monkeypatch.setattr(utilities, "MAX_SEGMENTS", 2)
    with pytest.raises(SurfaceError, match=r"4 straight pieces in all, at most 2"):
        read_utilities(site_with(LINES), {})
    (folder / "site.toml").write_text(SITE + PIPES)
    with pytest.raises(ConfigError, match=r"utilities.pipes.file = 'pipes.xml': no such file"):
        job_of(folder)


def test_another_file_of_pipes_makes_the_survey_stale(folder):  # noqa: F811
    (folder / "site.toml").write_text(SITE + PIPES)
    found = []
    for text in ("<LandXML/>", "<LandXML></LandXML>"):
        (folder / "pipes.xml").write_text(text)
        job = job_of(folder)
        found.append(
            [
                plan(job, stage_named(name)).fingerprint(stage_named(name))
                for name in ("survey", "report", "track")
            ]
        )
        assert json.dumps(plan(job, stage_named("survey")).inputs).count("utilities.pipes") == 1
    assert found[0][0] != found[1][0] and found[0][1] != found[1][1] and found[0][2] == found[1][2]
