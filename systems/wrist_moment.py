"""Measures the moment that a held object exerts on the wrist."""

from pydrake.systems.framework import BasicVector, Context, LeafSystem, OutputPort


class WristMoment(LeafSystem):
    """Reads the moment about the hand's y axis off the reaction forces of the plant.

    .. pydrake_system::

        name: WristMoment
        input_ports:
        - reaction_forces
        output_ports:
        - wrist_moment

    - `reaction_forces` (abstract, list of `SpatialForce`): the plant's port of that name.
    - `wrist_moment` (1): the moment about the hand's y axis, in N m. The hand's own weight and
      vertical acceleration act along its axis and contribute nothing.
    """

    def __init__(self, reaction_forces: OutputPort, joint: int) -> None:
        """
        Args:
            reaction_forces: the plant's output port that will be connected.
            joint: index, in that port's list, of the joint whose child frame is the hand's.
        """
        super().__init__()
        self._joint = joint
        # The type of this value has a different name in each version of pydrake, so take it from
        # the port.
        self._forces = self.DeclareAbstractInputPort("reaction_forces", reaction_forces.Allocate())
        self.DeclareVectorOutputPort("wrist_moment", 1, self._calc)

    def _calc(self, context: Context, output: BasicVector) -> None:
        output.SetFromVector([self._forces.Eval(context)[self._joint].rotational()[1]])
