"""Templates made into pages: the filters by which they print numbers, cells and verdicts."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import jinja2
from markupsafe import Markup, escape

from pipeline.report import numbers, palette
from pipeline.report.units import text_of
from pipeline.report.words import Words
from pipeline.resources import template_folder


def printed(template: str, page: Mapping[str, Any], pictures: Mapping[str, str], words: Words) -> str:
    """HTML of a template: `page` is everything it prints, `pictures` SVG by name; any other text is escaped."""
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(template_folder()),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters |= {"num": _num, "cell": _cell, "verdict": _verdict}
    style = Markup((template_folder() / "style.css").read_text(encoding="utf-8"))
    svg = {name: Markup(text) for name, text in pictures.items()}
    return environment.get_template(template).render(page=page, svg=svg, w=words, style=style)


def _num(value: numbers.Number, key: str) -> Markup:
    """A number with its unit; `key` is its path in report.json, by which tests read the page back."""
    shown = text_of(value["value"], value["digits"], value["signed"])
    unit = Markup(' <span class="unit">{}</span>').format(value["unit"]) if value["unit"] else Markup("")
    raw = "" if value["value"] is None else repr(value["value"])
    return Markup('<data class="number" data-key="{}" value="{}">{}</data>{}').format(key, raw, shown, unit)


def _cell(value: Any, column: dict[str, Any]) -> Markup:
    """The content of a table's cell."""
    if column["kind"] == "judged":
        return _verdict(value)
    if column["digits"] is None:
        return escape(value)
    return escape(text_of(value, column["digits"], column["signed"]))


def _verdict(word: str) -> Markup:
    """A verdict in symbol and word."""
    style = palette.verdict_style(word)
    return Markup('<span class="verdict {}"><span aria-hidden="true">{}</span> {}</span>').format(
        style.slug, style.symbol, style.word
    )
