"""Numbers are printed in the site's unit, with the digits a surveyor stakes to, and read back as they were."""

import pytest

from pipeline.report.units import text_of, units_of


def test_a_metric_site_reads_metres_and_millimetres():
    units = units_of("m", 1.0)
    assert (units.length, units.deviation) == ("m", "mm")
    assert float(units.to_deviation(0.0123)) == pytest.approx(12.3)


@pytest.mark.parametrize(
    "unit, metres, name, feet",
    [("international_foot", 0.3048, "ft", 1.0), ("us_survey_foot", 1200 / 3937, "US ft", 1.0)],
)
def test_a_site_in_feet_reads_feet_and_thousandths(unit, metres, name, feet):
    units = units_of(unit, metres)
    assert (units.length, units.deviation, units.deviation_digits) == (name, name, 3)
    assert float(units.to_length(metres)) == pytest.approx(feet)


def test_the_two_feet_are_told_apart_at_two_million():
    """1.2 m at 2,000,000 ft is the difference that site.toml warns of: 4 ft."""
    apart = units_of("international_foot", 0.3048).to_length(609_600.0) - units_of(
        "us_survey_foot", 1200 / 3937
    ).to_length(609_600.0)
    assert float(apart) == pytest.approx(4.0, abs=0.01)


@pytest.mark.parametrize(
    "value, digits, signed, text",
    [
        (0.0, 0, True, "0"),
        (-0.4, 0, True, "0"),
        (0.4, 0, True, "0"),
        (12.5, 1, True, "+12.5"),
        (-12.34, 1, False, "\u221212.3"),
        (float("nan"), 1, False, "\u2013"),
        (None, 1, False, "\u2013"),
        (4123456.789, 3, False, "4\u202f123\u202f456.789"),
        (2000.125, 3, False, "2000.125"),
        (-10000.0, 0, False, "\u221210\u202f000"),
    ],
)
def test_numbers_as_they_are_printed(value, digits, signed, text):
    assert text_of(value, digits, signed) == text
