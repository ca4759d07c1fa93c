"""The graph of a network: what it draws, which loops it finds, and what it names as not tied."""

import dataclasses
import xml.etree.ElementTree as ET

import numpy as np
import pytest

from pipeline.network.graph import graph_of, told
from pipeline.network.sketch import svg_of
from tests.network.drawing import FOLDER, draw
from tests.network.pictures import picture_of
from tests.network.test_networks import SCENES

SVG = "{http://www.w3.org/2000/svg}"


def _scene(name, epochs=5):
    scene = next(s for s in SCENES if s.name == name)
    return dataclasses.replace(scene, epochs=epochs)


def _graph(name, epochs=5):
    drawn = draw(_scene(name, epochs), 1)
    return graph_of(drawn.network, drawn.observations, drawn.readings)


@pytest.mark.parametrize("scene", SCENES, ids=lambda s: f"{s.name}-geared" if s.replaced else s.name)
def test_every_node_of_every_network_is_drawn_once_and_described(scene):
    drawn = draw(dataclasses.replace(scene, epochs=3), 1)
    graph = graph_of(drawn.network, drawn.observations, drawn.readings)
    picture = ET.fromstring(svg_of(graph, "Cab & stick"))
    words = [text.text for text in picture.iter(f"{SVG}text")]
    for node in graph.nodes:
        assert words.count(node.name) == 1
    assert picture.find(f"{SVG}title").text == "Cab & stick"
    assert picture.find(f"{SVG}desc").text == ". ".join(told(graph))
    assert len(picture.findall(f"{SVG}path")) >= len(graph.links)
    assert not graph.untied


@pytest.mark.parametrize("name", sorted({s.name for s in SCENES}))
def test_the_pictures_of_the_docs_show_these_networks(name):
    assert (FOLDER / f"{name}.svg").read_text() == picture_of(name), "run python -m tests.network.pictures"


def test_boxes_do_not_overlap():
    for scene in SCENES:
        drawn = draw(dataclasses.replace(scene, epochs=3), 1)
        picture = ET.fromstring(svg_of(graph_of(drawn.network, drawn.observations, drawn.readings), "t"))
        boxes = [
            [float(r.get(k)) for k in ("x", "y", "width", "height")]
            for r in picture.iter(f"{SVG}rect")
            if r.get("x")
        ]
        for k, (x, y, w, h) in enumerate(boxes):
            for x2, y2, *_ in boxes[:k]:
                assert abs(x - x2) >= w or abs(y - y2) >= h


def test_the_loops_are_as_many_as_links_beyond_a_tree():
    """Fig. 3 by hand: 9 nodes and world, 17 links, one piece; so 17 - 10 + 1 loops."""
    graph = _graph("third-camera")
    solid = [link for link in graph.links if link.kind != "reading"]
    assert (len(graph.nodes), len(solid)) == (10, 18)
    assert len(graph.loops) == len(solid) - len(graph.nodes) + 1
    neighbours = {frozenset(link.ends) for link in solid}
    for loop in graph.loops:
        for a, b in zip(loop, (*loop[1:], loop[0]), strict=True):
            assert frozenset((a, b)) in neighbours
        assert len(set(loop)) == len(loop)


def test_the_simplest_network_has_no_loop_and_eight_coordinates_a_tag_for_six_of_the_pose():
    graph = _graph("one-camera", epochs=4)
    assert graph.loops == () and (graph.measured, graph.unknown) == (4 * 3 * 8, 4 * 6)


def test_a_chain_that_only_sees_itself_is_named_and_drawn_broken():
    drawn = draw(_scene("cluster"), 1)
    seen = drawn.observations
    benchmarks = [k for k, m in enumerate(drawn.network.markers) if m.benchmark]
    alone = seen.take(~np.isin(drawn.network.tag_marker[seen.tag], benchmarks))
    graph = graph_of(drawn.network, alone, drawn.readings)
    assert any("'cab', 'stick' see each other but are not tied to the datum" in s for s in graph.untied)
    words = [t.text for t in ET.fromstring(svg_of(graph, "t")).iter(f"{SVG}text")]
    assert words.count("moving body, not tied") == 2
    assert told(graph)[-1].startswith("! bodies 'cab', 'stick'")


def test_a_time_without_pictures_is_named_with_its_span():
    scene = dataclasses.replace(
        _scene("cluster", 150), hidden=dict.fromkeys(("B1", "B2", "B3"), ((10.0, 22.0),))
    )
    drawn = draw(scene, 1)
    graph = graph_of(drawn.network, drawn.observations, drawn.readings)
    (sentence,) = graph.untied
    assert "body 'cab'" in sentence and "from 9.8 to 22.0 s" in sentence


def test_without_a_log_every_camera_may_see_what_does_not_ride_with_it():
    drawn = draw(_scene("full-chain", 1), 1)
    graph = graph_of(drawn.network)
    pairs = [link.ends for link in graph.links if link.kind == "may see"]
    assert len(pairs) == 3 * 7  # no marker rides on the cab itself
    assert graph.loops == () and told(graph)[-1] == "everything can be tied to the datum"
