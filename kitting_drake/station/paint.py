"""Applies a scenario's colours, sheen and lights to the station."""

import colorsys
from collections.abc import Mapping
from fnmatch import fnmatchcase

import numpy as np
from pydrake.geometry import (
    GeometryId,
    IllustrationProperties,
    LightParameter,
    PerceptionProperties,
    RenderLabel,
    Rgba,
    Role,
    SceneGraph,
)
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import BodyIndex

from kitting_drake.common.errors import UserError
from kitting_drake.scenario.appearance import Appearance, Drawn, Fixed, Light, Paint
from systems.sensor_noise import SHEEN_LABELS

_COLOUR_STREAM, _LIGHT_STREAM = 11, 12
"""Numbers of this module's random streams: a generator is seeded with [seed, number]."""
_FLATTEST_LIGHT = 0.35
"""Least ratio between the downward and the horizontal component of a drawn light's direction."""


def paint_surfaces(
    plant: MultibodyPlant,
    scene_graph: SceneGraph,
    appearance: Appearance,
    groups: Mapping[BodyIndex, str],
    seed: int,
) -> None:
    """Paints the surfaces. Call it before cameras are added.

    Args:
        plant: the finalized plant.
        scene_graph: the scene graph of the plant.
        appearance: the appearance of the scenario.
        groups: `table`, `fixtures/NAME` or `objects/NAME` for each body.
        seed: the seed of the draws.

    Raises:
        UserError: a pattern matches no surface.
    """
    if not appearance.paints and not appearance.sheen:
        return
    surfaces = _surfaces(plant, scene_graph, groups)
    rng = np.random.default_rng([seed, _COLOUR_STREAM])
    for pattern, paint in appearance.paints.items():
        colour: Rgba | None = None
        for geometry in _matching(pattern, surfaces, "paints"):
            own = _own_colour(scene_graph, geometry)
            if colour is None or not (isinstance(paint, Drawn) and paint.shared):
                colour = _colour(paint, own, rng)
            _recolour(plant, scene_graph, geometry, colour)
    for pattern, share in appearance.sheen.items():
        for geometry in _matching(pattern, surfaces, "sheen"):
            properties = PerceptionProperties(
                scene_graph.model_inspector().GetPerceptionProperties(geometry)
            )
            properties.UpdateProperty("label", "id", RenderLabel(SHEEN_LABELS + round(100 * share)))
            _replace(plant, scene_graph, geometry, Role.kPerception, properties)


def lights_of(appearance: Appearance, seed: int) -> list[LightParameter]:
    """The lights of the cameras' renderer. If there are none, Drake puts its default light at each
    camera."""
    if appearance.drawn_lights is None:
        return [_light(item) for item in appearance.lights]
    rng = np.random.default_rng([seed, _LIGHT_STREAM])
    spread = appearance.drawn_lights
    count = int(rng.integers(1, 4))
    total = 1.0 + rng.uniform(-spread, spread)
    lights = []
    for share in rng.dirichlet(np.full(count, 2.0)):
        direction = np.append(rng.normal(size=2), 0.0)
        direction[2] = -rng.uniform(_FLATTEST_LIGHT, 1.5) * np.linalg.norm(direction[:2]) - 0.1
        direction /= np.linalg.norm(direction)
        tint = 1.0 - rng.uniform(0.0, 0.25 * spread, 3)
        lights.append(_light(Light(direction.tolist(), float(1.3 * total * share), tint.tolist())))
    return lights


def _light(light: Light) -> LightParameter:
    return LightParameter(
        type="directional",
        frame="world",
        direction=light.direction,
        intensity=light.intensity,
        color=Rgba(*light.rgb),
    )


def _surfaces(
    plant: MultibodyPlant, scene_graph: SceneGraph, groups: Mapping[BodyIndex, str]
) -> dict[str, list[GeometryId]]:
    """The visual geometries by name, in the order of the bodies."""
    inspector = scene_graph.model_inspector()
    surfaces: dict[str, list[GeometryId]] = {}
    for body, group in groups.items():
        frame = plant.GetBodyFrameIdOrThrow(body)
        for geometry in inspector.GetGeometries(frame, Role.kPerception):
            part = inspector.GetName(geometry).rpartition("::")[2]
            surfaces.setdefault(f"{group}/{part}", []).append(geometry)
    return surfaces


def _matching(pattern: str, surfaces: dict[str, list[GeometryId]], field: str) -> list[GeometryId]:
    found = [
        item for name, items in surfaces.items() if fnmatchcase(name, pattern) for item in items
    ]
    if not found:
        names = ", ".join(sorted(surfaces))
        raise UserError(f"appearance.{field}: no surface matches {pattern}; choose from {names}")
    return found


def _own_colour(scene_graph: SceneGraph, geometry: GeometryId) -> Rgba:
    properties = scene_graph.model_inspector().GetPerceptionProperties(geometry)
    return properties.GetPropertyOrDefault("phong", "diffuse", Rgba(0.9, 0.9, 0.9))


def _colour(paint: Paint, own: Rgba, rng: np.random.Generator) -> Rgba:
    if isinstance(paint, Fixed):
        return Rgba(*paint.rgb)
    if paint.spread is None:
        # Draw in HSV, which gives all hues, and also many grey and dark colours.
        return Rgba(*colorsys.hsv_to_rgb(*rng.uniform((0, 0, 0.12), (1, 1, 0.95))))
    near = np.array([own.r(), own.g(), own.b()]) + rng.uniform(-paint.spread, paint.spread, 3)
    return Rgba(*np.clip(near, 0.0, 1.0))


def _recolour(
    plant: MultibodyPlant, scene_graph: SceneGraph, geometry: GeometryId, colour: Rgba
) -> None:
    """Recolours a surface for the cameras and for Meshcat."""
    inspector = scene_graph.model_inspector()
    seen = PerceptionProperties(inspector.GetPerceptionProperties(geometry))
    seen.UpdateProperty("phong", "diffuse", colour)
    _replace(plant, scene_graph, geometry, Role.kPerception, seen)
    drawn = scene_graph.model_inspector().GetIllustrationProperties(geometry)
    if drawn is not None:
        shown = IllustrationProperties(drawn)
        shown.UpdateProperty("phong", "diffuse", colour)
        _replace(plant, scene_graph, geometry, Role.kIllustration, shown)


def _replace(
    plant: MultibodyPlant,
    scene_graph: SceneGraph,
    geometry: GeometryId,
    role: Role,
    properties: PerceptionProperties | IllustrationProperties,
) -> None:
    """Replaces a geometry's properties for a role. `AssignRole` alone cannot replace perception
    properties, and prints a warning for illustration properties."""
    source = plant.get_source_id()
    scene_graph.RemoveRole(source, geometry, role)
    scene_graph.AssignRole(source, geometry, properties)
