"""Tests the sources of the website that `make docs` builds."""

import re
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]


def test_the_modules_of_the_reference_exist():
    text = (ROOT / "docs" / "website" / "pages.py").read_text()
    modules = re.findall(r'"((?:kitting_drake|systems)\.[a-z_.]+)"', text)
    assert len(modules) > 10
    for module in modules:
        assert (ROOT / module.replace(".", "/")).with_suffix(".py").is_file(), module


def test_every_page_is_in_the_navigation():
    text = (ROOT / "mkdocs.yml").read_text()
    for page in (ROOT / "docs").glob("*.md"):
        assert f": {page.name}\n" in text, page.name
