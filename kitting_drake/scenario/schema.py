"""The YAML schema of a scenario, in the manner of Drake's hardware_sim.

A file holds one or more scenarios, each under its name. Every field has a default, so that
`Defaults: {}` is a scenario. Where a field is a union, a tag chooses: `policy: !Oracle {}`.

Units are SI; angles that a person writes are in degrees, and the field says so.
"""

import dataclasses as dc
from pathlib import Path

import yaml
from pydrake.common.yaml import yaml_dump, yaml_load, yaml_load_typed

from kitting_drake.common.errors import UserError
from kitting_drake.hkd.kits.kit import KitParameters
from kitting_drake.hkd.tools.toolsets import SPLITS
from kitting_drake.scenario.yaml_check import check_yaml
from systems.bounds import bounded, check_bounds
from systems.pick_place_planner import PickPlaceParameters

_ANGLE = (-360.0, 360.0)


@dc.dataclass
class Placement:
    """A pose on the table."""

    # World x and y, in m.
    x: float = bounded(0.5, -2.0, 2.0)
    y: float = bounded(0.0, -2.0, 2.0)

    # Turn about world z, counter-clockwise, in degrees.
    yaw_deg: float = bounded(0.0, *_ANGLE)


@dc.dataclass
class _DrawnKitting:
    """What tasks share whose tools and kit stand anywhere in the workspace, drawn from the seed."""

    # The kit block and its cavities.
    kit: KitParameters = dc.field(default_factory=KitParameters)

    # Least distance between any two of tools and kit, in m.
    spacing: float = bounded(0.008, 0.0, 0.2)

    # Turns of tools and kit are drawn within plus or minus this, in degrees.
    yaw_range_deg: float = bounded(180.0, 0.0, 180.0)

    # The order in which an oracle takes the tools: drawn from the seed, or as listed.
    random_order: bool = True

    # ADD-S below this is a success (section IV-C of the paper), in m.
    success_threshold: float = bounded(0.0035, 1e-6, 1.0)


@dc.dataclass
class Kitting(_DrawnKitting):
    """One toolset and its kit, in poses drawn from the seed: kitting-seen-toolset."""

    # The tools, one of each category at most: names under models/tools, or paths of tool folders.
    tools: list[str] = dc.field(
        default_factory=lambda: [
            "claw_hammer",
            "slip_joint_pliers",
            "combination_wrench",
            "flat_screwdriver",
        ]
    )


@dc.dataclass
class ToolsetKitting(_DrawnKitting):
    """Toolset and kit drawn from the seed too, out of a pool: kitting-unseen-toolsets."""

    # The pool: train or test (section IV-B.1 of the paper).
    split: str = "test"


@dc.dataclass
class ArrangedKitting:
    """Tools and kit stand where you say, and an oracle takes them in the order given."""

    # Tools by name or path, each with its pose on the table.
    tools: dict[str, Placement] = dc.field(
        default_factory=lambda: {"claw_hammer": Placement(x=0.35, y=0.3, yaw_deg=90.0)}
    )

    # Where the kit stands.
    kit_pose: Placement = dc.field(default_factory=lambda: Placement(x=0.5, y=-0.1))

    # The kit block and its cavities.
    kit: KitParameters = dc.field(default_factory=KitParameters)

    # ADD-S below this is a success (section IV-C of the paper), in m.
    success_threshold: float = bounded(0.0035, 1e-6, 1.0)


@dc.dataclass
class Oracle:
    """Ground truth and annotated grasps (section IV-B.4 of the paper)."""


@dc.dataclass
class QuantisedOracle:
    """The oracle, rounded to what a network can say: the ceiling of the paper's policy at an N."""

    # N: picks and turns are among 2 pi i / N; positions are pixel centres of the heightmap.
    orientations: int = bounded(180, 2, 3600)


@dc.dataclass
class Learned:
    """Networks trained by `train`."""

    # Their file, as `train` writes it; relative to the scenario's folder.
    weights: str = ""

    # N: picks and turns are among 2 pi i / N. The paper's own method answers at any N.
    orientations: int = bounded(180, 2, 3600)

    # Answer between pixels and bins (the paper does not) instead of on them.
    continuous: bool = True


@dc.dataclass
class PythonPolicy:
    """Your own function from `Observation` to `PickPlaceAction` (see systems/signals.py)."""

    # `module:function`, importable from where you run; called with one Observation.
    function: str = ""


@dc.dataclass
class Pinhole:
    """An RGB-D camera placed by roll, pitch and yaw. Its z axis looks, its x axis points right."""

    # Position in the world, in m.
    position: list[float] = bounded([1.0, 0.0, 0.75], -10.0, 10.0)

    # Roll, pitch and yaw, R = Rz Ry Rx, in degrees.
    rpy_deg: list[float] = bounded([45.0, 180.0, -90.0], *_ANGLE)

    # Image size in pixels, focal length in pixels; the principal point is the image's middle.
    width: int = bounded(640, 16, 4096)
    height: int = bounded(480, 16, 4096)
    focal_length: float = bounded(450.0, 10.0, 10000.0)


@dc.dataclass
class LookAt:
    """An RGB-D camera placed by what it looks at, upright."""

    # Position, and the point in the middle of the image, in the world, in m.
    position: list[float] = bounded([1.0, 0.0, 0.75], -10.0, 10.0)
    target: list[float] = bounded([0.5, 0.0, 0.0], -10.0, 10.0)

    # Image size in pixels, focal length in pixels; the principal point is the image's middle.
    width: int = bounded(640, 16, 4096)
    height: int = bounded(480, 16, 4096)
    focal_length: float = bounded(450.0, 10.0, 10000.0)


@dc.dataclass
class Heightmap:
    """The orthographic observation o_t. Tools and kit are drawn within it, and on the table."""

    # Lower corner of the workspace in the world, in m.
    x_min: float = bounded(0.25, -10.0, 10.0)
    y_min: float = bounded(-0.5, -10.0, 10.0)

    # Side of a pixel, in m, and pixels along x and y.
    resolution: float = bounded(0.003125, 1e-4, 0.1)
    rows: int = bounded(160, 1, 4096)
    cols: int = bounded(320, 1, 4096)

    # Heights outside this range are not seen, in m.
    z_min: float = bounded(0.0, -1.0, 10.0)
    z_max: float = bounded(0.28, -1.0, 10.0)


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
class Plant:
    """The physics."""

    # Discrete step, in s. Powers of two divide every other period of the cell exactly.
    time_step: float = bounded(0.00390625, 1e-5, 0.02)

    # Drake's approximation of contact: lagged, similar or sap.
    contact_approximation: str = "lagged"


@dc.dataclass
class Sleep:
    """What rests costs nothing: a tool at rest, out of reach of anything that moves, is frozen."""

    enabled: bool = True

    # A tool is at rest below these speeds (m/s, rad/s) ...
    linear_speed: float = bounded(0.002, 0.0, 1.0)
    angular_speed: float = bounded(0.05, 0.0, 10.0)

    # ... that have lasted this long, in s.
    patience: float = bounded(0.25, 0.0, 10.0)

    # It wakes when the hand, or an object that is awake, comes this near, in m.
    wake_distance: float = bounded(0.006, 0.001, 1.0)


@dc.dataclass
class Scenario:
    """Everything about an episode but its seed."""

    # The seed when none is given on the command line.
    random_seed: int = bounded(0, 0, 2**32 - 1)

    # The episode ends after this much simulated time whatever happens, in s.
    time_limit: float = bounded(180.0, 0.1, 1e6)

    # Live viewing: 1 is real time, 0 as fast as the machine allows.
    target_realtime_rate: float = bounded(0.0, 0.0, 100.0)

    # What stands on the table, and its score: !Kitting, !ToolsetKitting or !ArrangedKitting.
    task: Kitting | ToolsetKitting | ArrangedKitting = dc.field(default_factory=Kitting)

    # Who decides: !Oracle, !QuantisedOracle, !Learned or !PythonPolicy.
    policy: Oracle | QuantisedOracle | Learned | PythonPolicy = dc.field(default_factory=Oracle)

    # The RGB-D cameras by name: !Pinhole or !LookAt. These three are those of Ravens.
    cameras: dict[str, Pinhole | LookAt] = dc.field(
        default_factory=lambda: {
            "front": Pinhole(position=[1.0, 0.0, 0.75], rpy_deg=[45.0, 180.0, -90.0]),
            "left": Pinhole(position=[0.0, 0.5, 0.75], rpy_deg=[40.0, 180.0, 45.0]),
            "right": Pinhole(position=[0.0, -0.5, 0.75], rpy_deg=[40.0, 180.0, 135.0]),
        }
    )

    # What the policy sees.
    heightmap: Heightmap = dc.field(default_factory=Heightmap)

    # How the hand moves.
    planner: PickPlaceParameters = dc.field(default_factory=PickPlaceParameters)
    controller: Controller = dc.field(default_factory=Controller)

    # The physics.
    plant: Plant = dc.field(default_factory=Plant)
    sleep: Sleep = dc.field(default_factory=Sleep)


def load_scenario(path: Path, name: str | None = None, text: str | None = None) -> Scenario:
    """Reads a scenario.

    Args:
        path: the YAML file: a mapping from names to scenarios.
        name: which one; the first when None.
        text: YAML merged over it: mappings field by field, all else replaced; a tag that is not
            given is that of what is merged over.

    Raises:
        UserError: the file cannot be used; names the file and the field.
    """
    try:
        content = path.read_text()
    except (OSError, UnicodeDecodeError) as error:
        reason = getattr(error, "strerror", None) or "it is not a text file"
        raise UserError(f"cannot read the scenario {path}: {reason}") from error
    root = _parse(content, str(path))
    names = list(root)
    fields = {item.name for item in dc.fields(Scenario)}
    if names and not set(names) - fields:
        raise UserError(
            f"{path}: '{names[0]}' is a field, not a scenario: put the fields under a name of yours"
        )
    if name is None:
        if not names:
            raise UserError(f"{path} holds no scenario")
        name = names[0]
    if name not in root:
        raise UserError(f"{path} has no scenario '{name}': use one of {', '.join(names)}")
    scenario = _load(root[name], content, name, Scenario(), f"{path}: {name}")
    if text is not None:
        raw, defaults = _onto(_parse(text, "--scenario_text"), scenario)
        scenario = _load(raw, yaml_dump(raw), None, defaults, "--scenario_text")
    return scenario


def _parse(content: str, where: str) -> dict:
    try:
        # A Python mapping swallows a field that is given twice.
        _check_names(yaml.compose(content, Loader=yaml.SafeLoader))
        # Drake takes an empty text for no text at all.
        root = yaml_load(data=content) if content.strip() else None
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        line = f", line {mark.line + 1}" if mark else ""
        problem = getattr(error, "problem", None) or "it cannot be parsed"
        raise UserError(f"{where}{line} is not YAML: {problem}") from error
    except ValueError as error:
        raise UserError(f"{where}: {error}") from error
    except RecursionError as error:
        raise UserError(f"{where} is not YAML that ends: it contains itself") from error
    if root is None:
        return {}
    if not isinstance(root, dict):
        raise UserError(f"{where} must be a mapping of names, not a {type(root).__name__}")
    return root


def _onto(raw: dict, defaults: Scenario) -> tuple[dict, Scenario]:
    """Makes ready what is merged over a scenario.

    Drake reads a mapping without a tag as the first variant of its union; here it is of the variant
    that it is merged over. And where a tag brings another variant, nothing of its default mappings
    is to remain beside what is given.
    """
    tagged = dict(raw)
    for name in ("task", "policy"):
        if name in raw:
            tagged[name] = _of_variant(raw[name], getattr(defaults, name))
    task = tagged.get("task")
    if (
        isinstance(task, dict)
        and task["_tag"] == "!ArrangedKitting"
        and "tools" in task
        and not isinstance(defaults.task, ArrangedKitting)
    ):
        defaults = dc.replace(defaults, task=ArrangedKitting(tools={}))
    cameras = raw.get("cameras")
    if isinstance(cameras, dict):
        tagged["cameras"] = {
            name: _of_variant(camera, defaults.cameras[name])
            if name in defaults.cameras
            else camera
            for name, camera in cameras.items()
        }
    return tagged, defaults


def _of_variant(given: object, current: object) -> object:
    """A mapping with the tag of a variant, if it has none of its own."""
    return {"_tag": f"!{type(current).__name__}", **given} if isinstance(given, dict) else given


def _check_names(node: yaml.Node | None) -> None:
    if isinstance(node, yaml.MappingNode):
        seen = set()
        for key, value in node.value:
            line = key.start_mark.line + 1
            if key.tag != "tag:yaml.org,2002:str":
                raise ValueError(f"the name on line {line} must be a text")
            if key.value in seen:
                raise ValueError(f"'{key.value}' is given twice (again on line {line})")
            seen.add(key.value)
            _check_names(value)
    elif isinstance(node, yaml.SequenceNode):
        for item in node.value:
            _check_names(item)


def _load(raw: object, content: str, name: str | None, defaults: Scenario, where: str) -> Scenario:
    try:
        check_yaml(Scenario, raw if raw is not None else {}, "")
        if raw is None or raw == {}:
            scenario = defaults
        else:
            scenario = yaml_load_typed(
                schema=Scenario,
                data=content,
                child_name=name,
                defaults=defaults,
                # A file's cameras and tools replace the default ones; --scenario_text adds.
                retain_map_defaults=name is None,
            )
        check_bounds(scenario)
        _check_meaning(scenario)
    except (ValueError, RuntimeError) as error:
        text = str(error).splitlines()[0]
        raise UserError(f"{where}: {text}") from error
    return scenario


def _check_meaning(scenario: Scenario) -> None:
    """What no type and no range can say."""
    if scenario.plant.contact_approximation not in ("lagged", "similar", "sap"):
        raise ValueError(
            "plant.contact_approximation must be lagged, similar or sap, "
            f"not '{scenario.plant.contact_approximation}'"
        )
    steps = (1 / 64) / scenario.plant.time_step
    if abs(steps - round(steps)) > 1e-9 or steps < 1:
        raise ValueError(
            "plant.time_step must divide 1/64 s, the planner's period, "
            f"not be {scenario.plant.time_step:g}"
        )
    if scenario.heightmap.z_max <= scenario.heightmap.z_min:
        raise ValueError("heightmap.z_max must be above heightmap.z_min")
    task = scenario.task
    if isinstance(task, ToolsetKitting):
        if task.split not in SPLITS:
            raise ValueError(f"task.split must be one of {', '.join(SPLITS)}, not '{task.split}'")
    elif not task.tools:
        raise ValueError("task.tools is empty: name at least one tool")
    for key, camera in scenario.cameras.items():
        if isinstance(camera, LookAt) and camera.position[:2] == camera.target[:2]:
            raise ValueError(
                f"cameras.{key} looks straight down, where upright means nothing: use !Pinhole"
            )
    planner = scenario.planner
    if planner.home[2] < planner.floor_clearance:
        raise ValueError(
            "planner.home[2] is below planner.floor_clearance: the hand would begin in the table"
        )
    if planner.grasp_force > scenario.controller.finger_force_limit:
        raise ValueError(
            f"planner.grasp_force is {planner.grasp_force:g} N, more than the fingers can press "
            f"(controller.finger_force_limit: {scenario.controller.finger_force_limit:g} N)"
        )
    policy = scenario.policy
    if isinstance(policy, Learned) and not policy.weights:
        raise ValueError("policy.weights is empty: name a file that train wrote")
    if isinstance(policy, Learned | PythonPolicy) and not scenario.cameras:
        raise ValueError("cameras is empty: this policy needs at least one to see by")
    if isinstance(policy, PythonPolicy):
        module, _, function = policy.function.partition(":")
        if not module or not function:
            raise ValueError(f"policy.function must be module:function, not '{policy.function}'")
