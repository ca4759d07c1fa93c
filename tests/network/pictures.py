"""The drawings of docs/networks.md: ``python -m tests.network.pictures`` makes them anew."""

from pipeline.network.graph import graph_of
from pipeline.network.sketch import svg_of
from tests.network.drawing import FOLDER, draw
from tests.network.test_networks import SCENES


def picture_of(name: str) -> str:
    """SVG of one network of the docs, as thirty seconds of its scene show it."""
    drawn = draw(next(s for s in SCENES if s.name == name), 1)
    return svg_of(graph_of(drawn.network, drawn.observations, drawn.readings), f"The network {name}")


if __name__ == "__main__":
    for name in sorted({scene.name for scene in SCENES}):
        (FOLDER / f"{name}.svg").write_text(picture_of(name))
