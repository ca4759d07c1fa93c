"""Colours and symbols of the page: blue to orange, never red to green, and never a colour alone.

`CONTRASTS` lists every pair of text and ground that the page uses; a test computes their ratio.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

INK = "#1a1f24"
MUTED = "#4d565f"
PAPER = "#ffffff"
WASH = "#f3f5f7"
RULE = "#c3cad1"
LINK = "#0b4f8a"
DESIGN = "#1a1f24"
AS_BUILT = "#0b62a4"
RIBBON = "#9cc3e0"
BAND = "#e4e8ec"
CHECK = "#9a3f00"
ACCENTS = ("#0b62a4", "#b85300", "#5c6670", "#3f86bd", "#a8631c", "#2f3b46", "#6d8399")
"""For parts of a whole (sources, reasons), in the order they are drawn; each is named beside its mark too."""

# Low (over-dug) is blue, high (under-dug) is orange; lightness falls to both sides alike, so the scale
# survives grey printing as "how far" and colour vision of any kind as "which way".
LOW_TO_HIGH = (
    "#08335c",
    "#0b62a4",
    "#6aa6d6",
    "#c5dcee",
    "#f4f3ef",
    "#f6d3ab",
    "#e59a4b",
    "#b85300",
    "#6b2f00",
)
DETECTED = "#ffffff"
PREDICTED = "#f2a95c"
"""Lines on a picture lie on a wider one of INK, so that they show on bright and on dark ground."""
NEVER_TOUCHED = "#ffffff"
PASSED_OVER = "#c9ced3"


@dataclass(frozen=True)
class VerdictStyle:
    """How a verdict is shown: a word, a symbol and two colours."""

    word: str
    symbol: str
    slug: str
    """Name of its class in the style sheet."""
    ink: str
    """Colour on the page's white."""
    marker: str
    """Marker in figures, by matplotlib's name."""


VERDICTS = {
    "PASS": VerdictStyle("PASS", "\N{CHECK MARK}", "pass", "#0b4f8a", "o"),
    "FAIL": VerdictStyle("FAIL", "\N{MULTIPLICATION X}", "fail", "#9a3f00", "X"),
    "CANNOT TELL": VerdictStyle("CANNOT TELL", "?", "cannot-tell", "#5b4a00", "s"),
    "NOT REACHED": VerdictStyle("NOT REACHED", "\N{EN DASH}", "not-reached", "#4d565f", "_"),
}
UTILITY_VERDICTS = {
    "STRIKE LIKELY": VerdictStyle("STRIKE LIKELY", "\N{HEAVY MULTIPLICATION X}", "fail", "#9a3f00", "X"),
    "STRIKE POSSIBLE": VerdictStyle("STRIKE POSSIBLE", "!", "fail", "#9a3f00", "D"),
    "NEAR MISS": VerdictStyle("NEAR MISS", "\N{WHITE UP-POINTING TRIANGLE}", "cannot-tell", "#5b4a00", "^"),
    "CLEAR WHILE SEEN": VerdictStyle("CLEAR WHILE SEEN", "?", "cannot-tell", "#5b4a00", "s"),
    "CLEAR": VerdictStyle("CLEAR", "\N{CHECK MARK}", "pass", "#0b4f8a", "o"),
    "NOT APPROACHED": VerdictStyle("NOT APPROACHED", "\N{EN DASH}", "not-reached", "#4d565f", "_"),
}
"""Of buried utilities; colours and classes are those of the verdicts above."""
UNKNOWN_VERDICT = VerdictStyle("NO VERDICT", "!", "no-verdict", "#4d565f", "D")

CONTRASTS = (
    ("text on paper", INK, PAPER),
    ("text on wash", INK, WASH),
    ("muted text on paper", MUTED, PAPER),
    ("muted text on wash", MUTED, WASH),
    ("link on paper", LINK, PAPER),
    ("link on wash", LINK, WASH),
    *((f"white on {v.word}", PAPER, v.ink) for v in (*VERDICTS.values(), UNKNOWN_VERDICT)),
    *((f"{v.word} on paper", v.ink, PAPER) for v in (*VERDICTS.values(), UNKNOWN_VERDICT)),
    *((f"{v.word} on wash", v.ink, WASH) for v in (*VERDICTS.values(), UNKNOWN_VERDICT)),
    ("check shots on paper", CHECK, PAPER),
)
"""Name, foreground, background of every pair that carries text; WCAG 2 asks for 4.5."""

MARKS = (
    *(
        (f"as-built line on {n}", AS_BUILT, c)
        for n, c in (("paper", PAPER), ("band", BAND), ("ribbon", RIBBON))
    ),
    *((f"check shot on {n}", CHECK, c) for n, c in (("paper", PAPER), ("band", BAND), ("ribbon", RIBBON))),
    *((f"design line on {n}", DESIGN, c) for n, c in (("paper", PAPER), ("band", BAND), ("ribbon", RIBBON))),
    *((f"thin line on {n}", MUTED, c) for n, c in (("paper", PAPER), ("band", BAND), ("ribbon", RIBBON))),
    *((f"accent {i}", colour, PAPER) for i, colour in enumerate(ACCENTS)),
    ("tags per frame where the edge was bridged", AS_BUILT, PASSED_OVER),
    ("hatching", INK, RIBBON),
    ("detected tag on its dark line", DETECTED, INK),
    ("predicted corner on its dark line", PREDICTED, INK),
    ("dark line on a bright picture", INK, PAPER),
)
"""Pairs that carry meaning without text; WCAG 2 asks for 3."""

GROUNDS = (PAPER, WASH, BAND, RIBBON, PASSED_OVER, NEVER_TOUCHED, RULE)
"""Areas and rules that something else outlines or names: never the only carrier of a meaning."""


def verdict_style(word: str) -> VerdictStyle:
    """How `word` is shown; a word that is not known here keeps its own spelling."""
    known = (VERDICTS | UTILITY_VERDICTS).get(word.upper())
    return known or VerdictStyle(word or UNKNOWN_VERDICT.word, *list(vars(UNKNOWN_VERDICT).values())[1:])


def contrast(foreground: str, background: str) -> float:
    """Contrast ratio of two ``#rrggbb`` colours as WCAG 2 defines it, 1 to 21."""
    light, dark = sorted((_luminance(foreground), _luminance(background)), reverse=True)
    return (light + 0.05) / (dark + 0.05)


def _luminance(colour: str) -> float:
    channels = np.array([int(colour[i : i + 2], 16) / 255 for i in (1, 3, 5)])
    linear = np.where(channels <= 0.04045, channels / 12.92, ((channels + 0.055) / 1.055) ** 2.4)
    return float(linear @ np.array([0.2126, 0.7152, 0.0722]))
