"""A plan beside the run of a log: what is read from it, and how the prediction compares with its report."""

import json

import numpy as np
import pytest
from click.testing import CliRunner

from pipeline.cli import main
from pipeline.tables import read_table


@pytest.fixture(scope="module")
def planned(finished, recorded, tmp_path_factory):
    run, _ = finished
    out = tmp_path_factory.mktemp("plan") / "plan.html"
    files = [str(recorded / name) for name in ("machine.toml", "site.toml")]
    options = ["--log", str(run), "--points", "10", "--no-search", "--out", str(out)]
    done = CliRunner().invoke(main, ["plan", *files, *options], catch_exceptions=False)
    assert done.exit_code == 0, done.output
    return json.loads(out.with_suffix(".json").read_text(encoding="utf-8")), run


def test_the_prediction_agrees_with_the_report_of_a_short_log(planned):
    content, run = planned
    sentence = next(p["sentences"][0] for p in content["parts"] if p["heading"] == "Beside the log")
    words = sentence.replace(";", "").split()
    predicted, reported = (float(words[words.index(w) + k]) for w, k in (("sigma", 1), ("says", 1)))
    table = read_table(run / "poses.parquet", "poses")
    tool = (table["body"] == "tool") & table["seen"]
    assert reported == pytest.approx(1e3 * np.median(np.sqrt(table["cov_h_h"][tool])), abs=0.06)
    # One cycle of fifteen seconds has few independent looks, and its ends are worth less than the steady state.
    assert predicted == pytest.approx(reported, rel=0.3)


def test_the_arm_comes_from_the_poses(planned):
    content, _ = planned
    text = next(row["text"] for row in content["origin"]["rows"] if row["what"] == "arm")
    _, x, y, z, _, _, boom, _, _, stick, _ = text.replace(",", "").split()
    assert [float(v) for v in (x, y, z, boom, stick)] == pytest.approx([0.35, 0.0, 1.7, 4.6, 2.45], abs=0.06)
