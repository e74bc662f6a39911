"""The YAML schema of a scenario, modelled on Drake's hardware_sim.

A file maps names to scenarios. Every field has a default, so `Defaults: {}` is a valid scenario.
For fields with several types, a tag selects the type, as in `policy: !Oracle {}`. Some fields are
Drake's own configs.

Units are SI. Names of fields in degrees end in `_deg`.

`bounded(d, a, b)`: default d, allowed from a to b.

The table's top is the plane z = 0 of the world. No field changes it; see `models/table/table.sdf`.
The fingers' geometry is in `models/franka_hand/`, its dimensions in `systems/hand_geometry.py`.
"""

import dataclasses as dc

from pydrake.geometry import MeshcatParams
from pydrake.multibody.plant import MultibodyPlantConfig

from kitting_drake.scenario.appearance import Appearance
from kitting_drake.scenario.cameras import Camera, Pinhole
from kitting_drake.scenario.policies import Oracle, Policy
from kitting_drake.scenario.robots import FloatingHand, Robot
from kitting_drake.tasks import Kitting, Task
from systems.bounds import bounded
from systems.pick_place_parameters import PickPlaceParameters
from systems.sensor_noise import SensorNoiseParameters
from systems.signals import PixelGrid


@dc.dataclass
class Heightmap:
    """The pixel grid of the orthographic observation o_t, which also defines the workspace.

    Tasks draw poses on the part of the table that lies within the workspace.
    """

    # Lower (x, y) corner of the workspace in the world, in m.
    x_min: float = bounded(0.25, -10.0, 10.0)
    y_min: float = bounded(-0.5, -10.0, 10.0)

    # Side of a pixel, in m. Numbers of pixels along x (rows) and y (cols).
    resolution: float = bounded(0.003125, 1e-4, 0.1)
    rows: int = bounded(160, 1, 4096)
    cols: int = bounded(320, 1, 4096)

    # Range of heights in the world, in m. Points below z_min get the height z_min; points above
    # z_max are ignored. Learned policies need z_min = 0, the height of the table. If your scene has
    # points below the table, use z_min = -0.02 or lower.
    z_min: float = bounded(0.0, -1.0, 10.0)
    z_max: float = bounded(0.28, -1.0, 10.0)

    def grid(self) -> PixelGrid:
        """The pixel grid that these fields describe."""
        return PixelGrid(**dc.asdict(self))


@dc.dataclass
class Controller:
    """Gains and force limits of the TrajectoryController."""

    # Stiffness and damping for x, y, z (N/m, N s/m) and yaw (N m/rad, N m s/rad).
    stiffness: list[float] = bounded([10000.0, 10000.0, 10000.0, 120.0], 0.0, 1e6)
    damping: list[float] = bounded([320.0, 320.0, 320.0, 4.2], 0.0, 1e5)

    # Largest forces on x, y, z (N) and largest torque on yaw (N m).
    force_limit: list[float] = bounded([150.0, 150.0, 150.0, 12.0], 1e-3, 1e4)

    # Stiffness (N/m), damping (N s/m) and largest force (N) of each finger's drive.
    finger_stiffness: float = bounded(800.0, 1.0, 1e5)
    finger_damping: float = bounded(16.0, 0.0, 1e4)
    finger_force_limit: float = bounded(140.0, 1.0, 140.0)


@dc.dataclass
class Variation:
    """Random variation of friction and mass of all models except the robot."""

    # The friction coefficients of each model are multiplied by a random factor between 1 - value
    # and 1 + value. `mass` is the corresponding range for the model's mass.
    friction: float = bounded(0.0, 0.0, 0.9)
    mass: float = bounded(0.0, 0.0, 0.9)


@dc.dataclass
class Sleep:
    """Objects at rest are frozen, to save computing time, until something comes near."""

    enabled: bool = True

    # An object is frozen when it has stayed within these tolerances (m, rad) of one pose for
    # `time_to_sleep`.
    position_tolerance: float = bounded(0.0005, 0.0, 0.01)
    angle_tolerance: float = bounded(0.02, 0.0, 1.0)

    # Time for which an object must stay in place before it is frozen, in s.
    time_to_sleep: float = bounded(0.25, 0.0, 10.0)

    # A frozen object is freed when the hand or an object that is not frozen comes within this
    # distance, in m.
    wake_distance: float = bounded(0.006, 0.001, 1.0)


@dc.dataclass
class Scenario:
    """A scenario. Together with a seed it determines an episode."""

    # The seed that is used if the command line gives none.
    random_seed: int = bounded(0, 0, 2**32 - 1)

    # Longest simulated time of an episode, in s.
    time_limit: float = bounded(180.0, 0.1, 1e6)

    # Whether to end the episode as soon as every goal is met, as in Ravens and the paper. Learned
    # policies then never decide to stop. If false, the policy must decide to stop.
    end_at_success: bool = False

    # Speed of the simulation: 1 for real time, 0 for as fast as possible.
    target_realtime_rate: float = bounded(0.0, 0.0, 100.0)

    # The objects on the table and their goals: see kitting_drake/tasks/.
    task: Task = dc.field(default_factory=Kitting)

    # The policy: !Oracle, !QuantizedOracle, !Learned, !ShapeMatching or !PythonPolicy; see
    # policies.py.
    policy: Policy = dc.field(default_factory=Oracle)

    # The RGB-D cameras by name: !Pinhole, !LookAt, or Drake's !CameraConfig. See cameras.py. The
    # default cameras are those of Ravens.
    cameras: dict[str, Camera] = dc.field(
        default_factory=lambda: {
            "front": Pinhole(position=[1.0, 0.0, 0.75], rpy_deg=[45.0, 180.0, -90.0]),
            "left": Pinhole(position=[0.0, 0.5, 0.75], rpy_deg=[40.0, 180.0, 45.0]),
            "right": Pinhole(position=[0.0, -0.5, 0.75], rpy_deg=[40.0, 180.0, 135.0]),
        }
    )

    # Noise of the images and errors of the calibration.
    sensor_noise: SensorNoiseParameters = dc.field(default_factory=SensorNoiseParameters)

    # Colours, sheen and lights: see appearance.py. For a red kit:
    # appearance: {paints: {"fixtures/kit/*": !Fixed {rgb: [0.8, 0.1, 0.1]}}}
    appearance: Appearance = dc.field(default_factory=Appearance)

    # The pixel grid of the policy's observation, and the workspace.
    heightmap: Heightmap = dc.field(default_factory=Heightmap)

    # The robot: !FloatingHand, or !FrankaArm for a whole arm; see robots.py.
    robot: Robot = dc.field(default_factory=FloatingHand)

    # Parameters of the hand's motion, and gains of its controller.
    planner: PickPlaceParameters = dc.field(default_factory=PickPlaceParameters)
    controller: Controller = dc.field(default_factory=Controller)

    # The physics: Drake's MultibodyPlantConfig. The time step must divide 1/64 s. Contact is
    # strictly hydroelastic: a contact between geometries without hydroelastic properties is an
    # error.
    plant: MultibodyPlantConfig = dc.field(
        default_factory=lambda: MultibodyPlantConfig(
            time_step=1 / 128,
            contact_model="hydroelastic",
            discrete_contact_approximation="lagged",
        )
    )
    variation: Variation = dc.field(default_factory=Variation)
    sleep: Sleep = dc.field(default_factory=Sleep)

    # Visualization: Drake's MeshcatParams. The page is served to this machine only; host: "*"
    # serves it to all machines.
    meshcat: MeshcatParams = dc.field(
        default_factory=lambda: MeshcatParams(host="localhost", show_stats_plot=False)
    )
