"""Lets bodies fall and come to rest on the table, before an episode begins."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from pydrake.geometry import (
    AddCompliantHydroelasticProperties,
    AddContactMaterial,
    AddRigidHydroelasticProperties,
    Box,
    Convex,
    ProximityProperties,
)
from pydrake.math import RigidTransform
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import (
    AddMultibodyPlant,
    CoulombFriction,
    MultibodyPlant,
    MultibodyPlantConfig,
)
from pydrake.multibody.tree import RigidBody, RotationalInertia, SpatialInertia, UnitInertia
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder

from kitting_drake.common.sdformat import model_text
from kitting_drake.hkd.tools.sdf import FRICTION, HUNT_CROSSLEY_DISSIPATION, HYDROELASTIC_MODULUS

# Use the contact model of episodes, so that bodies that have settled stay at rest when the episode
# begins. With point contact nothing comes to rest, and longer steps are not faster.
_CONTACT = MultibodyPlantConfig(
    time_step=1 / 128, contact_model="hydroelastic", discrete_contact_approximation="lagged"
)

_TABLE_SIZE = (1.0, 1.5, 0.1)
_TABLE_MIDDLE = (0.5, 0.0, -0.05)
_FRICTION = CoulombFriction(FRICTION, FRICTION)
_SIZE_HINT = 2.0
_BLOCK_FRICTION = CoulombFriction(0.3, 0.3)

_CHECKS = 1 / 16
"""Time between two checks for rest, in s; a multiple of the time step."""
_STILL = 4
"""Bodies are at rest if they pass this many checks in a row, as in `RestDetector`. Velocities are
not checked, because a flat body on a plane may chatter without changing its place."""
_POSITION, _ANGLE = 0.0003, 0.01
"""Bodies pass a check if, since the last failed check, each has moved by less than `_POSITION`, in
metres, and turned by less than `_ANGLE`, in radians."""


@dataclass(frozen=True)
class ConvexBody:
    """A free body that consists of convex pieces, in its frame B and in SI units."""

    pieces: tuple[NDArray[np.float64], ...]
    """For each piece, points (n, 3) whose convex hull is the piece."""
    mass: float
    center_of_mass: NDArray[np.float64]
    inertia: NDArray[np.float64]
    """(3, 3) rotational inertia about the centre of mass, in kg m^2."""


@dataclass(frozen=True)
class StillBlock:
    """A box that never moves."""

    size: tuple[float, float, float]
    """Side lengths of the box, in metres."""
    X_WB: RigidTransform
    """World pose of the middle of the box's bottom."""


SettlingModel = Path | ConvexBody
"""A body that can settle: an SDFormat file of one free link, or a body of convex pieces."""
Still = StillBlock | tuple[Path, RigidTransform]
"""A body that never moves: a box, or an SDFormat file of one link with its pose in the world."""


def settle(
    models: Sequence[SettlingModel],
    poses: Sequence[RigidTransform],
    still: Sequence[Still],
    *,
    longest: float = 3.0,
    goes_on: Callable[[Sequence[RigidTransform]], bool] = lambda poses: True,
) -> list[RigidTransform] | None:
    """Simulates bodies from given poses until they are at rest. The result is deterministic.

    Args:
        models: the n bodies.
        poses: X_WB of each of the n bodies at the start; their velocities are zero.
        still: bodies on the table that do not move.
        longest: limit of the simulated time, in s.
        goes_on: a function that gets the poses at regular intervals and returns whether to
            continue.

    Returns:
        X_WB of each body; None if they did not come to rest, if the contact solver did not
        converge, or if `goes_on` returned False.
    """
    builder = DiagramBuilder()
    plant, _ = AddMultibodyPlant(_CONTACT, builder)
    parser = Parser(plant)
    parser.SetAutoRenaming(True)
    _add_box(plant, _TABLE_SIZE, RigidTransform(_TABLE_MIDDLE), _FRICTION, "table")
    for number, item in enumerate(still):
        if isinstance(item, StillBlock):
            X_WMiddle = item.X_WB @ RigidTransform([0, 0, item.size[2] / 2])
            _add_box(plant, item.size, X_WMiddle, _BLOCK_FRICTION, f"still_{number}")
        else:
            path, X_WF = item
            plant.WeldFrames(plant.world_frame(), _add_model(parser, path).body_frame(), X_WF)
    bodies = [_add(plant, parser, model, number) for number, model in enumerate(models)]
    plant.Finalize()
    simulator = Simulator(builder.Build())
    context = plant.GetMyMutableContextFromRoot(simulator.get_mutable_context())
    for body, X_WB in zip(bodies, poses, strict=True):
        plant.SetFreeBodyPose(context, body, X_WB)

    passed, reference = 0, list(poses)
    for check in range(1, round(longest / _CHECKS) + 1):
        try:
            simulator.AdvanceTo(check * _CHECKS)
        except RuntimeError as error:
            if "converge" not in str(error):
                raise
            return None
        now = [body.EvalPoseInWorld(context) for body in bodies]
        if not goes_on(now):
            return None
        if all(map(_is_near, reference, now)):
            passed += 1
        else:
            passed, reference = 0, now
        if passed == _STILL:
            return now
    return None


def _is_near(X_WB: RigidTransform, other: RigidTransform) -> bool:
    X = X_WB.InvertAndCompose(other)
    return bool(
        np.linalg.norm(X.translation()) < _POSITION and X.rotation().ToAngleAxis().angle() < _ANGLE
    )


def _add(plant: MultibodyPlant, parser: Parser, model: SettlingModel, number: int) -> RigidBody:
    if isinstance(model, Path):
        return _add_model(parser, model)
    inertia = RotationalInertia(*model.inertia.diagonal(), *model.inertia[[0, 0, 1], [1, 2, 2]])
    unit = UnitInertia().SetFromRotationalInertia(inertia, model.mass)
    body = plant.AddRigidBody(
        f"settling_{number}",
        SpatialInertia(
            model.mass, model.center_of_mass, unit.ShiftFromCenterOfMass(-model.center_of_mass)
        ),
    )
    properties = ProximityProperties()
    AddCompliantHydroelasticProperties(_SIZE_HINT, HYDROELASTIC_MODULUS, properties)
    AddContactMaterial(
        dissipation=HUNT_CROSSLEY_DISSIPATION, friction=_FRICTION, properties=properties
    )
    for index, points in enumerate(model.pieces):
        plant.RegisterCollisionGeometry(
            body,
            RigidTransform(),
            Convex(points.T, f"piece_{index}"),
            f"{number}_{index}",
            properties,
        )
    return body


def _add_model(parser: Parser, path: Path) -> RigidBody:
    text = model_text(path)
    models = parser.AddModelsFromString(text, "sdf") if text else parser.AddModels(str(path))
    plant = parser.plant()
    (index,) = [index for model in models for index in plant.GetBodyIndices(model)]
    return plant.get_body(index)


def _add_box(
    plant: MultibodyPlant,
    size: Sequence[float],
    X_WMiddle: RigidTransform,
    friction: CoulombFriction,
    name: str,
) -> None:
    properties = ProximityProperties()
    AddRigidHydroelasticProperties(_SIZE_HINT, properties)
    AddContactMaterial(dissipation=5.0, friction=friction, properties=properties)
    plant.RegisterCollisionGeometry(plant.world_body(), X_WMiddle, Box(*size), name, properties)
