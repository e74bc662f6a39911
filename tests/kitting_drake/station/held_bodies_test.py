import numpy as np
import pytest
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.multibody.math import SpatialVelocity
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import SpatialInertia
from scipy.spatial.transform import Rotation

from kitting_drake.scenario.robots import FrankaArm
from kitting_drake.station.held_bodies import ArmPath
from kitting_drake.station.robot import arm_model

STEP = 1 / 128
Q = np.array([0.4, 0.3, 0.2, -2.2, -0.1, 2.5, 0.8, 0.01, 0.01])
V = np.array([2.0, -0.9, 0.6, 1.5, -0.8, 0.5, 1.8, 0.0, 0.0])
COM = np.array([0.03, 0.01, -0.02])


def step(moves: bool) -> tuple[RigidTransform, RigidTransform, RigidTransform]:
    """Makes a step with a body 0.1 m beside the hand. The body moves with the hand or rests.

    Returns:
        Three poses X_WB after the step: the uncorrected pose, the corrected pose, and the pose of a
        body that is welded to the hand.
    """
    arm, gripper = arm_model(FrankaArm())
    context = arm.CreateDefaultContext()
    arm.SetPositionsAndVelocities(context, np.concatenate([Q, V]))
    X_WG, V_WG = gripper.CalcPoseInWorld(context), gripper.CalcSpatialVelocityInWorld(context)
    arm.SetPositions(context, Q + STEP * V)
    X_WG1 = gripper.CalcPoseInWorld(context)
    X_WB0 = X_WG @ RigidTransform(RotationMatrix.MakeXRotation(0.3), [0.1, 0.02, 0.01])
    p_WCom = X_WB0 @ COM

    plant = MultibodyPlant(STEP)
    inertia = SpatialInertia.SolidSphereWithMass(0.2, 0.02)
    body = plant.AddRigidBody(
        "tool", SpatialInertia(0.2, COM, inertia.get_unit_inertia().ShiftFromCenterOfMass(COM))
    )
    plant.Finalize()
    own = plant.CreateDefaultContext()
    rate = V_WG.rotational() * moves
    speed = V_WG.Shift(p_WCom - X_WG.translation()).translational() * moves
    # In a time step of Drake, the body's centre of mass moves in a straight line.
    R_WB = RotationMatrix(Rotation.from_rotvec(STEP * rate).as_matrix()) @ X_WB0.rotation()
    X_WB = RigidTransform(R_WB, p_WCom + STEP * speed - R_WB @ COM)
    plant.SetFreeBodyPose(own, body, X_WB)
    plant.SetFreeBodySpatialVelocity(
        own, body, SpatialVelocity(rate, speed - np.cross(rate, R_WB @ COM))
    )
    state = np.concatenate([Q + STEP * V, V])
    ArmPath(arm, gripper, STEP).correct(plant, own, state, [body])
    return X_WB, body.EvalPoseInWorld(own), X_WG1 @ X_WG.inverse() @ X_WB0


def test_a_carried_body_stays_where_it_is_in_the_hand():
    straight, corrected, welded = step(moves=True)
    assert np.linalg.norm(straight.translation() - welded.translation()) > 1e-4
    np.testing.assert_allclose(corrected.translation(), welded.translation(), atol=2e-6)
    assert corrected.IsNearlyEqualTo(
        RigidTransform(welded.rotation(), corrected.translation()), 1e-9
    )


def test_a_body_at_rest_stays():
    straight, corrected, _ = step(moves=False)
    assert corrected.IsExactlyEqualTo(straight) or corrected.IsNearlyEqualTo(straight, 1e-15)


@pytest.mark.parametrize("rate", [0.0, 0.01])
def test_an_arm_that_hardly_moves_carries_nothing(rate: float):
    arm, gripper = arm_model(FrankaArm())
    state = np.concatenate([Q, np.full(9, rate)])
    # The plant and its context are None: `correct` must return before it uses them.
    ArmPath(arm, gripper, STEP).correct(None, None, state, [])  # type: ignore[arg-type]
