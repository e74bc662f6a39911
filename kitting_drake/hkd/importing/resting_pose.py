"""Simulates in which pose an imported tool comes to rest.

Geometry alone accepts poses that a real tool does not keep: a screwdriver that balances on its
handle tips over at a touch. Therefore the tool is dropped onto a table from a small height.
"""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from pydrake.geometry import (
    AddContactMaterial,
    AddRigidHydroelasticProperties,
    HalfSpace,
    ProximityProperties,
)
from pydrake.math import RigidTransform, RollPitchYaw
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import (
    AddMultibodyPlant,
    CoulombFriction,
    MultibodyPlantConfig,
)
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder

from kitting_drake.common.sdformat import model_text

_DROP = 0.002
"""The height from which the tool is dropped, in metres."""
_SETTLE = 2.0
"""The simulated time after which the tool counts as at rest, in seconds."""
_STEP, _SMALL_STEP = 1 / 128, 1 / 1024
_SMALL_MM = 60.0
"""The length in mm below which a tool needs a shorter time step.

Such a tool is so light that it would tilt in a simulation with the usual step.
"""
_FRICTION = 0.5


def resting_tilt(sdf: Path, length_mm: float = 180.0) -> NDArray[np.float64]:
    """Drops a tool onto a table; returns its tilt R (3, 3) at rest, without the rotation about z.

    Args:
        sdf: an SDFormat file with one link, in whose frame the table is at z = 0.
        length_mm: the tool's length in mm, which decides the time step.
    """
    builder = DiagramBuilder()
    step = _STEP if length_mm >= _SMALL_MM else _SMALL_STEP
    config = MultibodyPlantConfig(time_step=step, contact_model="hydroelastic")
    plant, _ = AddMultibodyPlant(config, builder)
    text = model_text(sdf)
    parser = Parser(plant)
    (model,) = parser.AddModelsFromString(text, "sdf") if text else parser.AddModels(str(sdf))
    ground = ProximityProperties()
    AddRigidHydroelasticProperties(ground)
    AddContactMaterial(friction=CoulombFriction(_FRICTION, _FRICTION), properties=ground)
    plant.RegisterCollisionGeometry(
        plant.world_body(), RigidTransform(), HalfSpace(), "ground", ground
    )
    plant.Finalize()
    simulator = Simulator(builder.Build())
    context = plant.GetMyMutableContextFromRoot(simulator.get_mutable_context())
    (index,) = plant.GetBodyIndices(model)
    body = plant.get_body(index)
    plant.SetFreeBodyPose(context, body, RigidTransform([0, 0, _DROP]))
    simulator.AdvanceTo(_SETTLE)
    rotation = plant.EvalBodyPoseInWorld(context, body).rotation()
    yaw = RollPitchYaw(rotation).yaw_angle()
    return RollPitchYaw(0, 0, -yaw).ToRotationMatrix().matrix() @ rotation.matrix()
