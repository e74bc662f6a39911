"""Any function from an observation to an action, as a Drake system."""

from __future__ import annotations

import dataclasses
import inspect
from collections.abc import Callable
from typing import Any

import numpy as np
from pydrake.common.value import AbstractValue, Value
from pydrake.systems.framework import Context, LeafSystem

from systems.signals import Observation, PickPlaceAction, PlanarPose
from systems.weak_calc import weak_calc

PolicyFunction = Callable[..., PickPlaceAction]
"""Called with an `Observation`; and, if it has an argument `failed_picks`, with a tuple of the
`PlanarPose`s at which a grasp failed before, the latest last; without it where none is known. A
second argument of any other name is taken for it too, unless it has a default."""


class PolicyError(RuntimeError):
    """A policy's own function failed; `__cause__` is what it raised."""


class PickPlacePolicy(LeafSystem):
    """Wraps a callable policy p(a_pick, a_place | o_t), section III-A of the paper.

    .. pydrake_system::

        name: PickPlacePolicy
        input_ports:
        - observation
        - failed_picks (if the function takes them; optional)
        output_ports:
        - action

    - `observation` (abstract, `Observation`): o_t.
    - `failed_picks` (abstract, a tuple of `PlanarPose`): where a grasp failed before.
    - `action` (abstract, `PickPlaceAction`): the policy's answer.

    Pulled: the callable runs when the port is evaluated, once for each new observation. It lives
    outside the Context, which must stay cheap to copy, and must therefore not remember anything:
    what there is to remember comes in by a port.
    """

    def __init__(self, *, policy: PolicyFunction, heights_only: bool = False) -> None:
        """
        Args:
            policy: a function without memory. What it raises ends the evaluation of the port; an
                answer that is no `PickPlaceAction` is a `TypeError`, one whose poses are no finite
                numbers a `ValueError`.
            heights_only: whether the function looks at heights alone, so that observations may come
                without colours.
        """
        super().__init__()
        self._policy = policy
        self.heights_only = heights_only
        name = "observation_heights" if heights_only else "observation"
        self._observation = self.DeclareAbstractInputPort(name, Value(Observation()))
        tickets = {self._observation.ticket()}
        self._failed_picks = None
        self._by_name, by_place = _takes_failed_picks(policy)
        if self._by_name or by_place:
            self._failed_picks = self.DeclareAbstractInputPort("failed_picks", Value(()))
            tickets.add(self._failed_picks.ticket())
        self.DeclareAbstractOutputPort(
            "action", lambda: Value(PickPlaceAction()), weak_calc(self._calc_action), tickets
        )

    def _calc_action(self, context: Context, output: AbstractValue) -> None:
        arguments, named = [self._observation.Eval(context)], {}
        if self._failed_picks is not None and self._failed_picks.HasValue(context):
            failed_picks = self._failed_picks.Eval(context)
            if self._by_name:
                named["failed_picks"] = failed_picks
            else:
                arguments.append(failed_picks)
        try:
            action = self._policy(*arguments, **named)
        except (Exception, SystemExit) as error:
            raise PolicyError(f"the policy {self._policy!r} failed: {error}") from error
        if not isinstance(action, PickPlaceAction):
            raise TypeError(
                f"the policy {self._policy!r} answered with {type(action).__name__}, "
                "not a PickPlaceAction"
            )
        output.set_value(self._checked(action))

    def _checked(self, action: PickPlaceAction) -> PickPlaceAction:
        """An action whose poses are numbers, as far as they mean anything.

        Raises:
            TypeError: they are none.
            ValueError: they are not finite.
        """
        numbers: dict[str, Any] = {}
        for name, pose in action.poses.items():
            if not isinstance(pose, PlanarPose):
                raise TypeError(
                    f"the policy {self._policy!r} answered with a {name} that is no PlanarPose: "
                    f"{pose!r}"
                )
            values = (pose.x, pose.y, pose.theta)
            if any(isinstance(value, str) for value in values):
                raise TypeError(
                    f"the policy {self._policy!r} answered with a {name} of text: {pose!r}"
                )
            numbers[name] = PlanarPose(*map(float, values))
            if not np.isfinite(numbers[name].as_array()).all():
                raise ValueError(
                    f"the policy {self._policy!r} answered with no finite numbers: {action}"
                )
        return dataclasses.replace(action, **numbers)


def _takes_failed_picks(policy: Callable[..., Any]) -> tuple[bool, bool]:
    """Whether a function takes failed picks by their name, and whether as its second argument."""
    try:
        parameters = list(inspect.signature(policy).parameters.values())
    except (TypeError, ValueError):
        # Some built-in functions do not tell.
        return False, False
    named = (inspect.Parameter.POSITIONAL_OR_KEYWORD, inspect.Parameter.KEYWORD_ONLY)
    by_name = any(item.name == "failed_picks" and item.kind in named for item in parameters)
    placed = (inspect.Parameter.POSITIONAL_ONLY, inspect.Parameter.POSITIONAL_OR_KEYWORD)
    second = [item for item in parameters if item.kind in placed][1:2]
    return by_name, any(
        item.default is item.empty or item.name == "failed_picks" for item in second
    )
