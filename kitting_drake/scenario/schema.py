"""The YAML schema of a scenario, in the manner of Drake's hardware_sim.

A file holds one or more scenarios, each under its name. Every field has a default, so that
`Defaults: {}` is a scenario. Where a field is a union, a tag chooses: `policy: !Oracle {}`. Where
Drake has a config of its own, that is the field.

Units are SI; angles that a person writes are in degrees, and the field says so.
"""

import dataclasses as dc

from pydrake.geometry import MeshcatParams
from pydrake.multibody.plant import MultibodyPlantConfig

from kitting_drake.scenario.appearance import Appearance
from kitting_drake.scenario.cameras import Camera, Pinhole
from kitting_drake.scenario.policies import Oracle, Policy
from kitting_drake.tasks import Kitting, Task
from systems.bounds import bounded
from systems.pick_place_parameters import PickPlaceParameters
from systems.sensor_noise import SensorNoiseParameters
from systems.signals import PixelGrid


@dc.dataclass
class Heightmap:
    """The orthographic observation o_t. What a task draws lies within it, and on the table."""

    # Lower corner of the workspace in the world, in m.
    x_min: float = bounded(0.25, -10.0, 10.0)
    y_min: float = bounded(-0.5, -10.0, 10.0)

    # Side of a pixel, in m, and pixels along x and y.
    resolution: float = bounded(0.003125, 1e-4, 0.1)
    rows: int = bounded(160, 1, 4096)
    cols: int = bounded(320, 1, 4096)

    # Heights are counted from z_min, in m: what is below reads as z_min, and what is above z_max is
    # not seen. Learned policies need 0, the table's; where something is lower, take -0.02 or less.
    z_min: float = bounded(0.0, -1.0, 10.0)
    z_max: float = bounded(0.28, -1.0, 10.0)

    def grid(self) -> PixelGrid:
        """The pixel grid that these fields describe."""
        return PixelGrid(**dc.asdict(self))


@dc.dataclass
class Controller:
    """Gains of the TrajectoryController; for x, y, z (N/m, N s/m) and yaw (N m/rad, N m s/rad)."""

    stiffness: list[float] = bounded([10000.0, 10000.0, 10000.0, 120.0], 0.0, 1e6)
    damping: list[float] = bounded([320.0, 320.0, 320.0, 4.2], 0.0, 1e5)

    # Force limits of the axes, in N and N m.
    force_limit: list[float] = bounded([150.0, 150.0, 150.0, 12.0], 1e-3, 1e4)

    # Of each finger: N/m, N s/m, N.
    finger_stiffness: float = bounded(800.0, 1.0, 1e5)
    finger_damping: float = bounded(16.0, 0.0, 1e4)
    finger_force_limit: float = bounded(140.0, 1.0, 140.0)


@dc.dataclass
class Variation:
    """How far the models are from what their files say. The hand's is not."""

    # Each model's friction coefficients, and its mass, are multiplied by factors drawn from the
    # seed: between 1 minus and 1 plus these.
    friction: float = bounded(0.0, 0.0, 0.9)
    mass: float = bounded(0.0, 0.0, 0.9)


@dc.dataclass
class Sleep:
    """An object at rest, out of reach of anything that moves, is frozen and costs nothing."""

    enabled: bool = True

    # An object is at rest when it has stayed this near (m, rad) to one pose ...
    position_tolerance: float = bounded(0.0005, 0.0, 0.01)
    angle_tolerance: float = bounded(0.02, 0.0, 1.0)

    # ... for this long, in s.
    time_to_sleep: float = bounded(0.25, 0.0, 10.0)

    # It wakes when the hand, or an object that is awake, comes this near, in m.
    wake_distance: float = bounded(0.006, 0.001, 1.0)


@dc.dataclass
class Scenario:
    """Everything about an episode but its seed."""

    # The seed when none is given on the command line.
    random_seed: int = bounded(0, 0, 2**32 - 1)

    # The episode ends after this much simulated time whatever happens, in s.
    time_limit: float = bounded(180.0, 0.1, 1e6)

    # It ends as soon as every goal is met, and learned policies are not asked whether they stop, as
    # in the Ravens benchmark and the paper. Otherwise whoever decides must see that all is done.
    end_at_success: bool = False

    # 1 is real time, 0 as fast as the machine allows.
    target_realtime_rate: float = bounded(0.0, 0.0, 100.0)

    # What stands on the table, and what is to be done with it; see kitting_drake/tasks/.
    task: Task = dc.field(default_factory=Kitting)

    # Who decides: !Oracle, !QuantizedOracle, !Learned, !ShapeMatching or !PythonPolicy.
    policy: Policy = dc.field(default_factory=Oracle)

    # The RGB-D cameras by name: !Pinhole, !LookAt, or Drake's own !CameraConfig. These three are
    # those of Ravens.
    cameras: dict[str, Camera] = dc.field(
        default_factory=lambda: {
            "front": Pinhole(position=[1.0, 0.0, 0.75], rpy_deg=[45.0, 180.0, -90.0]),
            "left": Pinhole(position=[0.0, 0.5, 0.75], rpy_deg=[40.0, 180.0, 45.0]),
            "right": Pinhole(position=[0.0, -0.5, 0.75], rpy_deg=[40.0, 180.0, 135.0]),
        }
    )

    # What the cameras and their calibration add to a perfect image.
    sensor_noise: SensorNoiseParameters = dc.field(default_factory=SensorNoiseParameters)

    # Colours, sheen and lights.
    appearance: Appearance = dc.field(default_factory=Appearance)

    # What the policy sees.
    heightmap: Heightmap = dc.field(default_factory=Heightmap)

    # How the hand moves.
    planner: PickPlaceParameters = dc.field(default_factory=PickPlaceParameters)
    controller: Controller = dc.field(default_factory=Controller)

    # The physics: Drake's MultibodyPlantConfig. The step divides every other period; contact is
    # strictly hydroelastic: a pair that cannot be is an error, not a point contact in disguise.
    plant: MultibodyPlantConfig = dc.field(
        default_factory=lambda: MultibodyPlantConfig(
            time_step=1 / 128,
            contact_model="hydroelastic",
            discrete_contact_approximation="lagged",
        )
    )
    variation: Variation = dc.field(default_factory=Variation)
    sleep: Sleep = dc.field(default_factory=Sleep)

    # Live viewing: Drake's MeshcatParams. Drake's own default host is every interface.
    meshcat: MeshcatParams = dc.field(
        default_factory=lambda: MeshcatParams(host="localhost", show_stats_plot=False)
    )
