"""Connects a policy to a station, either the scenario's policy or any LeafSystem."""

from pydrake.systems.framework import Diagram, DiagramBuilder, System

from kitting_drake.common.errors import UserError
from kitting_drake.common.rendering import require_rendering
from kitting_drake.scenario.policies import DecisionObserver, PolicySite
from kitting_drake.station.station import KittingStation


def make_policy(station: KittingStation, observer: DecisionObserver | None = None) -> System:
    """Makes the policy system of the station's scenario.

    Args:
        station: the station to which the policy will be connected.
        observer: if given, a function that is called with every decision of a learned policy and
            its observation.

    Raises:
        UserError: the policy cannot be made.
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
        builder: the builder that contains station and policy.
        station: the station.
        policy: the policy.
        through: a system with an input port and an output port `action`, which is inserted after
            the policy.

    Raises:
        UserError: the policy needs images, but the scenario has no cameras.
        MachineError: the policy needs images, but this machine cannot render.
    """
    for index in range(policy.num_input_ports()):
        port = policy.get_input_port(index)
        name = port.get_name()
        if name.startswith("observation") and not station.has_cameras:
            if not station.scenario.cameras:
                raise UserError("cameras is empty: this policy needs at least one camera")
            require_rendering()
        builder.Connect(station.GetOutputPort(name), port)
    last = policy
    if through is not None:
        builder.Connect(policy.GetOutputPort("action"), through.GetInputPort("action"))
        last = through
    builder.Connect(last.GetOutputPort("action"), station.GetInputPort("action"))


def with_policy(station: KittingStation, observer: DecisionObserver | None = None) -> Diagram:
    """Builds a Diagram of a station and its scenario's policy, connected; see `make_policy`."""
    builder = DiagramBuilder()
    builder.AddNamedSystem("station", station)
    policy = builder.AddNamedSystem("policy", make_policy(station, observer))
    connect_policy(builder, station, policy)
    return builder.Build()
