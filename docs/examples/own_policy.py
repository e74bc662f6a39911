"""A station, a policy of one's own, a logger, and a plot of the wrist force."""

from matplotlib.figure import Figure
from pydrake.common.value import Value
from pydrake.systems.framework import DiagramBuilder, LeafSystem
from pydrake.systems.primitives import LogVectorOutput

from kitting_drake.scenario import Scenario
from kitting_drake.station import build_station, connect_policy
from kitting_drake.tasks import ArrangedKitting
from kitting_drake.tasks.kitting.tool_poses import TablePose
from systems.signals import Observation, PickPlaceAction, PlanarPose


class PickHighest(LeafSystem):
    """Picks the highest object outside the kit, and lays it aside."""

    def __init__(self, kit_edge: float) -> None:
        super().__init__()
        self._kit_edge = kit_edge  # World y, in m; the kit is at smaller y.
        # Input ports are named after the station's output ports.
        self._seen = self.DeclareAbstractInputPort("observation_heights", Value(Observation()))
        self.DeclareAbstractOutputPort("action", lambda: Value(PickPlaceAction()), self._decide)

    def _decide(self, context, output):
        o_t = self._seen.Eval(context)
        free = o_t.height.copy()
        _, edge = o_t.grid.to_pixel((o_t.grid.x_min, self._kit_edge))
        free[:, : int(edge)] = 0
        row, col = divmod(int(free.argmax()), free.shape[1])
        x, y = o_t.grid.to_world([row, col])
        pick, place = PlanarPose(x, y, 0.0), PlanarPose(0.4, 0.4, 0.0)
        output.set_value(PickPlaceAction(pick, place, stop=free.max() < 0.005))


def main(picture="wrist_force.png"):
    tools = {"flat_screwdriver": TablePose(x=0.4, y=0.2)}
    task = ArrangedKitting(tools=tools, kit_pose=TablePose(x=0.5, y=-0.2))
    builder = DiagramBuilder()
    station = builder.AddSystem(build_station(Scenario(task=task), seed=0))
    policy = builder.AddSystem(PickHighest(kit_edge=0.05))
    connect_policy(builder, station, policy)
    logger = LogVectorOutput(station.GetOutputPort("wrist_force"), builder, 1 / 64)
    diagram = builder.Build()

    simulator = station.make_simulator(diagram)
    simulator.AdvanceTo(6.0)
    log = logger.FindLog(simulator.get_context())
    figure = Figure(figsize=(7, 3), layout="constrained")
    axes = figure.subplots()
    axes.plot(log.sample_times(), log.data()[2])
    axes.set(xlabel="time (s)", ylabel="vertical contact force (N)")
    figure.savefig(picture)
    return log


if __name__ == "__main__":
    main()
