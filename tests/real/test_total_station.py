"""Total-station exports of real sites, read whole."""

import numpy as np
import pytest

from pipeline.surface.shots import read_shots

pytestmark = pytest.mark.real


@pytest.mark.parametrize("file, count", [("Site 180 EU3.txt", 1774), ("text_files/Site 180 EU2.txt", 1430)])
def test_every_line_is_a_shot(real_data, file, count):
    path = real_data / "total_station" / file
    shots = read_shots(path, "PENZD", 1.0)
    # The oracle is the file cut at its tabs by hand; three lines lack the tab after the name.
    lines = [line.split("\t") for line in path.read_bytes().decode("latin-1").splitlines() if line.strip()]
    lines = [[*cells[0].rsplit(" ", 1), *cells[1:]] if cells[3:4] == [""] else cells for cells in lines]
    assert len(shots) == len(lines) == count
    assert len(shots.mended) == (3 if "EU3" in file else 0)
    assert shots.point.tolist() == [cells[0].strip() for cells in lines]
    assert np.array_equal(shots.p_grid, np.array([[float(cell) for cell in cells[1:4]] for cells in lines]))
    assert shots.code.tolist() == [cells[4].strip() if len(cells) > 4 else "" for cells in lines]
