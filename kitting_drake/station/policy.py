"""Plugs a policy into a station: the scenario's own, or any LeafSystem."""

from pydrake.systems.framework import Diagram, DiagramBuilder, System

from kitting_drake.common.errors import UserError
from kitting_drake.common.rendering import require_rendering
from kitting_drake.scenario.policies import DecisionObserver, PolicySite
from kitting_drake.station.station import KittingStation


def make_policy(station: KittingStation, observer: DecisionObserver | None = None) -> System:
    """The system of the policy that the station's scenario names.

    Args:
        station: what it is to be connected to.
        observer: told of every decision of a learned policy, and of the observation it is about.

    Raises:
        UserError: it cannot be made.
    """
    scenario = station.scenario
    return scenario.policy.make_system(
        PolicySite(
            scene=station.scene,
            objects=station.objects,
            grid=station.grid,
            base=station.base,
            observer=observer,
            may_stop=not scenario.end_at_success,
            planner=scenario.planner,
            has_cameras=station.has_cameras,
        )
    )


def connect_policy(
    builder: DiagramBuilder,
    station: KittingStation,
    policy: System,
    *,
    through: System | None = None,
) -> None:
    """Connects a policy to a station.

    Each input port of the policy is connected to the station's output port of the same name, and
    the policy's output port `action` to the station's input port.

    Args:
        builder: holds both.
        station: decides nothing.
        policy: decides.
        through: a system with an input and an output port `action`, through which actions go.

    Raises:
        UserError: the policy looks at images, and there are no cameras.
        MachineError: it does, and images cannot be rendered here.
    """
    for index in range(policy.num_input_ports()):
        port = policy.get_input_port(index)
        name = port.get_name()
        if name.startswith("observation") and not station.has_cameras:
            if not station.scenario.cameras:
                raise UserError("cameras is empty: this policy needs at least one to see by")
            require_rendering()
        builder.Connect(station.GetOutputPort(name), port)
    last = policy
    if through is not None:
        builder.Connect(policy.GetOutputPort("action"), through.GetInputPort("action"))
        last = through
    builder.Connect(last.GetOutputPort("action"), station.GetInputPort("action"))


def with_policy(station: KittingStation, observer: DecisionObserver | None = None) -> Diagram:
    """A Diagram of a station and its scenario's policy, connected; see `make_policy`."""
    builder = DiagramBuilder()
    builder.AddNamedSystem("station", station)
    policy = builder.AddNamedSystem("policy", make_policy(station, observer))
    connect_policy(builder, station, policy)
    return builder.Build()
