"""Tests the sources of the website that `make docs` builds."""

import re
from pathlib import Path

from kitting_drake.tasks.task import TaskConfig
from systems.placement import Goal
from systems.success import AddS

ROOT = Path(__file__).resolve().parents[1]
CONFIG = (ROOT / "mkdocs.yml").read_text()


def reference() -> dict[str, Path]:
    """The modules of the API reference, and their files."""
    text = (ROOT / "docs" / "website" / "pages.py").read_text()
    modules = re.findall(r'"((?:kitting_drake|systems)\.[a-z_.]+)"', text)
    return {name: (ROOT / name.replace(".", "/")).with_suffix(".py") for name in modules}


def test_the_modules_of_the_reference_exist():
    modules = reference()
    assert len(modules) > 10
    for module, path in modules.items():
        assert path.is_file(), module
    assert {item.__module__ for item in (TaskConfig, Goal, AddS)} <= set(modules)


def test_an_empty_line_precedes_lists_in_comments():
    # Without the empty line, Markdown makes the list part of the paragraph before it.
    for path in reference().values():
        assert not re.search(r"^ +# \w.*\n +# - ", path.read_text(), re.MULTILINE), path


def test_footnotes_are_rendered():
    assert any("[^1]" in page.read_text() for page in (ROOT / "docs").glob("*.md"))
    assert "\n  - footnotes\n" in CONFIG


def test_the_search_needs_no_internet():
    # The plugin `offline` looks for "iframe-worker" in the names.
    (name,) = re.findall(r"polyfills: \[(\S*iframe-worker\S*)\]", CONFIG)
    assert "window.IFrameWorker" in (ROOT / "docs" / name).read_text()


def test_every_page_is_in_the_navigation():
    for page in (ROOT / "docs").glob("*.md"):
        assert f": {page.name}\n" in CONFIG, page.name
