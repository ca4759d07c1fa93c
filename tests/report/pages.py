"""Reads a page back the way a strict stranger would: nesting, ids, labels, and the numbers that stand on it."""

import re
from html.parser import HTMLParser

VOID = {"meta", "br", "link", "img", "hr", "input", "col", "area", "base", "source", "wbr", "embed", "track"}


class PageReader(HTMLParser):
    """Collects what the tests ask of a page; `faults` is empty for a sound one."""

    def __init__(self, html):
        super().__init__(convert_charrefs=True)
        self.faults, self.open, self.ids, self.tags = [], [], [], []
        self.numbers, self.tables, self.headings, self.references = {}, {}, [], []
        self._capture, self._text, self._table, self._row = None, [], None, None
        self.feed(html)
        self.close()
        self.faults += [f"{tag} is never closed" for tag in self.open]

    def handle_starttag(self, tag, attrs):
        names = [name for name, _ in attrs]
        if len(set(names)) != len(names):
            self.faults.append(f"{tag} has an attribute twice: {names}")
        found = dict(attrs)
        self.tags.append((tag, found))
        if tag not in VOID:
            self.open.append(tag)
        if "id" in found:
            self.ids.append(found["id"])
        for name in ("src", "href", "xlink:href", "data", "action", "srcset", "poster"):
            if name in found:
                self.references.append(found[name])
        if tag in ("h1", "h2", "h3", "h4"):
            self.headings.append(int(tag[1]))
        if tag == "data":
            self._begin(("number", found["data-key"], found["value"]))
        elif tag == "table":
            self._table = self.tables.setdefault(found["data-key"], [])
        elif tag == "tr" and self._table is not None:
            self._row = []
        elif tag in ("th", "td") and self._row is not None:
            self._begin(("cell",))

    def handle_startendtag(self, tag, attrs):
        self.handle_starttag(tag, attrs)
        if tag not in VOID:
            self.open.pop()

    def handle_endtag(self, tag):
        if tag in VOID:
            return
        if not self.open or self.open[-1] != tag:
            self.faults.append(f"</{tag}> closes {self.open[-1:]} at {self.getpos()}")
            if tag in self.open:
                while self.open and self.open.pop() != tag:
                    pass
        else:
            self.open.pop()
        if tag == "data" and self._capture:
            _, key, raw = self._capture
            self.numbers[key] = (raw, self._end())
        elif tag in ("th", "td") and self._capture:
            self._row.append(self._end())
        elif tag == "tr" and self._row is not None:
            self._table.append(self._row)
            self._row = None
        elif tag == "table":
            self._table = None

    def handle_data(self, data):
        if self._capture:
            self._text.append(data)

    def _begin(self, what):
        self._capture, self._text = what, []

    def _end(self):
        self._capture = None
        return " ".join(re.split(r"[ \t\n]+", "".join(self._text).strip(" \t\n")))


def at_path(content, path):
    """The entry of report.json at a dotted path."""
    for part in path.split("."):
        content = content[int(part)] if isinstance(content, list) else content[part]
    return content


def as_float(text):
    """A number as printed -> float; None for a dash."""
    text = text.replace("\u2212", "-").replace("\u202f", "")
    return None if text == "\u2013" else float(text)
