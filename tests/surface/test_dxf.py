"""Drawings that ezdxf wrote, read by us; and drawings that nobody should trust."""

import math

import ezdxf
import numpy as np
import pytest
import shapely
from ezdxf.render import MeshBuilder

from pipeline.errors import SurfaceError
from pipeline.surface import dxf, dxf_faces
from pipeline.surface.dxf import check_drawing_unit, read_dxf
from pipeline.surface.plan_geometry import alignment_of

E, N = 512_000.0, 4_123_000.0
VERSIONS = ("R12", "R2000", "R2018")


def drawing(version="R2010", units=6):
    doc = ezdxf.new(version)
    doc.header["$INSUNITS"] = units
    doc.layers.add("Trench Floor")
    doc.layers.add("axis")
    return doc, doc.modelspace()


def saved(doc, tmp_path, name="design.dxf"):
    path = tmp_path / name
    doc.saveas(path)
    return path


def read(doc, tmp_path, layer="Trench Floor", line=None, **more):
    return read_dxf(saved(doc, tmp_path), layer, line, **more)


def plan_area(surface):
    a, b, c = (surface.points[surface.faces[:, i]] for i in range(3))
    normal = np.cross(b - a, c - a)
    return np.abs(normal[:, 2]).sum() / 2, np.linalg.norm(normal, axis=1).sum() / 2


def net():
    """Corners (4, 6, 3) of a rolling net of squares of 2 m."""
    y, x = np.mgrid[0:4, 0:6]
    return np.stack([E + 2 * x, N + 2.0 * y, 50 + 0.25 * x - 0.125 * y * y], axis=-1)


def quads():
    corners = net()
    return np.stack([corners[:-1, :-1], corners[:-1, 1:], corners[1:, 1:], corners[1:, :-1]], axis=2).reshape(
        -1, 4, 3
    )


def as_triangles(space):
    for a, b, c, d in quads():
        space.add_3dface([a, b, c, c], dxfattribs={"layer": "Trench Floor"})
        space.add_3dface([a, c, d], dxfattribs={"layer": "Trench Floor"})


def as_quads(space):
    for corners in quads():
        space.add_3dface(corners, dxfattribs={"layer": "Trench Floor"})


def as_polymesh(space):
    mesh = space.add_polymesh((4, 6), dxfattribs={"layer": "Trench Floor"})
    for (i, j), corner in zip(np.ndindex(4, 6), net().reshape(-1, 3), strict=True):
        mesh.set_mesh_vertex((i, j), corner)


def built():
    builder = MeshBuilder()
    for corners in quads():
        builder.add_face([tuple(map(float, corner)) for corner in corners])
    return builder


def as_polyface(space):
    built().render_polyface(space, dxfattribs={"layer": "Trench Floor"})


def as_mesh(space):
    built().render_mesh(space, dxfattribs={"layer": "Trench Floor"})


@pytest.mark.parametrize("version", VERSIONS)
@pytest.mark.parametrize("draw", [as_triangles, as_quads, as_polymesh, as_polyface, as_mesh])
def test_a_surface_is_the_same_however_its_faces_are_drawn(tmp_path, version, draw):
    if draw is as_mesh and version == "R12":
        version = "R2007"  # R12 knows no MESH
    doc, space = drawing(version)
    draw(space)
    surface = read(doc, tmp_path).surface
    assert (len(surface.points), len(surface.faces)) == (24, 30)
    assert plan_area(surface)[0] == pytest.approx(60.0, rel=1e-9)
    low, high = surface.points.min(axis=0), surface.points.max(axis=0)
    assert low == pytest.approx([E, N, 50 - 1.125], abs=1e-9)
    assert high == pytest.approx([E + 10, N + 6, 51.25], abs=1e-9)


def test_faces_that_were_drawn_apart_hang_together_and_empty_ones_go(tmp_path):
    doc, space = drawing()
    as_triangles(space)
    a = (E, N, 50.0)
    space.add_3dface([a, a, (E + 1, N, 50)], dxfattribs={"layer": "Trench Floor"})
    surface = read(doc, tmp_path).surface
    assert len(surface.faces) == 30
    edges = np.sort(surface.faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    _, count = np.unique(edges, axis=0, return_counts=True)
    assert sorted(set(count.tolist())) == [1, 2] and np.count_nonzero(count == 2) == (3 * 30 - 16) // 2


def test_vertical_walls_are_kept(tmp_path):
    doc, space = drawing()
    wall = [(E, N, 50), (E + 4, N, 50), (E + 4, N, 52), (E, N, 52)]
    space.add_3dface(wall, dxfattribs={"layer": "Trench Floor"})
    surface = read(doc, tmp_path).surface
    assert plan_area(surface) == pytest.approx((0.0, 8.0))


def test_layers_are_told_apart_but_not_by_case_and_hidden_faces_and_paper_are_left_out(tmp_path):
    doc, space = drawing()
    as_quads(space)
    space.add_3dface(quads()[0] + 100, dxfattribs={"layer": "ground"})
    space.add_3dface(quads()[0] + 100, dxfattribs={"layer": "Trench Floor", "invisible": 1})
    doc.layout("Layout1").add_3dface(quads()[0] + 100, dxfattribs={"layer": "Trench Floor"})
    surface = read(doc, tmp_path, "TRENCH floor").surface
    assert (len(surface.faces), surface.invisible) == (30, 1)


@pytest.mark.parametrize("version", ["R2000", "R2018"])
def test_names_of_layers_may_have_umlauts(tmp_path, version):
    doc, space = drawing(version)
    space.add_3dface(quads()[0], dxfattribs={"layer": "Kaivannon pöhjä"})
    assert len(read(doc, tmp_path, "kaivannon PÖHJÄ").surface.faces) == 2


def axis_of(doc, tmp_path, start_station=0.0):
    """The alignment on the layer `axis`, with a face for company."""
    doc.modelspace().add_3dface(quads()[0], dxfattribs={"layer": "Trench Floor"})
    found = read(doc, tmp_path, line="axis", start_station=start_station)
    return alignment_of(found.alignment, found.source, 1.0)


def finely_drawn(*entities):
    """What ezdxf makes of lines and arcs, cut fine, in plan."""
    lines = []
    for entity in entities:
        if entity.dxftype() == "ARC":
            lines.append([(p.x, p.y) for p in entity.flattening(1e-6)])
        else:
            lines.append([(p.x, p.y) for p in (entity.dxf.start, entity.dxf.end)])
    return shapely.MultiLineString(lines)


BULGED = [
    (E, N, 0.0),
    (E + 20, N, 0.4),
    (E + 30, N + 10, -0.25),
    (E + 50, N + 12, 1.2),
    (E + 50, N + 30, 0.0),
    (E, N + 60, 0),
]


@pytest.mark.parametrize("kind", ["lwpolyline", "polyline2d"])
@pytest.mark.parametrize("mirrored", [False, True])
def test_bulges_are_the_arcs_that_ezdxf_draws(tmp_path, kind, mirrored):
    doc, space = drawing()
    more = {"layer": "axis", "extrusion": (0, 0, -1)} if mirrored else {"layer": "axis"}
    points = [(-x if mirrored else x, y, b) for x, y, b in BULGED]
    add = space.add_lwpolyline if kind == "lwpolyline" else space.add_polyline2d
    line = add(points, format="xyb", dxfattribs=more)
    fine = finely_drawn(*line.virtual_entities())
    alignment = axis_of(doc, tmp_path, start_station=250.0)
    assert alignment.start_station == 250.0
    assert alignment.points(250.0, 0.0) == pytest.approx([E, N])
    station = np.linspace(250.0, alignment.end_station, 2000)
    assert shapely.distance(fine, shapely.points(alignment.points(station, 0.0))).max() < 2e-6
    assert alignment.length == pytest.approx(fine.length, abs=1e-3)
    assert np.count_nonzero(alignment.turn) == 3


def test_a_3d_polyline_is_a_line_in_plan_and_points_drawn_twice_are_one(tmp_path):
    doc, space = drawing()
    points = [(E, N, 50), (E + 3, N + 4, 49), (E + 3, N + 4, 48), (E + 3, N + 10, 48)]
    space.add_polyline3d(points, dxfattribs={"layer": "axis"})
    alignment = axis_of(doc, tmp_path)
    assert alignment.station.tolist() == pytest.approx([0, 5, 11])


@pytest.mark.parametrize("turned", [False, True])
def test_lines_and_arcs_in_any_order_are_joined_in_the_direction_they_are_drawn(tmp_path, turned):
    doc, space = drawing()
    arc = space.add_arc((E + 20, N + 10), 10, 270, 360, dxfattribs={"layer": "axis"})
    lines = [((E, N), (E + 20, N)), ((E + 30, N + 10), (E + 30, N + 40))]
    for a, b in reversed(lines):
        space.add_line(*((b, a) if turned else (a, b)), dxfattribs={"layer": "axis"})
    alignment = axis_of(doc, tmp_path)
    assert alignment.length == pytest.approx(20 + 5 * math.pi + 30)
    ends = alignment.points([0.0, alignment.length], 0.0)
    wanted = [[E, N], [E + 30, N + 40]]
    assert ends == pytest.approx(np.array(wanted[::-1] if turned else wanted))
    middle = alignment.points(0.5 * (alignment.station[1] + alignment.station[2]), 0.0)
    assert middle == pytest.approx(
        [arc.dxf.center.x + 10 * math.sqrt(0.5), arc.dxf.center.y - 10 * math.sqrt(0.5)]
    )


def test_an_arc_seen_from_below_is_where_ezdxf_draws_it(tmp_path):
    doc, space = drawing()
    arc = space.add_arc((-E, N), 10, 20, 100, dxfattribs={"layer": "axis", "extrusion": (0, 0, -1)})
    drawn = finely_drawn(arc)
    alignment = axis_of(doc, tmp_path)
    at = alignment.points(np.linspace(0, alignment.length, 50), 0.0)
    assert shapely.distance(drawn, shapely.points(at)).max() < 2e-6
    assert alignment.length == pytest.approx(10 * math.radians(80))


def closed(space):
    space.add_lwpolyline([(E, N), (E + 1, N), (E, N + 1)], close=True, dxfattribs={"layer": "axis"})


def spline(space):
    space.add_spline([(E, N), (E + 1, N), (E, N + 1)], dxfattribs={"layer": "axis"})


def apart(space):
    for shift in (0, 50):
        space.add_line((E, N + shift), (E + 9, N + shift), dxfattribs={"layer": "axis"})


def forked(space):
    for end in ((9, 0), (0, 9), (-9, -9)):
        space.add_line((E, N), (E + end[0], N + end[1]), dxfattribs={"layer": "axis"})


def against(space):
    space.add_line((E, N), (E + 9, N), dxfattribs={"layer": "axis"})
    space.add_line((E + 20, N), (E + 9, N), dxfattribs={"layer": "axis"})


def slanting(space):
    space.add_lwpolyline([(E, N), (E + 1, N)], dxfattribs={"layer": "axis", "extrusion": (0, 1, 1)})


def words(space):
    space.add_text("0+100", dxfattribs={"layer": "axis"})


@pytest.mark.parametrize(
    "draw, sentence",
    [
        (closed, "has a closed polyline"),
        (spline, "has a SPLINE; convert it"),
        (apart, "its 2 lines are not one line with two ends; join the pieces"),
        (forked, r"more than two lines meet at E 512000\.00 N 4123000\.00"),
        (against, "drawn in different directions"),
        (slanting, "a LWPOLYLINE is drawn in a slanting plane"),
        (words, "has no lines, arcs or polylines; it holds 1 TEXT; mend design.alignment_layer"),
        (lambda space: None, "has no lines, arcs or polylines; there are entities on 'trench floor'"),
    ],
)
def test_lines_that_are_no_alignment_are_refused_with_the_way_out(tmp_path, draw, sentence):
    doc, space = drawing()
    draw(space)
    with pytest.raises(SurfaceError, match=sentence):
        axis_of(doc, tmp_path)


def test_what_a_layer_holds_instead_of_faces_is_said(tmp_path):
    doc, space = drawing()
    as_quads(space)
    space.add_line((0, 0), (1, 1), dxfattribs={"layer": "break"})
    block = doc.blocks.new("tin")
    block.add_3dface(quads()[0], dxfattribs={"layer": "hidden"})
    space.add_blockref("tin", (0, 0), dxfattribs={"layer": "0"})
    path = saved(doc, tmp_path)
    with pytest.raises(SurfaceError, match=r"layer 'break' has no faces .* it holds 1 LINE; export"):
        read_dxf(path, "break", None)
    with pytest.raises(
        SurfaceError, match=r"layer 'hidden' has no faces .* stands inside blocks: explode them"
    ):
        read_dxf(path, "hidden", None)
    with pytest.raises(
        SurfaceError, match=r"layer 'x' has no faces .* entities on '0', 'break', 'trench floor'"
    ):
        read_dxf(path, "x", None)


def test_a_smoothed_mesh_and_a_face_of_five_corners_are_refused(tmp_path):
    doc, space = drawing()
    as_mesh(space)
    space.query("MESH").first.dxf.subdivision_levels = 2
    with pytest.raises(SurfaceError, match="a MESH is smoothed"):
        read(doc, tmp_path)
    doc, space = drawing()
    builder = MeshBuilder()
    builder.add_face([(0, 0, 0), (2, 0, 0), (3, 1, 0), (1, 3, 0), (0, 1, 0)])
    builder.render_mesh(space, dxfattribs={"layer": "Trench Floor"})
    with pytest.raises(SurfaceError, match="a face of a MESH has 5 corners"):
        read(doc, tmp_path)


@pytest.mark.parametrize(
    "code, said, grid, sentence",
    [
        (6, None, "m", None),
        (6, "m", "m", None),
        (2, None, "international_foot", None),
        (21, None, "us_survey_foot", None),
        (0, "us_survey_foot", "us_survey_foot", None),
        (0, None, "m", r'does not say its unit \(\$INSUNITS is 0\); .* write unit = "m" under \[design\]'),
        (0, "m", "us_survey_foot", "design.unit in site.toml is 'm', but grid.unit is 'us_survey_foot'"),
        (6, "us_survey_foot", "us_survey_foot", r"its unit is m \(\$INSUNITS 6\), but grid.unit"),
        (2, None, "us_survey_foot", r"international_foot \(\$INSUNITS 2\)"),
        (4, None, "m", r"its unit is millimetres \(\$INSUNITS 4\)"),
        (18, "m", "m", r"its unit is another one \(\$INSUNITS 18\)"),
    ],
)  # fmt: skip
def test_the_unit_is_the_grids_or_refused(tmp_path, code, said, grid, sentence):
    doc, space = drawing(units=code)
    as_quads(space)
    found = read(doc, tmp_path)
    assert found.unit_code == code
    if sentence is None:
        check_drawing_unit(found, said, grid)
    else:
        with pytest.raises(SurfaceError, match=sentence):
            check_drawing_unit(found, said, grid)


FACE = "0\n3DFACE\n8\nf\n10\n0\n20\n0\n30\n1\n11\n9\n21\n0\n31\n1\n12\n0\n22\n9\n32\n1\n13\n0\n23\n9\n33\n1\n"


def entities(body, end="0\nENDSEC\n0\nEOF\n"):
    return f"0\nSECTION\n2\nENTITIES\n{body}{end}"


def test_the_smallest_drawing_is_read_and_says_no_unit(tmp_path):
    path = tmp_path / "d.dxf"
    for text in (
        entities(FACE),
        entities(FACE).replace("\n", "\r\n"),
        "999\nmade by hand\n" + entities(FACE) + "\x1a",
    ):
        path.write_bytes(text.encode())
        found = read_dxf(path, "f", None)
        assert len(found.surface.faces) == 1 and found.unit_code == 0


@pytest.mark.parametrize(
    "data, sentence",
    [
        (b"", "is empty"),
        (b" \n\n", "is empty"),
        (b"AutoCAD Binary DXF\r\n\x1a\x00\x00\x00SECTION", "is a binary DXF: save it as a text"),
        (b"AC1032\x00\x00\x00", "is a DWG: save it as a DXF"),
        (b"PK\x03\x04 a zip", "d.dxf:1: expected a group code of a DXF, found 'PK"),
        (b"<LandXML/>\n", "d.dxf:1: expected a group code"),
        (b"0\nSECTION\n2\nHEADER\n9\n$INSUNITS\n70\nmetres\n", r"\$INSUNITS is 'metres', no number"),
        (entities(FACE, "").encode(), "ends in the middle"),
        (entities("0\nLINE\n8\nf\nten\n0\n").encode(), "d.dxf:9: expected a group code of a DXF, found 'ten'"),
        (entities(FACE.replace("10\n0", "10\nnan")).encode(), "a 3DFACE: expected a number, found 'nan'"),
        (entities(FACE.replace("10\n0\n", "")).encode(), "a 3DFACE without its corners"),
        (entities(FACE.replace("9", "0")).encode(), "all its faces are without extent"),
        (entities("0\nMESH\n8\nf\n92\n1\n10\n0\n20\n0\n30\n0\n93\n4\n90\n3\n90\n0\n90\n1\n90\n7\n").encode(),
         "names a point that is not there"),
        (entities("0\nMESH\n8\nf\n92\n0\n93\n1\n90\n999999999\n").encode(), "a face of a MESH has 0 corners"),
        (entities("0\nPOLYLINE\n8\nf\n70\n16\n71\n3\n72\n3\n0\nVERTEX\n10\n0\n20\n0\n0\nSEQEND\n").encode(),
         "a mesh of 3 by 3 points has 1 of them"),
        (entities("0\nPOLYLINE\n8\nf\n70\n64\n0\nVERTEX\n70\n128\n71\n1\n72\n2\n73\n3\n0\nSEQEND\n").encode(),
         "a face of a polyface names a point that is not there"),
        (b"\x00" * 1000, "expected a group code"),
        (bytes(range(256)) * 50, "expected a group code"),
    ],
)  # fmt: skip
def test_what_is_no_drawing_or_may_be_hostile_is_refused_in_one_sentence(tmp_path, data, sentence):
    path = tmp_path / "d.dxf"
    path.write_bytes(data)
    with pytest.raises(SurfaceError, match=sentence) as caught:
        read_dxf(path, "f", None)
    assert "\n" not in str(caught.value)


def test_a_missing_file_is_one_sentence(tmp_path):
    with pytest.raises(SurfaceError, match=r"no.dxf: cannot be read .* beside site.toml"):
        read_dxf(tmp_path / "no.dxf", "f", None)


def test_bounds_on_size_and_counts(tmp_path, monkeypatch):
    doc, space = drawing()
    as_mesh(space)
    as_polyface(space)
    space.add_lwpolyline([(0, 0), (1, 1)], dxfattribs={"layer": "axis"})
    space.add_line((0, 0), (1, 1), dxfattribs={"layer": "axis"})
    path = saved(doc, tmp_path)
    for module, bound, sentence in (
        (dxf, "MAX_BYTES", "are read"),
        (dxf, "MAX_TAGS", "of more than 1 v"),
        (dxf, "MAX_LINES", "has more than 1 lines"),
        (dxf_faces, "MAX_FACES", "more than 1 faces"),
    ):
        with monkeypatch.context() as patch:
            patch.setattr(module, bound, 1)
            with pytest.raises(SurfaceError, match=sentence):
                read_dxf(path, "Trench Floor", "axis")


def test_nothing_that_a_drawing_names_is_opened(tmp_path, monkeypatch):
    doc, space = drawing()
    as_quads(space)
    doc.add_xref_def("secret.dxf", "other")
    space.add_blockref("other", (0, 0), dxfattribs={"layer": "Trench Floor"})
    image = doc.add_image_def("secret.png", (10, 10))
    space.add_image(image, (0, 0), (1, 1), dxfattribs={"layer": "Trench Floor"})
    path = saved(doc, tmp_path)
    opened = []
    plain = type(path).open

    def watched(self, *args, **kwargs):
        opened.append(self.name)
        return plain(self, *args, **kwargs)

    monkeypatch.setattr(type(path), "open", watched)
    monkeypatch.setattr("builtins.open", lambda *a, **k: pytest.fail("a file was opened"))
    assert len(read_dxf(path, "Trench Floor", None).surface.faces) == 30
    assert opened == ["design.dxf"]
