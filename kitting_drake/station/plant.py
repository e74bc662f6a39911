"""Builds the station's plant with table, fixtures and objects. The module `robot` adds the
robot."""

from pathlib import Path

import numpy as np
from pydrake.geometry import SceneGraph
from pydrake.math import RigidTransform
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import AddMultibodyPlant, MultibodyPlant
from pydrake.multibody.tree import BodyIndex, ModelInstanceIndex, RigidBody
from pydrake.systems.framework import DiagramBuilder

from kitting_drake.common.errors import UserError
from kitting_drake.common.paths import MODELS
from kitting_drake.common.sdformat import model_text
from kitting_drake.scenario.schema import Scenario, Variation
from kitting_drake.tasks.task import Scene
from systems.placement import PlacedObject
from systems.rest_detector import BoundedBody, Box

_X_WTABLE = RigidTransform([0.5, 0.0, 0.0])

_VARIATION_STREAM = 13
"""Number of this module's random stream: a generator is seeded with [seed, number]."""


def add_plant(builder: DiagramBuilder, scenario: Scenario) -> tuple[MultibodyPlant, SceneGraph]:
    """Adds an empty plant and its scene graph."""
    return AddMultibodyPlant(scenario.plant, builder)


def add_models(
    plant: MultibodyPlant, scene: Scene, variation: Variation, seed: int
) -> tuple[tuple[PlacedObject, ...], tuple[BodyIndex, ...]]:
    """Adds the table, and the scene's fixtures and objects.

    Args:
        plant: not finalized yet.
        scene: the scene of the episode.
        variation: ranges of the random variation of friction and mass.
        seed: the seed of the draws.

    Returns:
        The scene's objects with their bodies, and the bodies that never move: table, then fixtures.

    Raises:
        UserError: a model cannot be loaded, or does not have exactly one link.
    """
    parser = Parser(plant)
    # Allow a model to occur several times.
    parser.SetAutoRenaming(True)
    parser.package_map().AddPackageXml(str(MODELS / "package.xml"))
    rng = np.random.default_rng([seed, _VARIATION_STREAM])

    def add(model: Path) -> RigidBody:
        friction, mass = 1 + rng.uniform(-1, 1, 2) * (
            variation.friction,
            variation.mass,
        )
        return _add_body(parser, plant, model, float(friction), float(mass))

    still = [add(MODELS / "table" / "table.sdf")]
    plant.WeldFrames(plant.world_frame(), still[0].body_frame(), _X_WTABLE)
    for fixture in scene.fixtures:
        still.append(add(fixture.model))
        plant.WeldFrames(plant.world_frame(), still[-1].body_frame(), fixture.X_WF)
    objects = []
    for item in scene.objects:
        body = add(item.model)
        # Make a copy, because a view would keep the plant in memory.
        com = np.array(body.default_com())
        objects.append(
            PlacedObject(
                item.name, body.index(), item.p_BPoints, item.symmetry, item.axis, p_BCom=com
            )
        )
    return tuple(objects), tuple(body.index() for body in still)


def _add_model(
    parser: Parser, model: Path, friction: float = 1.0, mass: float = 1.0
) -> list[ModelInstanceIndex]:
    text = model_text(model, friction=friction, mass=mass)
    if text is None:
        return parser.AddModels(str(model))
    return parser.AddModelsFromString(text, "sdf")


def _add_body(
    parser: Parser, plant: MultibodyPlant, model: Path, friction: float, mass: float
) -> RigidBody:
    """Adds a model of one link, with scaled friction coefficients and mass."""
    try:
        instances = _add_model(parser, model, friction, mass)
    except (RuntimeError, ValueError) as error:
        reason = str(error).splitlines()[0]
        raise UserError(f"task: cannot load {model}: {reason}") from error
    bodies = [body for instance in instances for body in plant.GetBodyIndices(instance)]
    if len(bodies) != 1:
        raise UserError(f"task: {model} must have one link, not {len(bodies)}")
    return plant.get_body(bodies[0])


def set_initial_poses(
    plant: MultibodyPlant, scene: Scene, objects: tuple[PlacedObject, ...]
) -> None:
    """Sets the default poses of the objects to the initial poses of the scene."""
    for placed, item in zip(objects, scene.objects, strict=True):
        plant.SetDefaultFloatingBaseBodyPose(plant.get_body(placed.body), item.X_WB)


def bounded_body(plant: MultibodyPlant, scene_graph: SceneGraph, body: RigidBody) -> BoundedBody:
    """Returns a body with one box around each of its collision geometries."""
    inspector = scene_graph.model_inspector()
    boxes = []
    for geometry in plant.GetCollisionGeometriesForBody(body):
        box = inspector.GetObbInGeometryFrame(geometry)
        X_BBox = inspector.GetPoseInFrame(geometry) @ box.pose()
        boxes.append(Box(X_BBox, np.asarray(box.half_width())))
    return BoundedBody(body.index(), boxes)
