"""Hooks of MkDocs: they add pages that are not in docs/, and links to files outside docs/."""

import json
import logging
import os
import re
import shutil
from pathlib import Path, PurePosixPath

import yaml
from mkdocs.structure.files import File, Files

ROOT = Path(__file__).resolve().parents[2]
DOCS = ROOT / "docs"
LOG = logging.getLogger("mkdocs.hooks.pages")
TREE = "tree"
"""The folder of the site with copies of the linked files outside docs/."""

API = {
    "station": ("The station", ["kitting_drake.station.station", "kitting_drake.station.policy"]),
    "scenario": (
        "The schema of a scenario",
        [
            "kitting_drake.scenario.schema",
            "kitting_drake.scenario.policies",
            "kitting_drake.scenario.cameras",
            "kitting_drake.scenario.appearance",
            "kitting_drake.scenario.loader",
            "kitting_drake.tasks.kitting.kitting",
            "kitting_drake.tasks.kitting.arranged",
            "kitting_drake.hkd.kits.parameters",
        ],
    ),
    "tasks": (
        "The contract of a task",
        ["kitting_drake.tasks.task", "systems.placement", "systems.success"],
    ),
    "policies": (
        "Policies",
        [
            "kitting_drake.policies.learned_policy",
            "kitting_drake.policies.stages",
            "kitting_drake.policies.factory",
        ],
    ),
    "gym": (
        "The Gymnasium environments",
        ["kitting_drake.gym.environment", "kitting_drake.gym.spaces"],
    ),
}
"""The pages of the reference: their titles, and the modules on them."""

_LINK = re.compile(r"(!?\[[^\]]*\]\()([^)\s#]+)([^)]*\))")
_linked: dict[str, Path] = {}


def on_config(config):
    """Removes entries of the navigation whose pages do not exist."""
    made = {"index.md", "tutorial.md", "api/systems.md", *(f"api/{name}.md" for name in API)}

    def kept(entries):
        for entry in entries:
            ((title, target),) = entry.items()
            if isinstance(target, list):
                yield {title: list(kept(target))}
            elif target in made or (DOCS / target).exists():
                yield entry

    config.nav = list(kept(config.nav))
    return config


def on_files(files: Files, config) -> Files:
    """Adds the generated pages to the site."""
    _linked.clear()
    readme = (ROOT / "README.md").read_text()
    pages = {"index.md": readme, "tutorial.md": _notebook(DOCS / "tutorial.ipynb")}
    for name, (title, modules) in API.items():
        pages[f"api/{name}.md"] = _reference(title, modules)
    systems = sorted(
        path.stem for path in (ROOT / "systems").glob("*.py") if "(LeafSystem)" in path.read_text()
    )
    names = [*systems, "signals", "pick_place_parameters"]
    pages["api/systems.md"] = _reference("Systems and signals", [f"systems.{s}" for s in names])
    for path, text in pages.items():
        files.append(File.generated(config, path, content=text))
    return files


def on_page_markdown(markdown: str, page, config, files: Files) -> str:
    """Converts links that are relative to the page's file into links of the site."""
    source = page.file.src_uri
    place = PurePosixPath("README.md" if source == "index.md" else f"docs/{source}")

    def changed(match: re.Match[str]) -> str:
        before, target, after = match.groups()
        if ":" in target or target.startswith("/") or source.startswith("api/"):
            return match[0]
        path = os.path.normpath(place.parent / target)
        if path == "README.md":
            path = "docs/index.md"
        inside = path.removeprefix("docs/")
        if path != inside:
            there = files.get_file_from_path(inside)
        else:
            there = None
            if (ROOT / path / "README.md").is_file():
                path = f"{path}/README.md"
            if (ROOT / path).exists():
                picture = before.startswith("!")
                # Link to text files as they are, because a browser can show them.
                inside = f"{TREE}/{path}" if picture else f"{TREE}/{path}.txt"
                _linked[inside] = ROOT / path
                inside = "../" * source.count("/") + inside
                if picture:
                    return f'<img alt="{before[2:-2]}" src="{inside}">'
                return f'<a href="{inside}">{before[1:-2]}</a>'
        if there is None:
            LOG.warning("%s links to '%s', which is not there", place, target)
            return match[0]
        up = "../" * source.count("/")
        return f"{before}{up}{inside}{after}"

    if source == "index.md":
        markdown = re.sub(r'(src|href)="docs/', r'\1="', markdown)
    return _outside_code(markdown, lambda text: _LINK.sub(changed, text))


def on_page_content(html: str, page, config, files: Files) -> str:
    """Draws the ports of systems as a table."""
    return re.sub(
        r"<p>\.\. pydrake_system::</p>\s*(?:<div class=\"[^\"]*highlight[^\"]*\">)?"
        r"<pre>(?:<span></span>)?<code>(.*?)</code></pre>(?:</div>)?",
        lambda match: _ports(re.sub(r"<[^>]+>", "", match[1])),
        html,
        flags=re.DOTALL,
    )


def on_post_build(config) -> None:
    """Copies the linked files outside docs/ to the site. For a folder, it writes a list of its
    files."""
    for name, path in _linked.items():
        copy = Path(config.site_dir, name)
        copy.parent.mkdir(parents=True, exist_ok=True)
        if path.is_dir():
            copy.write_text("\n".join(sorted(item.name for item in path.iterdir())) + "\n")
        else:
            shutil.copyfile(path, copy)


def _reference(title: str, modules: list[str]) -> str:
    """Returns a page of the API reference."""
    return f"# {title}\n\n" + "\n".join(f"::: {module}\n" for module in modules)


def _notebook(path: Path) -> str:
    """A notebook without outputs as Markdown."""
    note = f"*This page is the notebook [{path.name}]({path.name}).*\n\n"
    parts = []
    for cell in json.loads(path.read_text())["cells"]:
        text = "".join(cell["source"])
        parts.append(text if cell["cell_type"] == "markdown" else f"```python\n{text}\n```")
    first, *others = parts
    return "\n\n".join([first, note, *others])


def _outside_code(markdown: str, change) -> str:
    """Applies `change` to a page, except to its fenced code."""
    parts = re.split(r"(^```.*?^```$)", markdown, flags=re.DOTALL | re.MULTILINE)
    return "".join(part if i % 2 else change(part) for i, part in enumerate(parts))


def _ports(text: str) -> str:
    """Draws the block of `pydrake_system` as on Drake's own pages."""
    system = yaml.safe_load(text)
    cells = []
    for side in ("input_ports", "output_ports"):
        ports = "<br>".join(str(port) for port in system.get(side) or ["&nbsp;"])
        cells.append(f"<td>{ports}</td>")
    return (
        '<table class="ports"><tr>'
        f"{cells[0]}<td>&rarr;</td><th>{system['name']}</th><td>&rarr;</td>{cells[1]}"
        "</tr></table>"
    )
