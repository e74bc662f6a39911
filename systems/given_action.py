"""The action of somebody who decides outside the Diagram, as a Drake system."""

from __future__ import annotations

from pydrake.common.value import AbstractValue, Value
from pydrake.systems.framework import AbstractParameterIndex, Context, LeafSystem

from systems.signals import PickPlaceAction
from systems.weak_calc import weak_calc


class GivenAction(LeafSystem):
    """Holds the action that it was given, until it is given another.

    .. pydrake_system::

        name: GivenAction
        output_ports:
        - action

    - `action` (abstract, `PickPlaceAction`): the parameter that `set_action` wrote; at first, to
      stop.

    All memory is an abstract parameter in the Context. Who decides looks at the Diagram's outputs
    while `PickPlacePlanner.asks_now` holds, and gives the action then.
    """

    def __init__(self) -> None:
        super().__init__()
        self._index = AbstractParameterIndex(
            self.DeclareAbstractParameter(Value(PickPlaceAction(stop=True)))
        )
        self.DeclareAbstractOutputPort(
            "action",
            lambda: Value(PickPlaceAction()),
            weak_calc(self._calc_action),
            {self.abstract_parameter_ticket(self._index)},
        )

    def set_action(self, context: Context, action: PickPlaceAction) -> None:
        """Gives the action, to the system's own context."""
        context.get_mutable_abstract_parameter(self._index).set_value(action)

    def _calc_action(self, context: Context, output: AbstractValue) -> None:
        output.set_value(context.get_abstract_parameter(self._index).get_value())
