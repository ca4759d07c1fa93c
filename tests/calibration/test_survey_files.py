"""`gradetrace survey` on files: what it writes into site.toml, and that a faulty survey writes nothing."""

import numpy as np
import pytest

from pipeline.config import load_site
from pipeline.errors import CalibrationError
from pipeline.geometry import se3
from pipeline.stages import survey_markers
from pipeline.synthetic import calibration_log, calibration_sites


@pytest.fixture
def yard(tmp_path):
    drawn = calibration_sites.calibration_site(calibration_sites.CLUSTER, 6)
    site = tmp_path / "site.toml"
    site.write_text(calibration_log.site_toml(drawn), encoding="utf-8")
    corners = tmp_path / "corners.csv"
    corners.write_text(calibration_log.corner_shots(drawn), encoding="utf-8")
    return drawn, site, corners


def station(drawn):
    p = drawn.motion.place.point(drawn.motion.station, 0.0, drawn.spec.ground + 1.6)
    return tuple((np.array(drawn.spec.origin) + p).tolist())


def test_poses_with_covariance_stand_in_the_site_file_and_lie_within_it(yard):
    drawn, site, corners = yard
    written = survey_markers.run(corners, site, sigma_mm=1.0, station=station(drawn))
    assert written.sentence.startswith("Good enough") and written.kept.exists() and written.sheet.exists()
    found = load_site(site.read_text(encoding="utf-8"), "site.toml")
    z = []
    for name, T in drawn.truth.benchmarks.items():
        pose = found.benchmark_pose(name)
        assert found.benchmarks[name].pose.calibrated.by == "gradetrace survey"
        error = se3.local(pose.transform(), T)
        z.append(error @ np.linalg.solve(pose.covariance_xi(), error))
    # Nine chi-squares of six: mean 6, sigma 1.2.
    assert 3.0 < np.mean(z) < 9.5


def test_a_northing_of_seven_digits_is_written_to_a_hundredth_of_a_millimetre(yard):
    _, site, corners = yard
    survey_markers.run(corners, site, sigma_mm=1.0)
    text = site.read_text(encoding="utf-8")
    northing = text.split("[benchmarks.wall-1]")[1].split("enh = [")[1].split(",")[1]
    assert len(northing.strip().partition(".")[2]) >= 5


def test_an_exchange_in_the_file_writes_nothing(yard):
    drawn, site, corners = yard
    before = site.read_bytes()
    text = corners.read_text(encoding="utf-8")
    text = text.replace("wall-3-TL", "x").replace("wall-3-TR", "wall-3-TL").replace("x,", "wall-3-TR,")
    corners.write_text(text, encoding="utf-8")
    with pytest.raises(CalibrationError, match=r"corners wall-3-T. and wall-3-T. are exchanged"):
        survey_markers.run(corners, site, sigma_mm=1.0, station=station(drawn))
    assert site.read_bytes() == before
    assert sorted(p.name for p in site.parent.iterdir()) == ["corners.csv", "site.toml"]


def test_points_of_other_names_need_a_layout(yard):
    _, site, corners = yard
    lines = corners.read_text(encoding="utf-8").splitlines()[:4]
    numbered = [f"{100 + k},{line.partition(',')[2]}" for k, line in enumerate(lines)]
    corners.write_text("\n".join(numbered) + "\n", encoding="utf-8")
    with pytest.raises(CalibrationError, match=r"no point is named after a corner .* wall-1-TL"):
        survey_markers.run(corners, site)
    layout = {str(100 + k): f"wall-1-{name}" for k, name in enumerate(("TL", "TR", "BR", "BL"))}
    written = survey_markers.run(corners, site, sigma_mm=1.0, layout=layout)
    assert written.file == site
    with pytest.raises(CalibrationError, match="as point 100 is said to be, is no corner"):
        survey_markers.run(corners, site, layout={**layout, "100": "wall-77-TL"})
