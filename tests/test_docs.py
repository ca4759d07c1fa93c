"""What the pages under docs/ tell people to write is what the program accepts."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from pipeline.config import load_machine, load_site

DOCS = Path(__file__).parents[1] / "docs"


def toml_of(page: str, section: str) -> str:
    """All TOML blocks below one `## section` of a page, joined as a reader would join them."""
    text = (DOCS / page).read_text(encoding="utf-8")
    body = text.split(f"\n## {section}\n", 1)[1].split("\n## ", 1)[0]
    return "\n".join(re.findall(r"```toml\n(.*?)```", body, re.DOTALL))


def test_the_documented_machine_file_loads():
    machine = load_machine(toml_of("machine-and-site.md", "machine.toml"), "docs")
    assert set(machine.bodies) == {"cab", "stick", "bucket"}
    assert machine.sensors["bucket_cylinder"].linkage is not None


def test_the_documented_site_file_loads():
    site = load_site(toml_of("machine-and-site.md", "site.toml"), "docs")
    assert site.grid.metres_per_unit == pytest.approx(0.304800609601219)
    assert set(site.benchmarks) == {"B1", "B2"}


PAGES = sorted([*DOCS.glob("*.md"), *DOCS.parent.glob("*.md")])


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_links_of_the_pages_lead_somewhere(page):
    for target in re.findall(r"\]\(([^)#]+)\)", page.read_text(encoding="utf-8")):
        if not target.startswith(("http://", "https://", "mailto:")):
            assert (page.parent / target).exists(), f"{page.name} links to {target}, which is not there"
