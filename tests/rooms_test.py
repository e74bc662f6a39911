"""The structure of the packages: imports are layered and acyclic, and names are unique."""

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

# Rooms (packages) from top to bottom. A room may import only itself and lower rooms.
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
"""For each module, the modules of the project that it imports, and the lines of the imports."""


class Tree:
    """The sources of `kitting_drake/` and `systems/`, and the modules that they import."""

    def __init__(self) -> None:
        self.files = {
            _module(path): path
            for package in ("kitting_drake", "systems")
            for path in sorted((ROOT / package).rglob("*.py"))
        }
        self.sources = {name: ast.parse(path.read_bytes()) for name, path in self.files.items()}
        self.imports: Imports = {}
        self.outside: dict[Module, set[str]] = {}
        """The external packages that each module imports."""
        for name, source in self.sources.items():
            self.imports[name], self.outside[name] = {}, set()
            for imported, line in self._imported(name, _statements(source)):
                if imported in self.files and imported != name:
                    self.imports[name].setdefault(imported, line)
                elif imported not in self.files:
                    self.outside[name].add(imported.partition(".")[0])

    def loaded(self, *names: Module) -> set[str]:
        """The external modules that are loaded if modules of the project are imported."""
        outside: set[str] = set()
        waiting, found = list(names), set()
        while waiting:
            name = waiting.pop()
            if name in found:
                continue
            found.add(name)
            waiting += [name.rpartition(".")[0]] if "." in name else []
            for imported, _ in self._imported(name, _statements(self.sources[name], loaded=True)):
                if imported in self.files:
                    waiting.append(imported)
                else:
                    outside.add(imported)
        return outside

    def _imported(
        self, name: Module, statements: Iterable[ast.AST]
    ) -> Iterator[tuple[Module, int]]:
        """The modules, with line numbers, that some statements of a module import."""
        is_package = self.files[name].name == "__init__.py"
        package = name.split(".") if is_package else name.split(".")[:-1]
        for node in statements:
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
        """The folder of a module, relative to the root.

        An `__init__.py` imports the other files of its folder to re-export them. So it counts as a
        separate folder, with the file's path as its name.
        """
        path = self.files[name]
        if self.room(name) == "verbs":
            return "verbs"
        return str((path if path.name == "__init__.py" else path.parent).relative_to(ROOT))


def _statements(node: ast.AST, *, loaded: bool = False) -> Iterator[ast.AST]:
    """All statements that a node contains, at any depth.

    Args:
        node: a module or a statement.
        loaded: only the statements that run when the module is imported. Statements in functions
            and those for type checkers do not.
    """
    for child in ast.iter_child_nodes(node):
        if not isinstance(child, ast.stmt | ast.ExceptHandler | ast.match_case):
            continue
        is_function = isinstance(child, ast.FunctionDef | ast.AsyncFunctionDef)
        if loaded and (is_function or _is_for_type_checkers(child)):
            continue
        yield child
        yield from _statements(child, loaded=loaded)


def _is_for_type_checkers(node: ast.AST) -> bool:
    return isinstance(node, ast.If) and "TYPE_CHECKING" in ast.dump(node.test)


def _module(path: Path) -> Module:
    parts = path.relative_to(ROOT).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def circle(graph: Mapping[str, Iterable[str]]) -> list[str]:
    """The nodes of a cycle of a graph; empty if the graph has no cycle."""
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


def test_modules_have_no_cyclic_imports(tree: Tree):
    found = circle(tree.imports)
    assert not found, " <- ".join(found)


def test_folders_have_no_cyclic_imports(tree: Tree):
    graph: dict[str, dict[str, str]] = defaultdict(dict)
    for name, imported in tree.imports.items():
        for other in imported:
            if tree.folder(name) != tree.folder(other):
                graph[tree.folder(name)].setdefault(tree.folder(other), tree.where(name, other))
    found = circle(graph)
    steps = [graph[above][below] for below, above in itertools.pairwise(found)]
    assert not found, "\n".join(steps)


def test_forbidden_external_imports(tree: Tree):
    wrong = []
    for name, packages in tree.outside.items():
        barred: set[str] = set()
        if tree.room(name) == "systems":
            barred = {"torch", "escnn"}
        if tree.room(name) in ("policies", "real_camera") or name == "systems.signals":
            barred = barred | {"pydrake"}
        wrong += [f"{tree.files[name].relative_to(ROOT)}: {item}" for item in packages & barred]
    assert not wrong, "\n".join(wrong)


LAZY = {
    "kitting_drake.run": {"torch", "escnn"},
    "kitting_drake.evaluate": {"torch", "escnn"},
    "kitting_drake.decide": {"pydrake", "torch", "escnn"},
    "kitting_drake.demonstrate": {"pydrake", "torch", "escnn"},
    "kitting_drake.train": {"pydrake"},
    "kitting_drake.gym": {"pydrake", "torch", "escnn"},
    "kitting_drake.gym.environment": {"torch", "escnn"},
    "kitting_drake.policies.learned_policy": {"pydrake", "escnn"},
    "kitting_drake.policies.networks.weights": {"pydrake", "escnn"},
    "kitting_drake.policies.matching.shape_matching": {"pydrake", "torch", "escnn"},
}
"""By module, the slow or optional packages that it may import only when they are needed."""


@pytest.mark.parametrize("name", LAZY)
def test_lazy_imports(tree: Tree, name: Module):
    loaded = {part for outside in tree.loaded(name) for part in outside.split(".")}
    assert {"numpy", "gymnasium"} & loaded
    assert not loaded & LAZY[name]


def test_the_real_camera_loads_no_drake(tree: Tree):
    modules = [name for name in tree.files if tree.room(name) == "real_camera"]
    assert not any(outside.startswith("pydrake") for outside in tree.loaded(*modules))


@pytest.mark.slow
def test_the_real_camera_loads_without_drake(tree: Tree):
    modules = [name for name in tree.files if tree.room(name) == "real_camera"]
    program = f"import sys; sys.modules['pydrake'] = None; import {', '.join(modules)}"
    done = subprocess.run([sys.executable, "-c", program], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def test_file_names_are_unique(tree: Tree):
    count = Counter(path.name for path in tree.files.values())
    twice = [
        str(path.relative_to(ROOT))
        for path in tree.files.values()
        if count[path.name] > 1 and path.name not in ("__init__.py", "__main__.py")
    ]
    assert not twice, "\n".join(twice)


def test_public_class_names_are_unique(tree: Tree):
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
