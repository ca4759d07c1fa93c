"""What lies beside a log says one thing, in three formats, and is off the truth by what it admits."""

import xml.etree.ElementTree as ElementTree
from dataclasses import replace

import numpy as np
import pytest

from pipeline.config import load_machine, load_site
from pipeline.geometry import se3
from pipeline.synthetic import files, recording, specification, survey, truth
from pipeline.synthetic.draws import file_mounts, uncertainty
from pipeline.synthetic.excavator import true_mounts

US_FOOT = 0.30480060960121924
LANDXML = "{http://www.landxml.org/schema/LandXML-1.2}"


@pytest.fixture(scope="module", params=["trench", "other"])
def world(request):
    return recording.world(specification.SITES[request.param](), seed=3)


def grid_metres(world, text_values):
    unit = 1.0 if world.spec.unit == "m" else US_FOOT
    return np.array([float(v) for v in text_values]) * unit


def test_both_files_load_and_say_what_was_drawn(world):
    machine = load_machine(files.machine_toml(world.spec, world.files, world.sigma), "machine.toml")
    site = load_site(files.site_toml(world.spec, world.files), "site.toml")
    for name, camera in machine.cameras.items():
        np.testing.assert_allclose(camera.mount.transform(), world.files.cameras[name], atol=2e-5)
        np.testing.assert_allclose(camera.intrinsics.vector(), world.files.intrinsics[name], atol=1e-4)
        np.testing.assert_allclose(np.sqrt(np.diag(camera.mount.covariance_xi())), world.sigma.camera)
    for name, T in world.files.benchmarks.items():
        pose = site.benchmark_pose(name)
        np.testing.assert_allclose(pose.transform(), T, atol=2e-5)
        np.testing.assert_allclose(np.sqrt(np.diag(pose.covariance_xi())), world.sigma.benchmark)
    assert len(site.benchmarks) == len(world.spec.benchmarks)
    ids = [tag.id for mark in site.benchmarks.values() for tag in mark.tags]
    ids += [tag.id for mark in machine.markers.values() for tag in mark.tags]
    assert len(ids) == len(set(ids))


def test_the_buried_line_crosses_the_trench_where_the_plan_says(world):
    text = files.site_toml(world.spec, world.files) + files.afterwards_toml(world.spec)
    found = load_site(text, "site.toml").utilities
    assert set(found) == {plan.name for plan in world.spec.utilities}
    for plan in world.spec.utilities:
        ends = grid_metres(world, np.ravel(found[plan.name].points)).reshape(2, 3)
        unit = 1.0 if world.spec.unit == "m" else US_FOOT
        middle = ends.mean(axis=0) - np.array(world.spec.origin) * unit
        bearing = np.deg2rad(world.spec.bearing_deg)
        along = (middle[:2] - world.spec.start) @ [np.cos(bearing), np.sin(bearing)]
        assert along + world.spec.start_station == pytest.approx(plan.station, abs=2e-3)
        assert middle[2] == pytest.approx(plan.axis, abs=2e-3)
        assert np.linalg.norm(ends[1, :2] - ends[0, :2]) == pytest.approx(2 * plan.reach_m, abs=2e-3)


def test_errors_of_the_files_follow_the_stated_covariances():
    """Over 150 seeds each element's error in its own sigmas has mean 0 and mean square 1."""
    spec = specification.trench()
    built = true_mounts(spec, np.random.default_rng(0))
    sigma = uncertainty(spec)
    z = []
    for seed in range(150):
        found = file_mounts(built, sigma, np.random.default_rng([seed, 3]))
        stated = truth.statics_truth(spec, built, found, sigma)
        draw = [
            *stated["stick_marker"]["z"],
            *stated["axis"]["z"],
            *stated["tool"]["z"],
            *stated["linkage"]["z"],
        ]
        for part in ("cameras", "benchmarks", "curves"):
            draw += [v for item in stated[part].values() for v in item["z"]]
        for item in stated["intrinsics"].values():
            draw += item["z"][:8]  # k3 is exactly 0 in both
        z.append(draw)
    z = np.array(z)
    n = len(z)
    # Five sigmas of the mean, and of the mean square, of n normal draws: a hundred elements are looked at.
    assert np.abs(z.mean(axis=0)).max() < 5 / np.sqrt(n)
    assert np.abs((z**2).mean(axis=0) - 1).max() < 5 * np.sqrt(2 / n)
    off_diagonal = np.corrcoef(z.T) - np.eye(z.shape[1])
    assert np.abs(off_diagonal).max() < 6 / np.sqrt(n)


def test_a_drawn_pose_is_the_truth_moved_in_its_own_frame():
    spec = specification.trench()
    built = true_mounts(spec, np.random.default_rng(0))
    sigma = replace(uncertainty(spec), camera=np.array([0, 0, 0, 0, 0, 0.1]))
    found = file_mounts(built, sigma, np.random.default_rng(1))
    xi = se3.local(found.cameras["bench"], built.cameras["bench"])
    np.testing.assert_allclose(xi[:5], 0, atol=1e-12)  # turned about the optical axis, as the covariance says
    assert abs(xi[5]) > 1e-3


def test_landxml_and_csv_are_the_same_design(world):
    root = ElementTree.fromstring(survey.design_xml(world.spec))
    unit_name = root.find(f"{LANDXML}Units")[0].get("linearUnit")
    assert unit_name == {"m": "meter", "us_survey_foot": "USSurveyFoot"}[world.spec.unit]
    points = np.array([grid_metres(world, p.text.split()) for p in root.iter(f"{LANDXML}P")])
    start, end = (
        grid_metres(world, next(root.iter(f"{LANDXML}{tag}")).text.split()) for tag in ("Start", "End")
    )
    along = (end - start) / np.linalg.norm(end - start)
    first = float(next(root.iter(f"{LANDXML}Alignment")).get("staStart"))
    station = (points[:, :2] - start) @ along + grid_metres(world, [first])[0]
    offset = (points[:, :2] - start) @ np.array([along[1], -along[0]])  # northing, easting: to the right
    rows = [line.split(",") for line in survey.design_csv(world.spec).splitlines()[1:]]
    for row in rows:
        at, level, width = grid_metres(world, row[:3])
        here = np.abs(station - at) < 1e-3
        assert here.sum() == 4
        floor = np.argsort(points[here, 2])[:2]
        np.testing.assert_allclose(points[here, 2][floor], level, atol=2e-4)
        np.testing.assert_allclose(np.sort(offset[here][floor]), [-width / 2, width / 2], atol=2e-4)
        top = np.argsort(points[here, 2])[2:]
        run = (np.abs(offset[here][top]) - width / 2) / (points[here, 2][top] - level)
        np.testing.assert_allclose(run, float(row[3]), atol=1e-3)


def test_the_triangles_of_the_landxml_face_up_and_cover_the_trench(world):
    root = ElementTree.fromstring(survey.design_xml(world.spec))
    ne = np.array([grid_metres(world, p.text.split())[:2] for p in root.iter(f"{LANDXML}P")])
    faces = np.array([[int(v) for v in f.text.split()] for f in root.iter(f"{LANDXML}F")]) - 1
    a, b, c = (ne[faces[:, k]] - ne[0] for k in range(3))
    doubled = np.abs(np.linalg.det(np.stack([b - a, c - a], axis=-1)))
    rows = survey.design_rows(world.spec)
    rows[:, 1] -= world.spec.origin[2] * (1.0 if world.spec.unit == "m" else US_FOOT)
    top = rows[:, 2] + 2 * rows[:, 3] * (world.spec.ground - rows[:, 1])
    plan = np.sum(np.diff(rows[:, 0]) * 0.5 * (top[1:] + top[:-1]))
    assert 0.5 * doubled.sum() == pytest.approx(plan, rel=1e-3)


def test_check_shots_lie_on_the_finished_floor_within_their_noise(world):
    """PNEZD, so northing comes first; what was shot is the true floor, 2 mm off."""
    lines = [line.split(",") for line in recording._checks(world).splitlines()]
    assert len(lines) > 6
    assert "control point" in lines[0][4]
    unit = 1.0 if world.spec.unit == "m" else US_FOOT
    origin = np.array(world.spec.origin) * unit
    floor = truth.dug_floor(world.spec, world.truth, world.motion, recording.CELL_M)
    errors = []
    for _, northing, easting, elevation, note in lines:
        enh = grid_metres(world, [easting, northing, elevation]) - origin
        if note.startswith("CP"):
            np.testing.assert_allclose(enh, world.motion.control_point, atol=0.009)
            continue
        station, offset = world.motion.place.station_offset(enh)
        row = np.argmin(np.abs(floor.station - station))
        column = np.argmin(np.abs(floor.offset - offset))
        errors.append(enh[2] - floor.z[row, column])
    assert np.abs(errors).max() < 0.009
    assert np.std(errors) == pytest.approx(0.002, rel=0.8)
