import numpy as np
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import SpatialInertia

from kitting_drake.station.held_bodies import correct_drift

STEP = 1 / 128
P_COM = np.array([0.05, 0.0, 0.01])
"""The position of the centre of mass in the body's frame, in m."""


def make_plant() -> MultibodyPlant:
    plant = MultibodyPlant(STEP)
    inertia = SpatialInertia.SolidBoxWithMass(0.2, 0.1, 0.04, 0.02)
    plant.AddRigidBody("tool", inertia.Shift(-P_COM))
    plant.Finalize()
    return plant


def test_a_tool_that_turns_with_the_hand_does_not_slide_through_the_pads():
    plant = make_plant()
    body = plant.GetBodyByName("tool")
    context = plant.CreateDefaultContext()
    rate = np.array([0.0, 0.0, 2.5])
    place, drifted = -P_COM, -P_COM
    for step in range(128):
        # Step as Drake does. The tool turns about its centre of mass, at the world's origin.
        now, after = (RotationMatrix.MakeZRotation(2.5 * STEP * (step + i)) for i in (0, 1))
        place = place + STEP * np.cross(rate, now @ -P_COM)
        drifted = drifted + STEP * np.cross(rate, now @ -P_COM)
        plant.SetFreeBodyPose(context, body, RigidTransform(after, place))
        plant.SetVelocities(context, [*rate, *np.cross(rate, after @ -P_COM)])
        correct_drift(plant, context, [body])
        place = body.EvalPoseInWorld(context).translation()
    exact = after @ -P_COM
    assert np.linalg.norm(drifted - exact) > 0.3e-3
    assert np.linalg.norm(place - exact) < 0.02e-3


def test_a_body_that_does_not_turn_stays_exactly_where_it_is():
    plant = make_plant()
    context = plant.CreateDefaultContext()
    body = plant.GetBodyByName("tool")
    plant.SetVelocities(context, [0, 0, 0, 1, 2, 3])
    before = plant.GetPositions(context).copy()
    correct_drift(plant, context, [body])
    np.testing.assert_array_equal(plant.GetPositions(context), before)
