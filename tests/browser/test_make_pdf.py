"""`make pdf`: the page on paper beside the page, A4, nothing blank, and a sentence where it cannot be."""

import os
import re
import subprocess
import zlib
from pathlib import Path

import pytest

pytestmark = pytest.mark.browser

ROOT = Path(__file__).parents[2]


def make_pdf(*words):
    # A make that runs these tests must not hand its own flags down.
    quiet = {key: value for key, value in os.environ.items() if not key.startswith(("MAKE", "MFLAGS"))}
    return subprocess.run(
        ["make", "pdf", *words], cwd=ROOT, env=quiet, capture_output=True, text=True, timeout=240
    )


def marks_on_pages(data):
    """Of each page of a PDF the number of texts and pictures that its content draws."""
    found = []
    for page in re.findall(rb"/Type /Page\b(?!s).*?\bendobj", data, re.S):
        number = re.search(rb"/Contents (\d+) 0 R", page)[1]
        head = re.search(rb"\n%s 0 obj\s*<<([^<>]*)>>\s*stream\r?\n" % number, data)
        length = int(re.search(rb"/Length (\d+)", head[1])[1])
        content = zlib.decompress(data[head.end() : head.end() + length])
        found.append(len(re.findall(rb"\bT[jJ]\b|\bDo\b", content)))
    return found


def test_the_page_is_printed_beside_itself_on_a4_with_nothing_blank(browser, page, tmp_path):
    folder = tmp_path / "runs of #2"
    folder.mkdir()
    (folder / "report.html").write_text(page.html, encoding="utf-8")
    done = make_pdf(f"PAGE={folder / 'report.html'}", f"CHROMIUM={browser.program}")
    assert (done.returncode, done.stderr) == (0, ""), done.stderr
    assert done.stdout.strip() == f"pdf: {folder / 'report.pdf'}"
    assert sorted(path.name for path in folder.iterdir()) == ["report.html", "report.pdf"]
    data = (folder / "report.pdf").read_bytes()
    boxes = {tuple(float(x) for x in box.split()) for box in re.findall(rb"/MediaBox \[([^\]]+)\]", data)}
    # A4 is 210 by 297 mm; a point is 1/72 inch.
    assert boxes and all(
        box[:2] == (0, 0) and box[2:] == pytest.approx((595.28, 841.89), abs=1.0) for box in boxes
    )
    marks = marks_on_pages(data)
    assert len(marks) == len(re.findall(rb"/Type /Page\b(?!s)", data)) >= 4
    assert min(marks) >= 3, f"texts and pictures per page: {marks}"


def test_a_blank_page_would_be_seen(browser, tmp_path):
    file = tmp_path / "blank.html"
    file.write_text(
        "<!DOCTYPE html><title>x</title><p>one, two, three</p><p style='break-before:page'>&nbsp;</p>"
    )
    done = make_pdf(f"PAGE={file}", f"CHROMIUM={browser.program}")
    assert done.returncode == 0, done.stderr
    marks = marks_on_pages((tmp_path / "blank.pdf").read_bytes())
    assert len(marks) == 2 and marks[0] >= 1 and marks[1] <= 1


@pytest.mark.parametrize(
    "words, sentence",
    [
        ([], "make report needs a log, for example: make report LOG="),
        (["PAGE=/nowhere/report.html"], "no report: there is no /nowhere/report.html; make one with"),
        (
            ["PAGE=README.md", "CHROMIUM=/nowhere/chromium"],
            "make pdf needs Chromium, and there is none; on Debian",
        ),
    ],
    ids=["no log", "no report", "no browser"],
)
def test_what_is_missing_is_said(words, sentence):
    done = make_pdf(*words)
    assert done.returncode == 2
    assert done.stdout == "" and done.stderr.splitlines()[0].startswith(sentence)
