"""Random tools for training: shapes that are not in the catalogue.

Many are designs of the training split with random proportions. Others are composed of simple
solids, such as mallets, keys, scrapers and chisels, or are simple parts (`random_parts`). All are
randomly stretched, widened toward one end, bent and mirrored. They have surfaces and grasps, but no
collision geometry and no files.
"""

import copy
import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from manifold3d import CrossSection, Manifold, OpType
from numpy.typing import NDArray
from scipy.spatial import QhullError

from kitting_drake.common.errors import UserError
from kitting_drake.hkd.generation.catalogue import ToolEntry
from kitting_drake.hkd.generation.generate import (
    DESIGNS,
    build_parts,
    homogeneous,
    rest_rotation,
)
from kitting_drake.hkd.generation.random_parts import draw_solid
from kitting_drake.hkd.grasps.proposals import GraspProposal, propose_grasps
from kitting_drake.hkd.tools.mass import mass_properties
from kitting_drake.hkd.tools.meshes import vertices_and_faces
from kitting_drake.hkd.tools.tool import Tool

Array = NDArray[np.float64]

_LENGTHS, _SHORT, _LONG = (0.11, 0.23), (0.05, 0.11), (0.23, 0.32)
"""The ranges of the lengths of usual, short and long tools, in metres."""
_UNUSUAL = 0.12
"""The probability that a length is drawn from `_SHORT`. It is the same for `_LONG`."""
_HIGHEST = 0.046
"""The largest height that fits into a kit's block, in metres."""
_COMPOSED, _PARTS = 0.2, 0.3
"""The share of random tools that are composed of simple solids, and the share of simple parts."""
_JITTER = 0.22
"""The logarithm of the largest factor by which a length or an angle of a design changes."""
_REFINED = 6.0
"""Before the warp, triangles are divided until no edge is longer than this, in mm."""
_SIMPLIFIED = 0.08
"""The tolerance of the simplification after the warp, in mm."""
_POOR_GRASP = 3.0
"""The cost above which grasps are not used; see `GraspProposal.cost`."""
_ATTEMPTS = 40


@dataclass(frozen=True)
class RandomTool(Tool):
    """A tool without files."""

    surface: Array = field(default_factory=lambda: np.zeros((0, 3, 3)), repr=False)
    """The triangles (n, 3, 3) of the surface in T, in metres."""
    grasps: tuple[GraspProposal, ...] = ()
    """The possible grasps, best first."""

    @property
    def triangles(self) -> Array:
        return self.surface


def draw_tool(entries: Sequence[ToolEntry], rng: np.random.Generator, name: str) -> RandomTool:
    """Draws a random tool that rests on the table and that the hand can hold.

    Args:
        entries: the designs to vary.
        rng: the random generator of all draws.
        name: the name of the tool.

    Raises:
        UserError: no attempt gave a usable tool.
    """
    for _ in range(_ATTEMPTS):
        try:
            tool = _attempt(entries, rng, name)
        except (UserError, QhullError, ValueError, ZeroDivisionError, IndexError, TypeError):
            # Try again, because contradictory proportions make no solid.
            continue
        if tool is not None:
            return tool
    raise UserError(f"none of {_ATTEMPTS} attempts drew a usable random tool")


def _attempt(
    entries: Sequence[ToolEntry], rng: np.random.Generator, name: str
) -> RandomTool | None:
    kind = rng.random()
    length: float | None = _draw_length(rng)
    if kind < _COMPOSED:
        category, whole = "composed", _composed(rng)
        center = _centroid(whole)
    elif kind < _COMPOSED + _PARTS:
        category, whole, length = "part", draw_solid(rng), None
        center = _centroid(whole)
    else:
        entry = entries[int(rng.integers(len(entries)))]
        category = entry.category
        parts = build_parts(_varied(entry, rng))
        center = 1e3 * mass_properties(homogeneous(parts))[1]
        whole = Manifold.batch_boolean([part.solid for part in parts], OpType.Add)
    if sum(body.volume() > 1e-3 for body in whole.decompose()) != 1:
        return None
    warp = _Warp.draw(whole, rng)
    whole = whole.refine_to_length(_REFINED).warp_batch(warp)
    center = warp(center[None])[0]
    if rng.random() < 0.5:
        whole, center = whole.mirror((0, 1, 0)), center * (1, -1, 1)
    vertices, faces = vertices_and_faces(whole.simplify(_SIMPLIFIED))
    rotation = rest_rotation(vertices, center)
    vertices, center = vertices @ rotation.T, rotation @ center
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    origin = np.append((low + high)[:2] / 2, low[2])
    scale = 1e-3 if length is None else length / float((high - low)[:2].max())
    vertices, center = (vertices - origin) * scale, (center - origin) * scale
    size = (high - low) * scale
    if size[2] > _HIGHEST or size[2] < 0.005:
        return None
    triangles = vertices[faces]
    grasps = [g for g in propose_grasps(triangles, center) if g.cost < _POOR_GRASP]
    if not grasps:
        return None
    return RandomTool(
        directory=Path(name),
        name=name,
        category=category,
        split="train",
        length=float(size[0]),
        width=float(size[1]),
        height=float(size[2]),
        mass=0.1,
        grasp=grasps[0].grasp,
        visual_meshes=(),
        surface=triangles,
        grasps=tuple(grasps),
    )


def _draw_length(rng: np.random.Generator) -> float:
    """Draws a tool's length, in metres."""
    kind = rng.random()
    ranges = _SHORT if kind < _UNUSUAL else _LONG if kind > 1 - _UNUSUAL else _LENGTHS
    return float(rng.uniform(*ranges))


def _varied(entry: ToolEntry, rng: np.random.Generator) -> ToolEntry:
    """Returns an entry with random proportions. The parameters vary around the values in the given
    entry, or around their defaults if the entry lacks them."""
    defaults = DESIGNS[entry.category][0]()
    parameters = {
        key: value for key, value in vars(defaults).items() if isinstance(value, float)
    } | copy.deepcopy(entry.parameters)
    spread = rng.uniform(0.0, _JITTER)
    varied = {key: _jittered(key, value, rng, spread) for key, value in parameters.items()}
    if "handle_spread_mm" in varied:
        varied["handle_spread_mm"] *= rng.uniform(0.5, 1.7)
    return ToolEntry(entry.name, entry.category, "train", 180.0, entry.grasp, varied)


def _jittered(key: str, value: Any, rng: np.random.Generator, spread: float) -> Any:
    if isinstance(value, dict):
        return {name: _jittered(name, item, rng, spread) for name, item in value.items()}
    if isinstance(value, bool) or not isinstance(value, int | float):
        return value
    if not key.endswith(("_mm", "_deg", "_share", "flatness", "curve")):
        return value
    factor = math.exp(rng.uniform(-spread, spread))
    return min(value * factor, max(value, 0.95)) if "share" in key else value * factor


@dataclass(frozen=True)
class _Warp:
    """A random deformation of points (n, 3) in mm.

    It stretches the tool along y and z, widens it toward one end, and bends it sideways.
    """

    low: float
    """The least x of the tool, in mm."""
    length: float
    """The length of the tool along x, in mm."""
    stretch: Array
    """The factors (2,) along y and z."""
    splay: float
    """The factor of the width is 1 + splay at the end toward +x, 1 in the middle, and 1 - splay at
    the other end."""
    bend: Array
    """The sideways offset is bend[0] u^2 + bend[1] u^3. The unit of the offset and of u is half the
    tool's length, so u is -1 and 1 at the ends of the tool."""

    @classmethod
    def draw(cls, solid: Manifold, rng: np.random.Generator) -> "_Warp":
        box = solid.bounding_box()
        stretch = np.exp(rng.uniform(-0.25, 0.25, 2)) if rng.random() < 0.7 else np.ones(2)
        splay = rng.uniform(-0.3, 0.3) if rng.random() < 0.4 else 0.0
        bend = rng.normal(0.0, 0.05, 2) if rng.random() < 0.35 else np.zeros(2)
        return cls(box[0], box[3] - box[0], stretch, splay, bend)

    def __call__(self, points: Array) -> Array:
        points = np.array(points, float)
        u = 2 * (points[:, 0] - self.low) / self.length - 1
        points[:, 1] *= self.stretch[0] * (1 + self.splay * u)
        points[:, 2] *= self.stretch[1]
        points[:, 1] += self.length / 2 * (self.bend[0] * u**2 + self.bend[1] * u**3)
        return points


def _centroid(solid: Manifold) -> Array:
    vertices, faces = vertices_and_faces(solid)
    a, b, c = np.moveaxis(vertices[faces], 1, 0)
    volumes = np.einsum("ij,ij->i", a, np.cross(b, c))
    return (volumes[:, None] * (a + b + c)).sum(axis=0) / (4 * volumes.sum())


def _composed(rng: np.random.Generator) -> Manifold:
    """Draws a lying shaft along x with one to four solids at its ends or between them, in mm."""
    length = 180.0
    width, height = rng.uniform(6, 30), rng.uniform(5, 28)
    solid = _bar(length, width, height, rng)
    for _ in range(int(rng.integers(1, 5))):
        place = length * float(rng.choice([-0.5, 0.5, rng.uniform(-0.4, 0.4)], p=[0.4, 0.4, 0.2]))
        kind = rng.choice(["block", "disc", "ring", "bar", "fork"], p=[0.3, 0.2, 0.15, 0.2, 0.15])
        tall = rng.uniform(0.4, 1.3) * height
        if kind == "block":
            item = Manifold.cube((rng.uniform(12, 50), rng.uniform(15, 90), tall), True)
        elif kind == "disc":
            item = Manifold.cylinder(tall, rng.uniform(8, 28), circular_segments=40, center=True)
        elif kind == "ring":
            outer = rng.uniform(12, 30)
            ring = CrossSection.circle(outer, 40) - CrossSection.circle(
                outer * rng.uniform(0.35, 0.75), 40
            )
            item = ring.extrude(tall).translate((0, 0, -tall / 2))
            # Put the ring just beyond the end of the shaft.
            place = math.copysign(length / 2 + 0.8 * outer, place)
        elif kind == "fork":
            spread, long = rng.uniform(8, 25), rng.uniform(20, 60)
            prong = Manifold.cube((long, rng.uniform(4, 10), tall), True)
            bridge = Manifold.cube((8.0, 2 * spread, tall), True).translate((-long / 2, 0, 0))
            item = (
                prong.translate((0, spread, 0)) + prong.translate((0, -spread, 0)) + bridge
            ).rotate((0, 0, 0 if place > 0 else 180))
            place = math.copysign(length / 2 + long / 2, place)
        else:
            item = _bar(rng.uniform(30, 90), rng.uniform(6, 20), tall, rng).rotate(
                (0, 0, rng.uniform(30, 150))
            )
        solid += item.translate((place, rng.normal(0, 3), 0))
    return solid


def _bar(length: float, width: float, height: float, rng: np.random.Generator) -> Manifold:
    """Draws a bar along x with a rectangular, rounded or elliptic section, which may taper."""
    kind = rng.integers(3)
    if kind == 0:
        section = CrossSection.square((width, height), True)
    elif kind == 1:
        radius = 0.3 * min(width, height)
        section = CrossSection.square((width - 2 * radius, height - 2 * radius), True).offset(
            radius, circular_segments=24
        )
    else:
        section = CrossSection.circle(0.5, 32).scale((width, height))
    top = (rng.uniform(0.5, 1.0), rng.uniform(0.7, 1.0))
    bar = section.extrude(length, scale_top=top).translate((0, 0, -length / 2))
    # Turn the extrusion from z to x, so that the section's width is along y and its height along z.
    return bar.rotate((0, 90, 0)).rotate((90, 0, 0))
