"""The rooms of the house: imports go one way, nothing goes in circles, and a name occurs once."""

import ast
import itertools
import subprocess
import sys
from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator, Mapping
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]

# From top to bottom: a room imports only from itself and from those below it.
ROOMS = (
    "verbs",
    "reproduction",
    "real_camera",
    "evaluation",
    "gym",
    "episode",
    "station",
    "static_scenes",
    "scenario",
    "tasks",
    "hkd",
    "policies",
    "common",
    "kitting_drake",
    "systems",
)
MOST_FILES = 14
ANY_SIZE = {ROOT / "systems", ROOT / "tests" / "systems"}

Module = str
Imports = dict[Module, dict[Module, int]]
"""The modules of the tree that each module imports, and the line where it does."""


class Tree:
    """The sources of `kitting_drake/` and `systems/`, and what they import."""

    def __init__(self) -> None:
        self.files = {
            _module(path): path
            for package in ("kitting_drake", "systems")
            for path in sorted((ROOT / package).rglob("*.py"))
        }
        self.sources = {name: ast.parse(path.read_bytes()) for name, path in self.files.items()}
        self.imports: Imports = {}
        self.outside: dict[Module, set[str]] = {}
        """The packages that each module imports from elsewhere."""
        for name, source in self.sources.items():
            self.imports[name], self.outside[name] = {}, set()
            for imported, line in self._imported(name, source):
                if imported in self.files and imported != name:
                    self.imports[name].setdefault(imported, line)
                elif imported not in self.files:
                    self.outside[name].add(imported.partition(".")[0])

    def _imported(self, name: Module, source: ast.Module) -> Iterator[tuple[Module, int]]:
        """All imports of a file: those in functions and under TYPE_CHECKING, too."""
        is_package = self.files[name].name == "__init__.py"
        package = name.split(".") if is_package else name.split(".")[:-1]
        for node in ast.walk(source):
            if isinstance(node, ast.Import):
                yield from ((alias.name, node.lineno) for alias in node.names)
            elif isinstance(node, ast.ImportFrom):
                above = package[: len(package) - node.level + 1] if node.level else []
                origin = ".".join([*above, *filter(None, [node.module])])
                for alias in node.names:
                    inner = f"{origin}.{alias.name}"
                    yield (inner if inner in self.files else origin), node.lineno

    def where(self, importer: Module, imported: Module) -> str:
        path, line = self.files[importer], self.imports[importer][imported]
        return f"{path.relative_to(ROOT)}:{line} imports {imported}"

    def room(self, name: Module) -> str:
        package, _, rest = name.partition(".")
        room = rest.partition(".")[0]
        if package == "systems" or not rest:
            return package
        return room if room in ROOMS and name != "kitting_drake.hkd.__main__" else "verbs"

    def folder(self, name: Module) -> str:
        """The folder of a file. An `__init__.py` that gathers what a folder offers stands above
        the folder's other files."""
        path = self.files[name]
        if self.room(name) == "verbs":
            return "verbs"
        return str((path if path.name == "__init__.py" else path.parent).relative_to(ROOT))


def _module(path: Path) -> Module:
    parts = path.relative_to(ROOT).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def circle(graph: Mapping[str, Iterable[str]]) -> list[str]:
    """The nodes of one circle of a graph, or none."""
    try:
        TopologicalSorter(graph).prepare()
    except CycleError as error:
        return error.args[1]
    return []


@pytest.fixture(scope="module")
def tree() -> Tree:
    return Tree()


def test_every_folder_is_a_room():
    folders = {path.parent.name for path in (ROOT / "kitting_drake").glob("*/*.py")}
    assert folders == set(ROOMS) - {"verbs", "kitting_drake", "systems"}


def test_imports_go_down(tree: Tree):
    climbing = [
        f"{tree.where(name, other)}: {tree.room(name)} is below {tree.room(other)}"
        for name, imported in tree.imports.items()
        for other in imported
        if ROOMS.index(tree.room(name)) > ROOMS.index(tree.room(other))
    ]
    assert not climbing, "\n".join(climbing)


def test_no_module_is_in_a_circle(tree: Tree):
    found = circle(tree.imports)
    assert not found, " <- ".join(found)


def test_no_folder_is_in_a_circle(tree: Tree):
    graph: dict[str, dict[str, str]] = defaultdict(dict)
    for name, imported in tree.imports.items():
        for other in imported:
            if tree.folder(name) != tree.folder(other):
                graph[tree.folder(name)].setdefault(tree.folder(other), tree.where(name, other))
    found = circle(graph)
    steps = [graph[above][below] for below, above in itertools.pairwise(found)]
    assert not found, "\n".join(steps)


def test_systems_and_policies_import_nothing_that_is_not_theirs(tree: Tree):
    wrong = []
    for name, packages in tree.outside.items():
        barred: set[str] = set()
        if tree.room(name) == "systems":
            barred = {"torch", "escnn"}
        if tree.room(name) in ("policies", "real_camera") or name == "systems.signals":
            barred = barred | {"pydrake"}
        wrong += [f"{tree.files[name].relative_to(ROOT)}: {item}" for item in packages & barred]
    assert not wrong, "\n".join(wrong)


def test_the_real_camera_loads_without_drake(tree: Tree):
    modules = [name for name in tree.files if tree.room(name) == "real_camera"]
    program = f"import sys; sys.modules['pydrake'] = None; import {', '.join(modules)}"
    done = subprocess.run([sys.executable, "-c", program], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def test_no_file_name_occurs_twice(tree: Tree):
    count = Counter(path.name for path in tree.files.values())
    twice = [
        str(path.relative_to(ROOT))
        for path in tree.files.values()
        if count[path.name] > 1 and path.name not in ("__init__.py", "__main__.py")
    ]
    assert not twice, "\n".join(twice)


def test_no_public_class_occurs_twice(tree: Tree):
    places = defaultdict(list)
    for name, source in tree.sources.items():
        for node in source.body:
            if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
                places[node.name].append(f"{tree.files[name].relative_to(ROOT)}:{node.lineno}")
    twice = [f"{name}: {', '.join(found)}" for name, found in places.items() if len(found) > 1]
    assert not twice, "\n".join(twice)


def test_no_folder_is_too_full():
    count = Counter(
        path.parent
        for top in ("kitting_drake", "systems", "tests")
        for path in (ROOT / top).rglob("*.py")
    )
    full = [
        f"{folder.relative_to(ROOT)} has {number} files"
        for folder, number in count.items()
        if number > MOST_FILES and folder not in ANY_SIZE
    ]
    assert not full, "\n".join(full)
