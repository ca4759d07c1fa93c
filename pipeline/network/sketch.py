"""The graph of a network as a picture: plain SVG in the manner of the paper's Fig. 3.

Columns count how many links a node is from the world. Sightings are solid, poses from the files dotted, as in the
paper; what is not tied to the datum stands in the last column, in a broken frame.
"""

from __future__ import annotations

from collections import deque
from html import escape

from pipeline.network import frames as fr
from pipeline.network.graph import Graph, Link, Node, told

COLUMN, ROW, WIDTH, HEIGHT, MARGIN = 164, 62, 112, 38, 24
INK, PAPER, SEEN, LOST = "#1a1f24", "#ffffff", "#0b62a4", "#9a3f00"
FILLS = {
    "world": "#1a1f24",
    "static": "#e4e8ec",
    "moving": "#e4e8ec",
    "joint": "#e4e8ec",
    "camera": "#c5dcee",
    "marker": "#ffffff",
    "benchmark": "#ffffff",
    "sensor": "#f6d3ab",
}
CAPTIONS = {"moving": "moving body", "static": "static body", "joint": "joint"}
STROKES = {
    "mount": (INK, 'stroke-dasharray="1.5 4" stroke-linecap="round"'),
    "survey": (INK, 'stroke-dasharray="1.5 4" stroke-linecap="round"'),
    "joint": (INK, 'stroke-dasharray="9 4"'),
    "belt": (INK, 'stroke-dasharray="9 3 2 3"'),
    "reading": ("#9a3f00", ""),
    "seen": (SEEN, ""),
    "may see": (SEEN, 'stroke-dasharray="2 6" opacity="0.6"'),
}
LEGEND = (
    ("seen", "seen in pictures"),
    ("mount", "pose from the files"),
    ("joint", "joint"),
    ("belt", "belt"),
    ("reading", "read by a sensor"),
    ("may see", "could be seen"),
)


def svg_of(graph: Graph, title: str) -> str:
    """The picture, one SVG document; its description says in words what it shows."""
    place, width, height = _layout(graph)
    by_key = {node.key: node for node in graph.nodes}
    kinds = [(kind, words) for kind, words in LEGEND if any(link.kind == kind for link in graph.links)]
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" role="img" aria-labelledby="title desc" '
        f'viewBox="0 0 {max(width, 170 * len(kinds))} {height + 34}" '
        f'font-family="sans-serif" font-size="12" fill="{INK}">',
        f'<title id="title">{escape(title)}</title>',
        f'<desc id="desc">{escape(". ".join(told(graph)))}</desc>',
        f'<rect width="100%" height="100%" fill="{PAPER}"/>',
    ]
    parts += [_line(link, place) for link in graph.links]
    parts += [_label(link, place) for link in graph.links if link.count]
    parts += [_box(by_key[key], *at, key in _lost(graph)) for key, at in place.items()]
    for k, (kind, words) in enumerate(kinds):
        colour, dash = STROKES[kind]
        x, y = MARGIN + 165 * k, height + 14
        parts.append(f'<path d="M{x} {y}h34" stroke="{colour}" stroke-width="1.8" fill="none" {dash}/>')
        parts.append(f'<text x="{x + 42}" y="{y + 4}">{words}</text>')
    return "\n".join([*parts, "</svg>\n"])


def _steps(graph: Graph) -> dict[str, int]:
    """How many links each node is from the world; what none leads to is missing."""
    ways: dict[str, list[str]] = {}
    for link in graph.links:
        for a, b in (link.ends, link.ends[::-1]):
            ways.setdefault(a, []).append(b)
    steps = {fr.WORLD: 0}
    queue = deque([fr.WORLD])
    while queue:
        at = queue.popleft()
        for other in ways.get(at, []):
            if other not in steps:
                steps[other] = steps[at] + 1
                queue.append(other)
    return steps


def _lost(graph: Graph) -> set[str]:
    return {node.key for node in graph.nodes} - set(_steps(graph))


def _layout(graph: Graph) -> tuple[dict[str, tuple[float, float]], int, int]:
    """Centre of every node, and the size of the picture."""
    steps = _steps(graph)
    last = max(steps.values()) + 1
    columns: list[list[str]] = [[] for _ in range(last + 1)]
    for node in graph.nodes:
        columns[steps.get(node.key, last)].append(node.key)
    columns = [column for column in columns if column]
    ways: dict[str, list[str]] = {}
    for link in graph.links:
        for a, b in (link.ends, link.ends[::-1]):
            ways.setdefault(a, []).append(b)
    tallest = max(map(len, columns))
    height = tallest * ROW + 2 * MARGIN
    row: dict[str, float] = {}

    def spread(column):
        for k, key in enumerate(column):
            row[key] = (k + 0.5 - len(column) / 2) * tallest / len(column) ** 0.5 / max(tallest, 1) ** 0.5

    for column in columns:
        spread(column)
    # Each node to the middle of its neighbours, forth and back: few lines cross then.
    for _ in range(6):
        for column in (*columns, *columns[::-1]):
            middle = {}
            for key in column:
                near = [row[other] for other in ways.get(key, [])]
                middle[key] = sum(near) / len(near) if near else row[key]
            column.sort(key=lambda key: (middle[key], key))
            spread(column)
    place = {}
    for c, column in enumerate(columns):
        for key in column:
            place[key] = (MARGIN + WIDTH / 2 + c * COLUMN, height / 2 + row[key] * ROW)
    top = min(y for _, y in place.values()) - HEIGHT / 2 - MARGIN
    place = {key: (x, y - top) for key, (x, y) in place.items()}
    height = round(max(y for _, y in place.values()) + HEIGHT / 2 + MARGIN)
    return place, 2 * MARGIN + WIDTH + (len(columns) - 1) * COLUMN, height


def _line(link: Link, place) -> str:
    (x1, y1), (x2, y2) = (place[key] for key in link.ends)
    colour, dash = STROKES[link.kind]
    # Within a column a bow keeps the line off the nodes between; a belt runs beside its joint.
    bow = 146 if x1 == x2 else 0
    bow += 14 if link.kind == "belt" else 0
    middle = f"{(x1 + x2) / 2 + bow:.0f} {(y1 + y2) / 2 - (bow if x1 != x2 else 0):.0f}"
    way = f"M{x1:.0f} {y1:.0f}Q{middle} {x2:.0f} {y2:.0f}"
    return f'<path d="{way}" stroke="{colour}" stroke-width="1.8" fill="none" {dash}/>'


def _label(link: Link, place) -> str:
    (x1, y1), (x2, y2) = (place[key] for key in link.ends)
    if x1 == x2:
        x, y = x1 + 73, (y1 + y2) / 2
    else:  # off the middle, where the lines of two cameras to two markers cross
        x, y = x1 + 0.42 * (x2 - x1), y1 + 0.42 * (y2 - y1)
    words = f"{link.count:,}".replace(",", "\N{NARROW NO-BREAK SPACE}")
    return (
        f'<text x="{x:.0f}" y="{y + 4:.0f}" text-anchor="middle" font-size="10.5" stroke="{PAPER}" stroke-width="4" '
        f'paint-order="stroke">{words}</text>'
    )


def _box(node: Node, x: float, y: float, lost: bool) -> str:
    radius = {"world": 19, "camera": 19, "static": 7, "moving": 7, "joint": 7, "sensor": 19}.get(node.kind, 0)
    frame = f'stroke="{LOST}" stroke-dasharray="5 3"' if lost else f'stroke="{INK}"'
    ink = PAPER if node.kind == "world" else INK
    caption = CAPTIONS.get(node.kind, node.kind) + (", not tied" if lost else "")
    name = node.name if len(node.name) <= 16 else node.name[:15] + "\N{HORIZONTAL ELLIPSIS}"
    box = (
        f'<rect x="{x - WIDTH / 2:.0f}" y="{y - HEIGHT / 2:.0f}" width="{WIDTH}" height="{HEIGHT}" rx="{radius}" '
        f'fill="{FILLS[node.kind]}" stroke-width="1.5" {frame}/>'
    )
    if node.kind == "world":
        return box + f'<text x="{x:.0f}" y="{y + 4:.0f}" text-anchor="middle" fill="{ink}">world</text>'
    return (
        f'<g>{box}<text x="{x:.0f}" y="{y:.0f}" text-anchor="middle" font-weight="bold">{escape(name)}</text>'
        f'<text x="{x:.0f}" y="{y + 13:.0f}" text-anchor="middle" font-size="10">{caption}</text></g>'
    )
