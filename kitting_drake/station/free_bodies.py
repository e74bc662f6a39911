"""Changes the plant's context between two steps of a simulation: objects appear, sleep, and drift.

A LeafSystem cannot change the context of another system. Therefore the simulator's monitor calls
the methods of `FreeBodies` (see `KittingStation.make_simulator`).
"""

import math
from collections.abc import Iterable, Sequence

import numpy as np
from numpy.typing import NDArray
from pydrake.geometry import CollisionFilterDeclaration, GeometrySet, SceneGraph
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import BodyIndex, RigidBody
from pydrake.systems.framework import Context

from kitting_drake.station.held_bodies import ArmPath, correct_drift
from kitting_drake.station.robot import robot_state
from kitting_drake.tasks.task import Scene
from systems.object_feeder import ObjectFeeder
from systems.placement import GONE


class FreeBodies:
    """The bodies of a station's objects.

    They keep the plant alive. Therefore a station must not store them, or it would live forever.
    """

    def __init__(
        self,
        plant: MultibodyPlant,
        scene_graph: SceneGraph,
        scene: Scene,
        *,
        bodies: Sequence[BodyIndex],
        still_bodies: Sequence[BodyIndex],
        may_sleep: bool,
        feeder: ObjectFeeder | None = None,
        arm_path: ArmPath | None = None,
    ) -> None:
        """
        Args:
            plant: the station's plant.
            scene_graph: the plant's SceneGraph.
            scene: the scene, whose objects may appear during the episode.
            bodies: the bodies of the scene's objects.
            still_bodies: the bodies of table and fixtures.
            may_sleep: whether objects at rest are frozen.
            feeder: says which object is to appear; None if none appears.
            arm_path: corrects the bodies that an arm carries; None for a floating hand.
        """
        self._plant, self._scene_graph, self._scene = plant, scene_graph, scene
        self._may_sleep = may_sleep
        self._feeder, self._arm_path = feeder, arm_path
        self._bodies = [plant.get_body(index) for index in bodies]
        self._still = [plant.get_body(index) for index in still_bodies]

    def let_appear(self, root_context: Context) -> None:
        """If an object is to appear now, moves it to its place on the table."""
        if self._feeder is None:
            return
        port = self._feeder.get_output_port()
        index = int(port.Eval(self._feeder.GetMyContextFromRoot(root_context))[0])
        arrivals = self._scene.arrivals
        if index < 0 or arrivals is None:
            return
        body = self._bodies[arrivals.objects[index]]
        context = self._plant.GetMyMutableContextFromRoot(root_context)
        self._plant.SetFreeBodyPose(context, body, arrivals.poses[index])

    def apply_sleep(self, root_context: Context, at_rest: NDArray[np.bool_]) -> None:
        """Freezes objects at rest and thaws the others.

        A frozen object's joint is locked. Its contact with table, fixtures and other frozen objects
        is filtered out, but bodies that are not frozen still collide with it. If sleep is disabled,
        only objects outside the cell are frozen, and only in tasks where objects appear.

        Args:
            root_context: the context of the outermost Diagram.
            at_rest: (n,) whether each object is at rest.
        """
        context = self._plant.GetMyMutableContextFromRoot(root_context)
        if not self._may_sleep:
            if self._scene.arrivals is None:
                return
            positions = [body.EvalPoseInWorld(context).translation() for body in self._bodies]
            at_rest = at_rest & (np.linalg.norm(positions, axis=1) > GONE)
        changed = [
            (body, resting)
            for body, resting in zip(self._bodies, at_rest.tolist(), strict=True)
            if resting != body.is_locked(context)
        ]
        if not changed:
            return
        filters = self._scene_graph.collision_filter_manager(
            self._scene_graph.GetMyMutableContextFromRoot(root_context)
        )
        # Thaw objects first: thawing allows all contacts of an object, so it would undo filters
        # that freezing other objects has just set.
        for body, resting in sorted(changed, key=lambda change: change[1]):
            own = self._geometry([body])
            if resting:
                body.Lock(context)
                frozen = [other for other in self._bodies if other.is_locked(context)]
                others = self._geometry([*self._still, *frozen])
                filters.Apply(CollisionFilterDeclaration().ExcludeBetween(own, others))
            else:
                body.Unlock(context)
                others = self._geometry([*self._still, *self._bodies])
                filters.Apply(CollisionFilterDeclaration().AllowBetween(own, others))

    def correct_drift(self, root_context: Context) -> None:
        """If the plant has just made a step, corrects the positions of bodies that rotate or that
        an arm carries."""
        step = self._plant.time_step()
        # Allow for rounding errors in the times of steps, which are exact only if the step is a
        # binary fraction.
        if abs(math.remainder(root_context.get_time(), step)) >= 1e-6 * step:
            return
        context = self._plant.GetMyMutableContextFromRoot(root_context)
        awake = [body for body in self._bodies if not body.is_locked(context)]
        if not awake:
            return
        correct_drift(self._plant, context, awake)
        if self._arm_path is not None:
            # Do not evaluate the port `robot_state` here: that would keep the Diagram alive
            # forever.
            state = robot_state(self._plant, context)
            self._arm_path.correct(self._plant, context, state, awake)

    def _geometry(self, bodies: Iterable[RigidBody]) -> GeometrySet:
        geometry = GeometrySet()
        for body in bodies:
            geometry.Add(self._plant.GetCollisionGeometriesForBody(body))
        return geometry
