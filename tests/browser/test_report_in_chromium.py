"""The page in a real browser: whole without scripts or network, readable narrow, its numbers as they stand there."""

import json
import re
import struct

import pytest

from tests.browser.printed import pages_of
from tests.report.pages import PageReader, as_float, at_path

pytestmark = pytest.mark.browser


def png_size(file):
    head = file.read_bytes()[:24]
    assert head.startswith(b"\x89PNG")
    return struct.unpack(">II", head[16:24])


def test_the_numbers_in_the_browser_are_those_of_report_json(browser, page, page_file):
    """As the browser has them after parsing, not as we wrote them."""
    read = PageReader(browser(page_file, "--dump-dom"))
    assert len(read.numbers) == page.html.count('<data class="number"')
    for key, (_, shown) in read.numbers.items():
        entry = at_path(page.content, key)
        if entry["value"] is not None:
            limit = 0.5001 * 10.0 ** -entry["digits"]
            assert as_float(shown.replace("+", "")) == pytest.approx(entry["value"], abs=limit), key
    first = read.tables["stations"][1]
    assert as_float(first[0]) == pytest.approx(page.content["stations"]["rows"][0]["station"], abs=0.00501)
    assert first[1] == "\u2713 PASS"


def test_the_browser_mends_nothing(browser, page, page_file):
    """A parser that had to mend the page would have added, moved or dropped elements."""
    ours, theirs = PageReader(page.html), PageReader(browser(page_file, "--dump-dom"))
    assert theirs.faults == []
    assert [tag for tag, _ in theirs.tags] == [tag for tag, _ in ours.tags]
    assert theirs.ids == ours.ids


def addresses_asked_for(browser, file, log):
    browser(file, f"--log-net-log={log}", "--net-log-capture-mode=Everything", "--dump-dom")
    asked = set(re.findall(r'"url":\s*"([^"]+)"', log.read_text(encoding="utf-8", errors="replace")))
    # The browser's own business (its start page, updates that the flags did not stop) is not the page's.
    own = ("google", "gvt1.com", "chrome")
    return {
        url for url in asked if url.startswith(("http:", "https:", "ws")) and not any(o in url for o in own)
    }


def test_no_request_leaves(browser, page_file, tmp_path):
    assert addresses_asked_for(browser, page_file, tmp_path / "net.json") == set()


def test_a_request_that_leaves_would_be_seen(browser, tmp_path):
    file = tmp_path / "leaky.html"
    file.write_text("<!DOCTYPE html><title>x</title><img src='http://leak.example/x.png'>")
    assert addresses_asked_for(browser, file, tmp_path / "net.json") == {"http://leak.example/x.png"}


@pytest.mark.parametrize("width", [1280, 400])
def test_the_page_fits_the_window(browser, page_file, tmp_path, width):
    """Nothing wider than the window but what scrolls in its own box.

    Headless Chromium opens no window narrower than 500 px, so the page stands in a frame of the width.
    """
    frame = tmp_path / "frame.html"
    frame.write_text(
        "<!DOCTYPE html><html><body style='margin:0'>"
        f"<iframe id=f src='{page_file.as_uri()}' style='border:0;width:{width}px;height:9000px'></iframe>"
        "<script>f.onload = () => {const d = f.contentDocument.documentElement;"
        "const wide = [...d.querySelectorAll('body *')].filter(e => !e.closest('.scroll') || e.matches('.scroll'))"
        f".filter(e => e.getBoundingClientRect().right > {width} + 0.5 && !e.matches('.skip'))"
        ".map(e => e.tagName + '.' + e.className);"
        "document.body.innerHTML = '<pre>' + JSON.stringify({scroll: d.scrollWidth, wide}) + '</pre>';}</script>"
        "</body></html>"
    )
    dom = browser(frame, "--allow-file-access-from-files", "--window-size=1400,9000", "--dump-dom")
    found = json.loads(re.search(r"<pre>(.*?)</pre>", dom).group(1))
    assert found == {"scroll": width, "wide": []}


def test_the_page_can_be_photographed(browser, page_file, tmp_path):
    picture = tmp_path / "page.png"
    browser(page_file, "--window-size=1280,1600", f"--screenshot={picture}")
    assert png_size(picture) == (1280, 1600)
    assert picture.stat().st_size > 100_000  # an empty page has some 10 kB


@pytest.fixture(scope="module")
def printed(browser, page_file, tmp_path_factory):
    """The PDF of the page, as bytes."""
    file = tmp_path_factory.mktemp("printed") / "page.pdf"
    browser(page_file, "--no-pdf-header-footer", f"--print-to-pdf={file}")
    return file.read_bytes()


def test_the_page_prints_on_a4(printed):
    boxes = {
        tuple(round(float(x)) for x in box.split()) for box in re.findall(rb"/MediaBox \[([^\]]+)\]", printed)
    }
    assert boxes <= {(0, 0, 595, 842), (0, 0, 596, 842), (0, 0, 594, 842)}
    assert 4 <= len(re.findall(rb"/Type /Page\b(?!s)", printed)) <= 16


def test_heads_of_tables_stand_on_every_page_they_run_over(page, printed):
    """Elevations of stations tell which pages the table is on: no other table has them to the millimetre."""
    rows = page.content["stations"]["rows"]
    heights = [f"{row['h']:.3f}{row['design_h']:.3f}" for row in rows if row["h"] is not None]
    pages = [text for text, _ in pages_of(printed)]
    with_rows = [text for text in pages if sum(height in text for height in heights) >= 2]
    assert len(with_rows) >= 2, "the table fits on one page and shows nothing"
    for text in with_rows:
        head = text.index("Verdict")
        assert text[head:].startswith("VerdictDeviationmmUmmAs‑builtmDesignm")
        first = min(text.index(height) for height in heights if height in text)
        assert head < first
    assert sum(height in text for text in pages for height in heights) == len(heights)


def test_no_picture_is_cut_between_two_pages(page, printed):
    """A raster picture that is cut would be drawn on both."""
    drawn = [name for _, images in pages_of(printed) for name in images]
    assert len(set(drawn)) == len(drawn)
    assert len(drawn) >= len(re.findall("<image ", page.html))


def test_every_figure_fits_on_a_page_and_asks_to_stay_whole(browser, page, tmp_path):
    """A4 less its margins, 184 x 268 mm; the rules of print hold on a screen of that width."""
    html = page.html.replace("@media print", "@media all")
    html = re.sub(r'<meta http-equiv="Content-Security-Policy"[^>]*>', "", html)
    ask = (
        "<script>const told = [...document.querySelectorAll('figure')].map(f => {"
        "const style = getComputedStyle(f), box = f.getBoundingClientRect();"
        "return [Math.round(box.width), Math.round(box.height), style.breakInside]});"
        "const heads = [...document.querySelectorAll('thead')].map(h => getComputedStyle(h).display);"
        "document.body.innerHTML = '<pre>' + JSON.stringify({told, heads}) + '</pre>';</script>"
    )
    (tmp_path / "inner.html").write_text(html.replace("</body>", f"{ask}</body>"), encoding="utf-8")
    frame = tmp_path / "frame.html"
    frame.write_text(
        "<!DOCTYPE html><body style='margin:0'><iframe id=f src=inner.html style='border:0;width:184mm;height:9000px'>"
        "</iframe><script>f.onload = () => {document.body.textContent = f.contentDocument.body.textContent}</script>"
    )
    dom = browser(frame, "--allow-file-access-from-files", "--window-size=1400,9000", "--dump-dom")
    found = json.loads(re.search(r"<body[^>]*>(\{.*\})\s*</body>", dom, re.S).group(1))
    assert len(found["told"]) == len(page.content["figures"])
    millimetre = 96 / 25.4
    for width, height, inside in found["told"]:
        assert inside == "avoid" and width <= 184 * millimetre + 1 and height <= 268 * millimetre
    assert set(found["heads"]) == {"table-header-group"}


def test_scripts_are_not_needed(page):
    assert "<script" not in page.html


def test_a_hostile_name_runs_nothing(browser, page_file):
    dom = browser(page_file, "--dump-dom")
    assert "<script" not in dom
    assert "&lt;script&gt;alert" in dom
