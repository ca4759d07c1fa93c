"""Text of a PDF that Chromium made, page by page: enough of the format to read what stands where, and no more."""

import re
import zlib


def pages_of(data):
    """The text of each page in its order, and the names of the images drawn on it.

    Glyphs are taken in the order in which they are drawn, without spaces: two-byte numbers, which the font's own table
    (ToUnicode) turns into characters.
    """
    objects = {int(m[1]): m[2] for m in re.finditer(rb"(?:^|\n)(\d+) 0 obj\s(.*?)\sendobj", data, re.S)}
    fonts = {}
    pages = []
    for number in _leaves(objects, _root(objects)):
        page = objects[number]
        names = dict(re.findall(rb"/(F\d+) (\d+) 0 R", _dictionary(page, b"Font")))
        images = dict(re.findall(rb"/(X\d+) (\d+) 0 R", _dictionary(page, b"XObject")))
        for target in names.values():
            fonts.setdefault(target, _characters(objects, int(target)))
        content = _stream(objects[int(re.search(rb"/Contents (\d+) 0 R", page)[1])])
        text, font = [], {}
        for token in re.finditer(rb"/(F\d+) [\d.]+ Tf|<([0-9A-Fa-f]+)> Tj", content):
            if token[1]:
                font = fonts[names[token[1]]]
            else:
                glyphs = [int(token[2][i : i + 4], 16) for i in range(0, len(token[2]), 4)]
                text += [font.get(glyph, "?") for glyph in glyphs]
        drawn = {images[name].decode() for name in re.findall(rb"/(X\d+) Do", content) if name in images}
        pages.append(("".join(text).replace(" ", "").replace("\xa0", ""), drawn))
    return pages


def _root(objects):
    return next(n for n, o in objects.items() if re.search(rb"/Type /Pages\b", o) and b"/Parent" not in o)


def _leaves(objects, number):
    """Page objects below a node of the tree, in order."""
    if not re.search(rb"/Type /Pages\b", objects[number]):
        return [number]
    kids = re.search(rb"/Kids \[(.*?)\]", objects[number], re.S)[1]
    return [leaf for kid in re.findall(rb"(\d+) 0 R", kids) for leaf in _leaves(objects, int(kid))]


def _dictionary(page, name):
    found = re.search(rb"/%s <<(.*?)>>" % name, page, re.S)
    return found[1] if found else b""


def _stream(body):
    raw = body[body.index(b"stream") + 6 : body.rindex(b"endstream")].lstrip(b"\r\n")
    return zlib.decompress(raw)


def _characters(objects, font):
    """Glyph number -> text."""
    table = re.search(rb"/ToUnicode (\d+) 0 R", objects[font])
    if not table:
        return {}
    found, content = {}, _stream(objects[int(table[1])])
    for block in re.findall(rb"beginbfchar(.*?)endbfchar", content, re.S):
        for glyph, text in re.findall(rb"<([0-9A-Fa-f]+)> <([0-9A-Fa-f]+)>", block):
            found[int(glyph, 16)] = bytes.fromhex(text.decode()).decode("utf-16-be")
    for block in re.findall(rb"beginbfrange(.*?)endbfrange", content, re.S):
        for first, last, text in re.findall(rb"<([0-9A-Fa-f]+)> <([0-9A-Fa-f]+)> <([0-9A-Fa-f]+)>", block):
            start = int(text, 16)
            for i in range(int(last, 16) - int(first, 16) + 1):
                found[int(first, 16) + i] = chr(start + i)
    return found
