"""Scores placements: filled goals, ADD-S and pose errors."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from pydrake.common.value import AbstractValue, Value
from pydrake.math import RigidTransform
from pydrake.systems.framework import (
    BasicVector,
    Context,
    DiscreteValues,
    EventStatus,
    LeafSystem,
)

from systems.pick_place_parameters import Mode
from systems.placement import (
    Goal,
    PlacedObject,
    Placement,
    SuccessPredicate,
    complete_stages,
    evaluate_placements,
    total_reward,
)
from systems.weak_calc import weak_calc


class PlacementMonitor(LeafSystem):
    """Compares the objects' poses with their goals, and computes errors and the reward.

    .. pydrake_system::

        name: PlacementMonitor
        input_ports:
        - body_poses
        - mode (optional)
        output_ports:
        - placements
        - reward
        - success
        - add_s
        - position_error
        - angle_error
        - height_error
        - kept_goals

    - `body_poses` (abstract, list of RigidTransform by body index): the plant's port of that name.
    - `mode` (1): the planner's port of that name. If it is not connected, no goal is kept.
    - `placements` (abstract, list of n `Placement`): one for each object, by the law of
      `evaluate_placements`.
    - `reward` (1): the episode's present score, 0 to 1 (see `total_reward`).
    - `success` (n): 1 for an object that fills its goal, else 0.
    - `add_s` (n): ADD-S, equation 9 of the paper, in metres; infinite for an object without a goal.
    - `position_error`, `angle_error`, `height_error` (n): see `Placement`; metres, radians.
    - `kept_goals` (one element for each goal): 1 for goals of a stage that was complete when an
      action began, else 0. They count as filled from then on (see `complete_stages`).

    State (discrete): the kept goals, and the planner's last mode. Ports compute only on demand.
    """

    def __init__(
        self,
        *,
        objects: Sequence[PlacedObject],
        goals: Sequence[Goal],
        success: SuccessPredicate,
        period: float = 1 / 64,
    ) -> None:
        """
        Args:
            objects: the n objects.
            goals: at least one goal.
            success: decides when a goal is filled.
            period: period with which the mode is read, in s; use the planner's.

        Raises:
            ValueError: there are no goals, a goal has no object or no pose, or an object has no
                points.
        """
        super().__init__()
        if not goals:
            raise ValueError("a placement monitor needs at least one goal")
        for goal in goals:
            if not goal.objects or not goal.poses:
                raise ValueError(f"the goal {goal.name} needs an object and a pose")
        for item in objects:
            if item.p_BPoints.ndim != 2 or item.p_BPoints.shape[1] != 3 or not len(item.p_BPoints):
                raise ValueError(
                    f"the points of {item.name} must have the shape (m, 3) with m > 0, not "
                    f"{item.p_BPoints.shape}"
                )
        self._objects, self._goals, self._success = tuple(objects), tuple(goals), success
        self._body_poses = self.DeclareAbstractInputPort("body_poses", Value([RigidTransform()]))
        self._mode = self.DeclareVectorInputPort("mode", 1)
        self._kept_index = self.DeclareDiscreteState(np.zeros(len(goals)))
        self._mode_index = self.DeclareDiscreteState([float(Mode.OBSERVE)])
        self.DeclarePeriodicDiscreteUpdateEvent(period, 0.0, self._update)
        kept = self.discrete_state_ticket(self._kept_index)
        self._placements = self.DeclareAbstractOutputPort(
            "placements",
            lambda: Value([Placement()]),
            weak_calc(self._calc_placements),
            {self._body_poses.ticket(), kept},
        )
        tickets = {self._body_poses.ticket(), kept}
        self._reward = self.DeclareVectorOutputPort("reward", 1, self._calc_reward, tickets)
        for name in ("success", "add_s", "position_error", "angle_error", "height_error"):
            self.DeclareVectorOutputPort(name, len(objects), self._copy(name), tickets)
        self.DeclareVectorOutputPort("kept_goals", len(goals), self._calc_kept, {kept})

    @property
    def objects(self) -> tuple[PlacedObject, ...]:
        """The objects, in the order of the output ports' elements."""
        return self._objects

    @property
    def goals(self) -> tuple[Goal, ...]:
        """The goals, in the order of the elements of the port `kept_goals`."""
        return self._goals

    def placements(self, context: Context) -> list[Placement]:
        """Evaluates the port `placements` in this system's context."""
        return self._placements.Eval(context)

    def reward(self, context: Context) -> float:
        """Evaluates the port `reward` in this system's context."""
        return float(self._reward.Eval(context)[0])

    def _kept(self, context: Context) -> frozenset[int]:
        flags = context.get_discrete_state(self._kept_index).get_value()
        return frozenset(np.flatnonzero(flags).tolist())

    def _update(self, context: Context, discrete_state: DiscreteValues) -> EventStatus:
        if not self._mode.HasValue(context):
            return EventStatus.DidNothing()
        mode = self._mode.Eval(context)[0]
        last = context.get_discrete_state(self._mode_index).get_value()[0]
        if mode == last:
            return EventStatus.DidNothing()
        discrete_state.get_mutable_value(self._mode_index)[0] = mode
        if last == Mode.OBSERVE:
            kept = complete_stages(self._goals, self.placements(context), self._kept(context))
            discrete_state.get_mutable_value(self._kept_index)[sorted(kept)] = 1.0
        return EventStatus.Succeeded()

    def _calc_placements(self, context: Context, output: AbstractValue) -> None:
        poses = self._body_poses.Eval(context)
        actual = [poses[int(item.body)] for item in self._objects]
        output.set_value(
            evaluate_placements(
                self._objects, self._goals, self._success, actual, self._kept(context)
            )
        )

    def _calc_reward(self, context: Context, output: BasicVector) -> None:
        reward = total_reward(self._goals, self.placements(context), self._kept(context))
        output.SetFromVector([reward])

    def _calc_kept(self, context: Context, output: BasicVector) -> None:
        output.SetFromVector(context.get_discrete_state(self._kept_index).get_value())

    def _copy(self, name: str) -> Callable[[Context, BasicVector], None]:
        def calc(context: Context, output: BasicVector) -> None:
            output.SetFromVector([float(getattr(p, name)) for p in self.placements(context)])

        return calc
