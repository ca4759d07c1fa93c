"""What leaves as a drawing: gaps stay gaps, points lie where they say, and other programs read back what we held."""

import io
import itertools
import math
import os
import subprocess
import sys
from pathlib import Path

import ezdxf
import numpy as np
import pytest
from ezdxf.math import bulge_to_arc
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from lxml import etree

from pipeline.config.site import METRES_PER_UNIT
from pipeline.surface import drawing_exchange
from pipeline.surface.alignment import from_elements, polyline
from pipeline.surface.design import alignment_of
from pipeline.surface.drawing_exchange import dxf_bytes
from pipeline.surface.hand_off import (
    CutCells,
    HandOff,
    Marks,
    Mesh,
    floor_points,
    mesh_of_cells,
    stretches,
)
from pipeline.surface.landxml import read_landxml
from pipeline.surface.landxml_out import NAMESPACE, landxml_bytes

ENDED = 1_764_201_600_000_000_000 + 3_723 * 10**9  # 2025-11-27 01:02:03 UTC
EAST, NORTH = 512_000.0, 4_123_000.0
HOSTILE = "<a href='x'>&amp; \"=cmd|' /C calc'!A0"
CELL = 0.05


def cells_of(image, h=None):
    """Cells of a bool image: rows along a line to the north, from station 0; all of them floor."""
    row, column = np.nonzero(image)
    station, offset = (row + 0.5) * CELL, (column + 0.5 - 0.5 * image.shape[1]) * CELL
    level = 50 + 0.1 * station - 0.2 * offset if h is None else h[row, column]
    return CutCells(station, offset, level, np.ones(len(row), bool), CELL)


def north(length):
    return polyline([[EAST, NORTH], [EAST, NORTH + length]])


def handed(unit="m", **more):
    line = more.pop("alignment", north(20.0))
    surface = more.pop("surface", Mesh(np.zeros((0, 3)), np.zeros((0, 3), int)))
    return HandOff(
        unit, METRES_PER_UNIT[unit], more.pop("project", "job"), "1.2", ENDED, line, surface, **more
    )


def read_back(data, tmp_path):
    path = tmp_path / "as_built.xml"
    path.write_bytes(data)
    return read_landxml(path)


def tree(data):
    return etree.fromstring(data, etree.XMLParser(resolve_entities=False))


def found(root, name):
    return root.findall(f".//{{{NAMESPACE}}}{name}")


@st.composite
def images(draw):
    rows, columns = draw(st.integers(1, 60)), draw(st.integers(1, 12))
    rng = np.random.default_rng(draw(st.integers(0, 2**32)))
    return rng.random((rows, columns)) < draw(st.sampled_from([0.5, 0.9, 0.98, 1.0]))


@given(images(), st.sampled_from([10, 60, 10_000]))
@settings(max_examples=60, deadline=None)
def test_no_face_covers_a_cell_that_was_not_cut(image, most):
    mesh = mesh_of_cells(cells_of(image), north(20.0), most)
    assert len(mesh.faces) <= most
    # Many places inside every face, each in the cell whose centre is nearest.
    grid = np.linspace(0.02, 0.96, 12 * max(mesh.every, mesh.across))
    u, v = (a.ravel() for a in np.meshgrid(grid, grid))
    inside = u + v < 0.98
    weights = np.column_stack([1 - u - v, u, v])[inside]
    places = np.einsum("wc,fcx->fwx", weights, mesh.points[mesh.faces][:, :, :2]).reshape(-1, 2)
    row = np.floor((places[:, 1] - NORTH) / CELL).astype(int)
    column = np.floor((places[:, 0] - EAST) / CELL + 0.5 * image.shape[1]).astype(int)
    assert image[row, column].all()


@given(images())
@settings(max_examples=60, deadline=None)
def test_unthinned_every_square_of_four_cut_cells_has_two_faces_and_of_three_one(image):
    mesh = mesh_of_cells(cells_of(image), north(20.0), 10**6)
    full = half = 0
    for i in range(image.shape[0] - 1):
        for j in range(image.shape[1] - 1):
            cut = int(image[i : i + 2, j : j + 2].sum())
            full, half = full + (cut == 4), half + (cut == 3)
    assert mesh.every == 1 and len(mesh.faces) == 2 * full + half
    assert mesh.areas()[0] == pytest.approx((full + 0.5 * half) * CELL**2, abs=1e-8)


def test_faces_turn_to_the_left_and_carry_the_cells_own_elevations():
    h = np.random.default_rng(3).normal(50, 0.01, (40, 10))
    mesh = mesh_of_cells(cells_of(np.ones((40, 10), bool), h), north(20.0), 100)
    assert mesh.every > 1 and mesh.across == 1
    a, b, c = (mesh.points[mesh.faces[:, i]] for i in range(3))
    assert np.all(np.cross(b - a, c - a)[:, 2] > 0)
    row = np.round((mesh.points[:, 1] - NORTH) / CELL - 0.5).astype(int)
    column = np.round((mesh.points[:, 0] - EAST) / CELL + 4.5).astype(int)
    np.testing.assert_array_equal(mesh.points[:, 2], h[row, column])
    assert set(row) == {*range(0, 40, mesh.every), 39}


def test_a_wide_field_is_thinned_both_ways_and_keeps_its_area():
    mesh = mesh_of_cells(cells_of(np.ones((2001, 801), bool)), north(200.0), 2_000)
    assert mesh.every > 8 and mesh.across > 1
    assert 1_200 < len(mesh.faces) <= 2_000
    assert mesh.areas()[0] == pytest.approx(2000 * 800 * CELL**2, rel=1e-6)


def test_cells_that_nothing_joins_to_the_floor_are_no_surface():
    """The edge crosses the plane of a designed slope in the air above the ground too."""
    image = np.zeros((10, 20), bool)
    image[:, :6] = image[2:6, 10:14] = True
    cells = cells_of(image)
    floor = cells.offset < cells.offset.min() + 4 * CELL
    mesh = mesh_of_cells(CutCells(cells.station, cells.offset, cells.h, floor, CELL), north(20.0))
    assert len(mesh.faces) == 2 * 9 * 5, "the slope beside the floor stays, the scrap goes"


def test_a_station_has_the_edges_and_the_middle_of_its_cut_floor():
    """On the border of two rows the point lies at the station itself, at the level of the plane there."""
    cells = cells_of(np.ones((40, 20), bool))
    points = floor_points(cells, north(20.0), np.array([0.5, 1.0, 1.5]), np.array([True, False, True]), 1.0)
    assert points.name.tolist() == [
        "S0000.50L",
        "S0000.50C",
        "S0000.50R",
        "S0001.50L",
        "S0001.50C",
        "S0001.50R",
    ]
    assert points.code.tolist()[:3] == ["FLOOR-L", "FLOOR-C", "FLOOR-R"]
    offset = np.array([-0.475, -0.025, 0.475])
    np.testing.assert_allclose(points.p_grid[:3, 0], EAST + offset, atol=1e-9)
    np.testing.assert_allclose(points.p_grid[:3, 1], NORTH + 0.5, atol=1e-9)
    np.testing.assert_allclose(points.p_grid[:3, 2], 50.05 - 0.2 * offset, atol=1e-9)


def test_a_station_says_no_more_than_was_cut():
    image = np.ones((40, 6), bool)
    image[8:12] = False  # around 0.5: nothing
    image[18:22, 1:] = False  # around 1.0: one column
    image[28:32, 2:] = False  # around 1.5: two
    image[29, 0] = False  # there only the row behind the station has the left one
    station = np.array([0.5, 1.0, 1.5])
    points = floor_points(cells_of(image), north(20.0), station, np.ones(3, bool), 1.0)
    assert points.name.tolist() == ["S0001.00C", "S0001.50L", "S0001.50R"]
    np.testing.assert_allclose(points.p_grid[:, 1] - NORTH, [1.0, 1.525, 1.5], atol=1e-9)
    np.testing.assert_allclose(points.p_grid[1, 2], 50 + 0.1 * 1.525 + 0.2 * 0.125, atol=1e-9)


def test_names_take_the_digits_that_tell_stations_apart():
    cells = cells_of(np.ones((400, 1), bool))
    station = np.arange(1.0, 1.02, 0.004)
    names = floor_points(cells, north(20.0), station, np.ones(len(station), bool), 1.0).name
    assert names[1] == "S0001.004C" and len(set(names)) == len(station)
    feet = floor_points(
        cells, north(20.0), np.array([3.048]), np.array([True]), METRES_PER_UNIT["international_foot"]
    )
    assert feet.name.tolist() == ["S0010.00C"]


def test_a_profile_breaks_at_a_gap_and_a_station_alone_is_no_line():
    h = np.array([np.nan, 1.0, 2.0, np.nan, 3.0, np.nan, 4.0, 5.0, 6.0])
    runs = stretches(np.arange(9.0), h)
    assert [run.tolist() for run in runs] == [[[1, 1], [2, 2]], [[6, 4], [7, 5], [8, 6]]]
    lists = found(tree(landxml_bytes(handed(profile=runs))), "PntList2D")
    assert [element.text for element in lists] == ["1 1 2 2", "6 4 7 5 8 6"]
    assert {element.getparent().get("state") for element in lists} == {"existing"}


@st.composite
def designs(draw):
    """A surface of triangles over a grid that was shaken, and a chain of lines and arcs without kinks."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32)))
    rows, columns = draw(st.integers(2, 8)), draw(st.integers(2, 8))
    n, e = np.divmod(np.arange(rows * columns), columns)
    points = np.column_stack([e, n, np.zeros(len(n))]) * 3.0 + rng.uniform(-1, 1, (len(n), 3))
    points += [EAST, NORTH, draw(st.sampled_from([-12.0, 0.0, 3000.0]))]
    at = np.flatnonzero((n < rows - 1) & (e < columns - 1))
    faces = np.concatenate([
        np.column_stack([at, at + 1, at + columns]),
        np.column_stack([at + 1, at + columns + 1, at + columns]),
    ])  # fmt: skip
    faces = faces[rng.random(len(faces)) < 0.9]
    place, angle = np.array([EAST, NORTH]), rng.uniform(0, 2 * np.pi)
    starts, ends, centers, turns, length = [], [], [], [], 0.0
    for turn in draw(st.lists(st.sampled_from([0, -1, 1]), min_size=1, max_size=6)):
        starts.append(place)
        ahead = np.array([np.cos(angle), np.sin(angle)])
        if turn == 0:
            step = rng.uniform(1, 80)
            centers.append([np.nan, np.nan])
            place, length = place + step * ahead, length + step
        else:
            radius, sweep = rng.uniform(3, 400), rng.uniform(0.05, 4.5)
            center = place + radius * turn * np.array([ahead[1], -ahead[0]])
            back = place - center
            c, s = np.cos(-turn * sweep), np.sin(-turn * sweep)
            place = center + [c * back[0] - s * back[1], s * back[0] + c * back[1]]
            angle -= turn * sweep
            centers.append(center)
            length += radius * sweep
        ends.append(place)
        turns.append(turn)
    start = draw(st.sampled_from([0.0, -25.5, 1234.5]))
    return points, faces, from_elements(starts, ends, centers, turns, start, "axis <1>"), length


@given(designs(), st.sampled_from(sorted(METRES_PER_UNIT)))
@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_a_design_that_leaves_comes_back_the_same(tmp_path, design, unit):
    points, faces, line, length = design
    scale = METRES_PER_UNIT[unit]
    hand_off = handed(unit, alignment=line, surface=Mesh(points, faces), surface_name="design & more")
    data = landxml_bytes(hand_off)
    assert data == landxml_bytes(hand_off)
    landxml = read_back(data, tmp_path)
    assert landxml.unit == unit
    if len(faces):
        surface = landxml.surface("design & more")
        assert surface.faces.tolist() == faces.tolist() and surface.invisible == 0
        np.testing.assert_allclose(surface.points, points / scale, rtol=0, atol=0.6e-6)
        sides = np.linalg.norm(points[faces] - points[faces][:, [1, 2, 0]], axis=2) / scale
        half = sides.sum(axis=1) / 2
        heron = np.sqrt(np.maximum(half * np.prod(half[:, None] - sides, axis=1), 0)).sum()
        assert surface.stated["area3DSurf"] == pytest.approx(heron, rel=1e-6)
        flat = points[faces][:, :, :2] / scale
        shoelace = (
            0.5
            * np.abs(
                np.einsum("fi,fi->f", flat[:, :, 0], flat[:, [1, 2, 0], 1] - flat[:, [2, 0, 1], 1])
            ).sum()
        )
        assert surface.stated["area2DSurf"] == pytest.approx(shoelace, rel=1e-6)
        level = points[np.unique(faces), 2] / scale
        assert surface.stated["elevMin"] == pytest.approx(level.min(), abs=1e-6)
        assert surface.stated["elevMax"] == pytest.approx(level.max(), abs=1e-6)
    element = landxml.alignment("axis <1>")
    assert element.stated_length == pytest.approx(length / scale, abs=1e-5)
    again = alignment_of(element, "as_built.xml", scale)
    assert again.turn.tolist() == line.turn.tolist()
    np.testing.assert_allclose(again.station, line.station, rtol=0, atol=1e-4)
    s = np.linspace(line.start_station, line.end_station, 40)
    np.testing.assert_allclose(again.points(s, 1.5), line.points(s, 1.5), rtol=0, atol=1e-4)

    drawing = ezdxf.read(io.StringIO(dxf_bytes(hand_off).decode("utf-8")))
    assert drawing.header["$INSUNITS"] == {"m": 6, "international_foot": 2, "us_survey_foot": 21}[unit]
    drawn = [
        [vertex.xyz for vertex in (face.dxf.vtx0, face.dxf.vtx1, face.dxf.vtx2)]
        for face in drawing.modelspace().query("3DFACE")
    ]
    np.testing.assert_allclose(np.reshape(drawn, (-1, 3, 3)), points[faces] / scale, rtol=0, atol=0.6e-6)
    (axis,) = drawing.modelspace().query("LWPOLYLINE")
    corners, run = axis.get_points("xyb"), 0.0
    for (e, n, bulge), (e2, n2, _) in itertools.pairwise(corners):
        if bulge:
            _, first, last, radius = bulge_to_arc((e, n), (e2, n2), bulge)
            run += radius * ((last - first) % (2 * math.pi))
        else:
            run += math.hypot(e2 - e, n2 - n)
    assert run == pytest.approx(length / scale, abs=2e-4)
    assert [bulge > 0 for *_, bulge in corners[:-1]] == (line.turn < 0).tolist()


def test_landxml_has_what_the_standard_demands_and_the_date_of_the_log():
    root = tree(landxml_bytes(handed(surface=mesh_of_cells(cells_of(np.ones((4, 4), bool)), north(20.0)))))
    assert (root.tag, root.get("version")) == (f"{{{NAMESPACE}}}LandXML", "1.2")
    assert (root.get("date"), root.get("time")) == ("2025-11-27", "01:02:03")
    assert [etree.QName(child).localname for child in root] == [
        "Units", "Project", "Application", "Alignments", "Surfaces",
    ]  # fmt: skip
    assert dict(found(root, "Metric")[0].attrib) == {
        "linearUnit": "meter", "areaUnit": "squareMeter", "volumeUnit": "cubicMeter",
        "temperatureUnit": "celsius", "pressureUnit": "HPA",
    }  # fmt: skip
    assert not any("timeStamp" in element.attrib for element in root.iter())


@pytest.mark.parametrize("unit, word", [("international_foot", "foot"), ("us_survey_foot", "USSurveyFoot")])
def test_feet_are_called_by_their_right_name(unit, word):
    root = tree(landxml_bytes(handed(unit)))
    (imperial,) = found(root, "Imperial")
    assert (imperial.get("linearUnit"), imperial.get("areaUnit")) == (word, "squareFoot")
    assert float(found(root, "Alignment")[0].get("length")) == pytest.approx(
        20 / METRES_PER_UNIT[unit], abs=1e-6
    )


def test_without_a_surface_there_is_none_in_the_files():
    assert found(tree(landxml_bytes(handed())), "Surfaces") == []
    drawing = ezdxf.read(io.StringIO(dxf_bytes(handed()).decode("utf-8")))
    assert len(drawing.modelspace().query("3DFACE")) == 0


def test_hostile_names_arrive_as_text():
    line = north(20.0)
    named = type(line)(**{**line.__dict__, "name": HOSTILE + "\x01\ud800"})
    root = tree(landxml_bytes(handed(alignment=named, project=HOSTILE)))
    assert found(root, "Project")[0].get("name") == HOSTILE
    assert found(root, "Alignment")[0].get("name") == HOSTILE + "\ufffd\ufffd"
    texts = (HOSTILE, "50 %", "a%%ub", "^Jx^ y^", "two\nlines\x1b\x85", "{\\P}", "\u00e5\u00e4\u00f6\u2212")
    marks = Marks(np.tile([[EAST, NORTH, 50.0]], (len(texts), 1)), texts)
    drawing = ezdxf.read(io.StringIO(dxf_bytes(handed(checks=marks)).decode("utf-8")))
    read = [text.plain_text() for text in drawing.modelspace().query("TEXT")]
    expected = list(texts)
    expected[3], expected[4] = "^Jx^ y", "two lines  "
    assert [text.rstrip("^ ") for text in read] == [text.rstrip("^ ") for text in expected]


def test_a_drawing_repeats_byte_for_byte_and_leaves_the_library_as_it_was():
    marks = Marks(np.array([[EAST, NORTH, 50.0]]), ("1",))
    surface = mesh_of_cells(cells_of(np.ones((4, 4), bool)), north(20.0))
    first = dxf_bytes(handed(surface=surface, checks=marks, stations=marks))
    assert not ezdxf.options.write_fixed_meta_data_for_testing
    assert first == dxf_bytes(handed(surface=surface, checks=marks, stations=marks))
    drawing = ezdxf.read(io.StringIO(first.decode("utf-8")))
    assert set(drawing_exchange.LAYERS) <= {layer.dxf.name for layer in drawing.layers}
    assert len(drawing.audit().errors) == 0


def test_a_drawing_has_the_same_bytes_in_every_process():
    """Names are hashed anew in each, and the library puts a set of them into the file: once in two it was another."""
    code = (
        "import hashlib; from tests.surface.test_hand_off import dxf_bytes, handed; "
        "print(hashlib.sha256(dxf_bytes(handed())).hexdigest())"
    )
    digests = set()
    for seed in ("1", "2", "3", "4", "5"):
        done = subprocess.run(
            [sys.executable, "-c", code],
            env={**os.environ, "PYTHONHASHSEED": seed},
            cwd=Path(__file__).parents[2],
            capture_output=True,
            text=True,
            check=True,
        )
        digests.add(done.stdout)
    assert len(digests) == 1


def test_a_drawing_opens_where_the_trench_is():
    drawing = ezdxf.read(io.StringIO(dxf_bytes(handed()).decode("utf-8")))
    (view,) = drawing.viewports.get("*Active")
    assert (view.dxf.center.x, view.dxf.center.y) == pytest.approx((EAST, NORTH + 10))
    assert 20 < view.dxf.height < 30
