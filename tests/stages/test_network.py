"""`gradetrace network`: the picture and the words of a job's network."""

import xml.etree.ElementTree as ET

from tests.conftest import LOG


def test_the_network_of_a_run_is_drawn_and_told(gradetrace, recorded, finished, tmp_path):
    folder, _ = finished
    files = recorded / "machine.toml", recorded / "site.toml"
    done = gradetrace("network", *files, "--log", folder, "--out", tmp_path / "n.svg")
    assert done.code == 0, done.err
    assert "everything is tied to the datum" in done.out and "redundancy: " in done.out
    picture = ET.parse(tmp_path / "n.svg").getroot()
    assert picture.get("role") == "img"
    assert (recorded / LOG).exists()


def test_a_run_without_detections_is_refused_in_one_sentence(gradetrace, recorded, tmp_path):
    files = recorded / "machine.toml", recorded / "site.toml"
    done = gradetrace("network", *files, "--log", tmp_path, "--out", tmp_path / "n.svg")
    assert done.code == 3 and "holds no detections of this machine's cameras" in done.err
    assert not (tmp_path / "n.svg").exists()
