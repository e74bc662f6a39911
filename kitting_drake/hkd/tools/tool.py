"""Tools: folders with an SDFormat model, its meshes and a record (`tool.yaml`)."""

import dataclasses
import difflib
import math
import os
import re
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property, lru_cache
from pathlib import Path

import numpy as np
import yaml
from manifold3d import CrossSection, FillRule
from numpy.typing import NDArray

from kitting_drake.common.errors import UserError
from kitting_drake.common.paths import MODELS
from systems.grasp import Grasp

CATEGORIES = ("hammer", "pliers", "wrench", "screwdriver")
"""The four categories of the paper (section IV-B.1). User tools may have others."""

SHORTEST_MM, LONGEST_MM = 15.0, 350.0
"""The shortest and the longest length of a user's tool, in mm."""

_ROUND = 0.98
"""An outline is a circle if its area is more than this share of that of the circle around it. A
regular polygon of 20 sides has 0.984."""

# libyaml reads records ten times as fast as PyYAML's own loader.
RecordLoader = getattr(yaml, "CSafeLoader", yaml.SafeLoader)


@dataclass(frozen=True)
class Tool:
    """One hand tool.

    The tool frame T has z up in the tool's stable pose, with the table at z = 0. The x axis is
    along the tool's length, toward the working end. The origin is centred in the footprint's
    bounding box.
    """

    directory: Path
    """The folder of the SDFormat model."""
    name: str
    category: str
    """One of `CATEGORIES`, or another name of lower-case letters, digits and underscores."""
    split: str
    """The split: `train` or `test` (section IV-B.1 of the paper), `fresh` (reserved for a final
    test), or `user` for a user's own tool."""
    length: float
    """The extent of the bounding box along x of T, in metres."""
    width: float
    """The extent of the bounding box along y of T, in metres."""
    height: float
    """The extent of the bounding box along z of T, in metres."""
    mass: float
    """The mass in kg."""
    grasp: Grasp
    visual_meshes: tuple[Path, ...]
    """The OBJ files of the visual surface. The name of each file is its material."""
    symmetry: int = 1
    """The order of the rotational symmetry about T's z. 1 means none. 2 means that the tool may
    also lie in its cavity turned by a half turn."""
    scale: float = 1.0
    """The factor by which the meshes in the visual files are scaled."""
    other_grasps: tuple[Grasp, ...] = ()
    """More grasps, best first, to try after `grasp` has failed."""
    outline_error: float = 0.0
    """How far the real tool may extend beyond its outline, in metres, for instance because it was
    traced from a photo."""

    @property
    def grasps(self) -> tuple[Grasp, ...]:
        """All grasps, best first."""
        return (self.grasp, *self.other_grasps)

    @property
    def sdf(self) -> Path:
        """The SDFormat model, with one free link `tool` whose body frame is T."""
        return self.directory / f"{self.name}.sdf"

    @cached_property
    def parts(self) -> tuple[tuple[str, NDArray[np.float64]], ...]:
        """The material and the surface triangles (n, 3, 3) of each part, in T, in metres.

        Raises:
            UserError: a file is not a mesh.
        """
        read = [(path.stem, _read_triangles(path)) for path in self.visual_meshes]
        return tuple((name, t if self.scale == 1.0 else self.scale * t) for name, t in read)

    @cached_property
    def triangles(self) -> NDArray[np.float64]:
        """The triangles (n, 3, 3) of the visual surface, in T, in metres.

        Raises:
            UserError: a file is not a mesh.
        """
        triangles = np.concatenate([triangles for _, triangles in self.parts])
        triangles.flags.writeable = False
        return triangles

    @cached_property
    def footprint(self) -> CrossSection:
        """The outline seen from above, in T, in metres."""
        return footprint(self.triangles)

    @cached_property
    def is_round(self) -> bool:
        """Whether the outline is a circle, so that a cavity takes the tool at any heading. Holes
        do not matter."""
        outlines = (CrossSection([part]) for part in self.footprint.to_polygons())
        outer = max(outlines, key=CrossSection.area)
        points = np.concatenate(outer.to_polygons())
        middle = (points.min(axis=0) + points.max(axis=0)) / 2
        circle = math.pi * float(np.square(points - middle).sum(axis=1).max())
        return bool(outer.area() > _ROUND * circle)

    @property
    def axis(self) -> tuple[float, float] | None:
        """The point (x, y) of the axis of symmetry in T, in metres.

        If the order of the symmetry is odd and at least 3, this is the footprint's centroid.
        Otherwise it is None, which stands for the middle of the bounding box.
        """
        if self.symmetry < 3 or self.symmetry % 2 == 0:
            return None
        return centroid(self.footprint)

    def surface_points(self, count: int, seed: int = 0) -> NDArray[np.float64]:
        """Returns random points (count, 3), uniform on the surface, in T, in metres.

        Equal seeds give equal points.
        """
        import trimesh

        faces = np.arange(3 * len(self.triangles)).reshape(-1, 3)
        mesh = trimesh.Trimesh(self.triangles.reshape(-1, 3), faces, process=False)
        points, _ = trimesh.sample.sample_surface(mesh, count, seed=seed)
        return np.asarray(points, dtype=float)


def _read_triangles(path: Path) -> NDArray[np.float64]:
    import trimesh

    try:
        triangles = np.asarray(trimesh.load_mesh(path, process=False).triangles, dtype=float)
    except (OSError, ValueError, TypeError, AttributeError, IndexError, KeyError) as error:
        raise UserError(f"{path} is not a readable mesh: {error}") from error
    if not len(triangles) or not np.isfinite(triangles).all():
        raise UserError(f"{path} has no triangles, or has vertices that are not finite")
    triangles.flags.writeable = False
    return triangles


def footprint(triangles: NDArray[np.float64]) -> CrossSection:
    """Returns the union of triangles (n, 3, 3) projected along z; the mesh may be open."""
    flat = np.array(triangles[:, :, :2], dtype=float)
    edge_1, edge_2 = flat[:, 1] - flat[:, 0], flat[:, 2] - flat[:, 0]
    area = edge_1[:, 0] * edge_2[:, 1] - edge_1[:, 1] * edge_2[:, 0]
    flat[area < 0] = flat[area < 0, ::-1]
    return CrossSection(list(flat[np.abs(area) > 1e-12]), FillRule.NonZero)


def centroid(outline: CrossSection) -> tuple[float, float]:
    """Returns the centroid of the area that an outline encloses."""
    area, moment = 0.0, np.zeros(2)
    for loop in outline.to_polygons():
        start = np.asarray(loop, dtype=float)
        end = np.roll(start, -1, axis=0)
        cross = start[:, 0] * end[:, 1] - start[:, 1] * end[:, 0]
        area += cross.sum() / 2
        moment += ((start + end) * cross[:, None]).sum(axis=0) / 6
    x, y = (moment / area).tolist()
    return x, y


def load_tool(name: str, base: Path | None = None) -> Tool:
    """Loads a tool by its name in `models/tools` or `user_tools`, or by its folder's path.

    Args:
        name: a name, or a path that is absolute or relative to `base`. If several tools match, the
            first of these is chosen: the project's own tool, the user's tool, the path.
        base: the folder to which relative paths refer; the working directory if None.

    Raises:
        UserError: the tool does not exist, or its record or a mesh is missing or broken.
    """
    if "\0" in name:
        raise UserError(f"there is no tool {name!r}")
    directory = ((base or Path.cwd()) / name).resolve()
    if Path(name).name == name:
        for folder in (user_tools(), MODELS / "tools"):
            if (folder / name / "tool.yaml").is_file():
                directory = folder / name
    record_path = directory / "tool.yaml"
    if not record_path.is_file():
        close = difflib.get_close_matches(name, [*tool_names(), *user_tool_names()], n=1)
        advice = f"did you mean '{close[0]}'?" if close else "`hkd list` lists all tools"
        raise UserError(
            f"there is no tool '{name}', and no folder of that name with a tool.yaml: {advice}"
        )
    try:
        record = yaml.load(record_path.read_text(), Loader=RecordLoader)
        tool = Tool(
            directory=directory,
            name=str(record["name"]),
            category=str(record["category"]),
            split=str(record["split"]),
            length=float(record["length"]),
            width=float(record["width"]),
            height=float(record["height"]),
            mass=float(record["mass"]),
            grasp=_read_grasp(record["grasp"]),
            visual_meshes=tuple(directory / str(path) for path in record["visual_meshes"]),
            symmetry=int(record.get("symmetry", 1)),
            other_grasps=tuple(map(_read_grasp, record.get("other_grasps", ()))),
            outline_error=float(record.get("outline_error", 0.0)),
        )
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        where = f" from line {mark.line + 1} on" if mark else ""
        raise UserError(f"{record_path} is not a tool record: it is not YAML{where}") from error
    except KeyError as error:
        raise UserError(f"{record_path} is not a tool record: it lacks {error}") from error
    except (TypeError, ValueError, AttributeError) as error:
        raise UserError(
            f"{record_path} is not a tool record: a field has a wrong value ({error})"
        ) from error
    for path in (tool.sdf, *tool.visual_meshes):
        if not path.is_file():
            raise UserError(f"the tool '{name}' lacks its file {path}")
    try:
        check_category(tool.category)
    except UserError as error:
        raise UserError(f"{record_path}: {error}") from error
    sizes = {
        **{name: getattr(tool, name) for name in ("length", "width", "height", "mass")},
        "grasp.width": min(grasp.width for grasp in tool.grasps),
    }
    for name, value in sizes.items():
        if not 0 < value < math.inf:
            raise UserError(f"{record_path}: {name} is {value:g}; it must be positive")
    if not np.isfinite([dataclasses.astuple(grasp) for grasp in tool.grasps]).all():
        raise UserError(f"{record_path}: grasp must consist of finite numbers")
    if not 0 <= tool.outline_error < math.inf:
        raise UserError(
            f"{record_path}: outline_error is {tool.outline_error:g}; it must be 0 or more"
        )
    if tool.symmetry < 1:
        raise UserError(f"{record_path}: symmetry is {tool.symmetry}; it must be 1 or more")
    return _shared(tool, tuple(path.stat().st_mtime_ns for path in tool.visual_meshes))


def _read_grasp(record: Mapping[str, float]) -> Grasp:
    return Grasp(**{key: float(value) for key, value in record.items()})


@lru_cache(maxsize=32)
def _shared(tool: Tool, changed: tuple[int, ...]) -> Tool:
    """Returns one shared instance for equal tools, so that their meshes are read once.

    Args:
        tool: a tool.
        changed: the modification times of the tool's meshes, which are part of the cache key.
    """
    return tool


def check_category(category: str) -> None:
    """Raises UserError if a text is not valid as the name of a category."""
    if not re.fullmatch(r"[a-z][a-z0-9_]{0,31}", category):
        raise UserError(
            f"category '{category}' is not valid: give at most 32 lower-case letters, digits and "
            f"underscores, beginning with a letter (such as {', '.join(CATEGORIES)})"
        )


def tool_names() -> list[str]:
    """Returns the names of the project's tools."""
    return sorted(path.parent.name for path in (MODELS / "tools").glob("*/tool.yaml"))


def user_tools() -> Path:
    """Returns the folder of the user's tools.

    It is `$KITTING_DRAKE_TOOLS`, or else a folder in `~/.local/share`.
    """
    given = os.environ.get("KITTING_DRAKE_TOOLS")
    return (
        Path(given).absolute()
        if given
        else Path.home() / ".local" / "share" / "kitting_drake" / "tools"
    )


def user_tool_names() -> list[str]:
    """Returns the names of the tools in `user_tools`."""
    # Skip folders whose names begin with a dot, because they are unfinished.
    records = user_tools().glob("[!.]*/tool.yaml")
    return sorted(path.parent.name for path in records)
