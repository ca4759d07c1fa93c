"""Figures keep spikes and gaps, clash with nothing on the page, and escape what they are told."""

import numpy as np
import pytest

from pipeline.report import maps, measured, profiles
from pipeline.report.drawing import decimated, house_style, new_figure, svg_of
from pipeline.report.units import units_of
from tests.report.conftest import made_up_inputs
from tests.report.pages import PageReader


def test_decimation_keeps_spikes_and_gaps():
    x = np.arange(100_000.0)
    y = np.sin(x / 5000)
    y[31_234], y[77_001] = 9.0, -9.0
    y[50_000:50_020] = np.nan
    few_x, few_y = decimated(x, y)
    assert len(few_x) <= 1510
    assert np.all(np.diff(few_x) > 0)
    assert np.nanmax(few_y) == 9.0 and np.nanmin(few_y) == -9.0
    assert np.isnan(few_y).any()


def test_a_short_line_stays_as_it_is():
    x, y = np.arange(5.0), np.array([1.0, np.nan, 3.0, 4.0, 5.0])
    assert decimated(x, y)[1] is not None and len(decimated(x, y)[0]) == 5


def test_two_figures_share_no_id_and_no_address():
    with house_style():
        pictures = []
        for name in ("one", "two"):
            figure = new_figure(2.0)
            ax = figure.subplots()
            ax.plot([0, 1], [0, 1], "o-")
            ax.imshow(np.zeros((2, 2, 4)), extent=(0, 1, 0, 1))
            pictures.append(svg_of(figure, name, "A <title> & more", "described"))
    html = "".join(pictures)
    read = PageReader(html)
    assert read.faults == []
    assert len(set(read.ids)) == len(read.ids)
    assert "http" not in html and "<style" not in html
    assert "A &lt;title&gt; &amp; more" in html


def test_a_users_own_matplotlib_settings_change_nothing():
    import matplotlib

    def drawn():
        with house_style():
            figure = new_figure(2.0)
            figure.subplots().plot([0, 1], [0, 1])
            return svg_of(figure, "one", "t", "d")

    before = drawn()
    with matplotlib.rc_context({"lines.linewidth": 9, "font.size": 30}):
        assert drawn() == before


@pytest.mark.parametrize("unit", ["m", "us_survey_foot"])
def test_no_label_is_clipped_and_the_plan_is_to_scale(unit):
    inputs = made_up_inputs(unit)
    units = units_of(unit, inputs.site.grid.metres_per_unit)
    grid = measured.grid_of(inputs.tables["as_built"])
    with house_style():
        plan = maps.plan(inputs, inputs.alignment, grid, units)
        figures = [
            plan,
            maps.deviation_map(inputs, grid, units),
            profiles.long_section(inputs, inputs.tables["stations"], grid, units),
            profiles.cross_sections(inputs, measured.sections_of(inputs, grid), units),
            profiles.check_shots(inputs.tables["checks"], units),
        ]
        for figure in figures:
            figure.draw_without_rendering()
            box, (width, height) = figure.get_tightbbox(), figure.get_size_inches()
            assert box.x0 > -0.02 and box.y0 > -0.02, figure.axes[0].get_title()
            assert box.x1 < width + 0.02 and box.y1 < height + 0.02
        ax = plan.axes[0]
        frame = ax.get_window_extent()
        east, north = np.ptp(ax.get_xlim()) / frame.width, np.ptp(ax.get_ylim()) / frame.height
        assert east == pytest.approx(north, rel=1e-6)
