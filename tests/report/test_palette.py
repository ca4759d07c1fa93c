"""Every pair of colours can be read, and the scale of deviations survives colour blindness and grey printing."""

import re
from pathlib import Path

import numpy as np
import pytest

from pipeline.report import palette
from pipeline.resources import template_folder

# Machado, Oliveira and Fernandes 2009, full severity; rows give linear R, G, B as such an eye has them.
BLINDNESS = {
    "protan": [
        [0.152286, 1.052583, -0.204868],
        [0.114503, 0.786281, 0.099216],
        [-0.003882, -0.048116, 1.051998],
    ],
    "deutan": [
        [0.367322, 0.860646, -0.227968],
        [0.280085, 0.672501, 0.047413],
        [-0.011820, 0.042940, 0.968881],
    ],
    "tritan": [
        [1.255528, -0.076749, -0.178779],
        [-0.078411, 0.930809, 0.147602],
        [0.004733, 0.691367, 0.303900],
    ],
}


@pytest.mark.parametrize("name, ink, ground", palette.CONTRASTS)
def test_text_has_the_contrast_that_wcag_asks_for(name, ink, ground):
    assert palette.contrast(ink, ground) >= 4.5, name


@pytest.mark.parametrize("name, ink, ground", palette.MARKS)
def test_marks_have_the_contrast_that_wcag_asks_for(name, ink, ground):
    assert palette.contrast(ink, ground) >= 3.0, name


def test_contrast_is_that_of_the_standard():
    assert palette.contrast("#000000", "#ffffff") == pytest.approx(21.0)
    assert palette.contrast("#777777", "#ffffff") == pytest.approx(4.48, abs=0.005)


def test_the_style_sheet_uses_no_colour_that_is_not_tested():
    tested = {colour for _, *pair in palette.CONTRASTS for colour in pair}
    css = (template_folder() / "style.css").read_text(encoding="utf-8")
    used = {word.lower() for word in re.findall(r"#[0-9a-fA-F]{6}\b", css)}
    lines = {palette.RULE, "#e1e5e9"}  # thin rules between cells carry no meaning
    assert used <= tested | lines


def colours_of(value):
    """Every colour in a constant of the palette."""
    if isinstance(value, str):
        return {value} if value.startswith("#") else set()
    if isinstance(value, palette.VerdictStyle):
        return {value.ink}
    if isinstance(value, dict):
        return set().union(*map(colours_of, value.values()))
    return set().union(*map(colours_of, value)) if isinstance(value, tuple) else set()


def test_no_figure_uses_a_colour_whose_contrast_is_not_tested():
    """What figures name of the palette is in a tested pair, or only a ground, or the scale of deviations."""
    tested = {colour for _, *pair in (*palette.CONTRASTS, *palette.MARKS) for colour in pair}
    allowed = tested | set(palette.GROUNDS) | set(palette.LOW_TO_HIGH)
    sources = sorted((Path(palette.__file__).parent).glob("*.py"))
    named = {name for file in sources for name in re.findall(r"palette\.([A-Z_]+)\b", file.read_text())}
    assert {"AS_BUILT", "CHECK", "ACCENTS", "PREDICTED"} <= named
    for name in sorted(named):
        assert colours_of(getattr(palette, name)) <= allowed, name


def test_no_figure_writes_a_colour_of_its_own():
    """But for the grid behind everything, which carries nothing."""
    found = {
        (file.name, colour)
        for file in Path(palette.__file__).parent.glob("*.py")
        if file.name != "palette.py"
        for colour in re.findall(r"#[0-9a-fA-F]{6}\b", file.read_text())
    }
    assert found == {("drawing.py", "#e1e5e9")}


def test_the_style_sheet_and_the_palette_agree():
    """A verdict has one colour on the page and in figures."""
    css = (template_folder() / "style.css").read_text(encoding="utf-8")
    for style in (*palette.VERDICTS.values(), palette.UNKNOWN_VERDICT):
        assert f"--{style.slug}: {style.ink};" in css
    for name, colour in (("ink", palette.INK), ("muted", palette.MUTED), ("link", palette.LINK)):
        assert f"--{name}: {colour};" in css


@pytest.mark.parametrize("eye", BLINDNESS)
def test_high_and_low_differ_for_every_eye(eye):
    """Low and high of the same size must differ by far more than neighbouring steps of one side."""
    colours = np.array([[int(c[i : i + 2], 16) / 255 for i in (1, 3, 5)] for c in palette.LOW_TO_HIGH])
    linear = np.where(colours <= 0.04045, colours / 12.92, ((colours + 0.055) / 1.055) ** 2.4)
    seen = np.clip(linear @ np.array(BLINDNESS[eye]).T, 0, 1)
    lab = _lab(seen)
    for step in range(1, 4):
        assert np.linalg.norm(lab[step] - lab[-1 - step]) > 25, (eye, step)


def test_the_scale_darkens_to_both_sides():
    light = _lab(_linear(palette.LOW_TO_HIGH))[:, 0]
    middle = len(light) // 2
    assert np.all(np.diff(light[: middle + 1]) > 0) and np.all(np.diff(light[middle:]) < 0)


def _linear(colours):
    srgb = np.array([[int(c[i : i + 2], 16) / 255 for i in (1, 3, 5)] for c in colours])
    return np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)


def _lab(linear):
    xyz = (
        linear
        @ np.array(
            [
                [0.4124564, 0.3575761, 0.1804375],
                [0.2126729, 0.7151522, 0.0721750],
                [0.0193339, 0.1191920, 0.9503041],
            ]
        ).T
    )
    ratio = xyz / np.array([0.95047, 1.0, 1.08883])
    f = np.where(ratio > 0.008856, np.cbrt(ratio), 7.787 * ratio + 16 / 116)
    return np.stack([116 * f[:, 1] - 16, 500 * (f[:, 0] - f[:, 1]), 200 * (f[:, 1] - f[:, 2])], axis=1)
