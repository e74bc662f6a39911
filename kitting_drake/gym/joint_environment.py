"""The Gymnasium environment whose actions are joint targets: one step is one control period."""

import dataclasses
import gc
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces
from numpy.typing import ArrayLike, NDArray
from pydrake.common.value import Value
from pydrake.geometry import SceneGraph
from pydrake.multibody.plant import MultibodyPlant
from pydrake.systems.analysis import Simulator

from kitting_drake.common.rendering import (
    add_picture_renderer,
    render_picture,
    require_rendering,
)
from kitting_drake.common.seeds import ALL_SEEDS
from kitting_drake.episode.episode import object_results
from kitting_drake.episode.joint_view import JointView, chosen_cameras
from kitting_drake.policies.data.frames import (
    DEFAULT_RATE,
    DEFAULT_WIDTH,
    GRIPPER,
    STATE,
    FrameSettings,
    image_key,
)
from kitting_drake.scenario.choosing import find_scenario
from kitting_drake.scenario.schema import Scenario
from kitting_drake.station import KittingStation, build_station
from kitting_drake.station.robot import add_robot, joint_names
from systems.placement import ALL, strict_reward
from systems.signals import PickPlaceAction


class JointEnvironment(gymnasium.Env[dict[str, NDArray[Any]], NDArray[np.float32]]):
    """A scenario's station as an environment in which the agent commands the joints. The scenario's
    policy and planner are not used.

    - Names and values are those of `collect --export lerobot`: see `policies.data.frames`.
    - Observation: `observation.state`, and `observation.images.CAMERA` of each camera.
    - Action: a target for each of `names`, in m and rad, to be reached after 1 / `fps` seconds.
      Commands move to the targets in a straight line, within the joints' velocity limits.
    - Reward: the increase of the task's reward. The sum of all rewards is 1 when every goal is
      filled.
    - Terminated: every goal is filled, and all objects are released and at rest. Truncated: the
      scenario's `time_limit` is over, or the simulation failed (`info["failure"]`).
    - `info`: `seed`, `seconds`, `is_success`, `success_rate`, `strict_success_rate`, `failure`, and
      `objects` as in `results.json`.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": DEFAULT_RATE}  # noqa: RUF012

    def __init__(
        self,
        scenario: str | Path,
        scenario_name: str | None = None,
        scenario_text: str | None = None,
        perturb: str | None = None,
        *,
        fps: int = DEFAULT_RATE,
        image_width: int = DEFAULT_WIDTH,
        cameras: Sequence[str] = (),
        render_mode: str | None = None,
    ) -> None:
        """
        Args:
            scenario: a scenario file, or the name of a scenario file of the project.
            scenario_name: the name of a scenario in the file; None for the first.
            scenario_text: YAML that is merged over the scenario, such as `{robot: !FrankaArm {}}`.
            perturb: perturbations, as for `--perturb`.
            fps: the number of steps per simulated second.
            image_width: the largest width of the images, in pixels.
            cameras: the names of the cameras whose images are observed; empty for all.
            render_mode: `rgb_array` for `render`, or None.

        Raises:
            UserError: the scenario, the rate or a camera cannot be used.
            ValueError: the render mode does not exist.
        """
        if render_mode not in (None, *self.metadata["render_modes"]):
            raise ValueError(f"render_mode must be rgb_array or None, not {render_mode!r}")
        self._chosen = find_scenario(Path(scenario), scenario_name, scenario_text, perturb)
        self._recording = FrameSettings(fps, image_width, tuple(cameras))
        self.render_mode = render_mode
        self.metadata = {**self.metadata, "render_fps": fps}
        config = self._chosen.scenario
        self.names = (*joint_names(config.robot), GRIPPER)
        """The names of the entries of state and action."""
        images = {}
        for name in chosen_cameras(self._recording, config.cameras):
            camera = config.cameras[name]
            width, height = self._recording.size(camera.width, camera.height)
            images[image_key(name)] = spaces.Box(0, 255, (height, width, 3), np.uint8)
        entries = len(self.names)
        state = spaces.Box(-np.inf, np.inf, (entries,), np.float32)
        parts: dict[str, spaces.Space[Any]] = {STATE: state, **images}
        self.observation_space = spaces.Dict(parts)  # type: ignore[assignment]
        low, high, self._fastest = self._limits()
        self.action_space = spaces.Box(low, high, dtype=np.float32)
        self._station: KittingStation | None = None
        self._simulator: Simulator | None = None
        self._view: JointView | None = None
        self._target = np.zeros(entries)
        self._steps = 0
        self._earned = 0.0
        self._is_over = True

    @property
    def scenario(self) -> Scenario:
        """The scenario; its policy is ignored."""
        return self._chosen.scenario

    def _limits(self) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float64]]:
        """Returns the smallest and the largest targets, and the largest rates of the joints."""
        plant = MultibodyPlant(self.scenario.plant.time_step)
        scene_graph = SceneGraph()
        plant.RegisterAsSourceForSceneGraph(scene_graph)
        add_robot(plant, self.scenario.robot)
        plant.Finalize()
        joints = [plant.GetJointByName(name) for name in self.names[:-1]]
        low = [float(joint.position_lower_limits()[0]) for joint in joints]
        high = [float(joint.position_upper_limits()[0]) for joint in joints]
        rates = [float(joint.velocity_upper_limits()[0]) for joint in joints]
        config = self.scenario.controller
        # With this target opening, fully closed fingers press on each other with the largest force
        # (see `FingerLaw`).
        tightest = -2 * config.finger_force_limit / config.finger_stiffness
        return (
            np.array([*low, tightest], np.float32),
            np.array([*high, self.scenario.planner.open_width], np.float32),
            np.array(rates),
        )

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, NDArray[Any]], dict[str, Any]]:
        """Makes the scene of a seed, as in `evaluate --seed N`; returns its observation and `info`.
        Without a seed, it chooses one at random.

        Raises:
            ValueError: the seed is invalid.
            UserError: the scene cannot be made.
        """
        if seed is not None and not 0 <= seed < ALL_SEEDS.stop:
            raise ValueError(f"seed must be an integer from 0 to {ALL_SEEDS[-1]}, not {seed}")
        super().reset(seed=seed)
        number = int(self.np_random.integers(ALL_SEEDS.stop)) if seed is None else int(seed)
        self.close()
        require_rendering()
        with self._chosen.named_in_errors():
            station = build_station(
                self.scenario, number, self._chosen.base, takes_joint_targets=True
            )
            self._view = JointView(station, self._recording)
        if self.render_mode is not None:
            add_picture_renderer(station.scene_graph)
        self._station, self._simulator = station, station.make_simulator()
        # Stop the planner when it first asks for an action.
        stop = Value(PickPlaceAction(stop=True))
        station.GetInputPort("action").FixValue(self._context, stop)
        self._target = self._view.command(self._context).astype(float)
        self._command(self._target, np.zeros(len(self._target)))
        self._simulator.Initialize()
        self._steps, self._earned, self._is_over = 0, 0.0, False
        return self._observe(), self._info(None)

    def step(
        self, action: ArrayLike
    ) -> tuple[dict[str, NDArray[Any]], float, bool, bool, dict[str, Any]]:
        """Advances by one control period, as the docstring of the class describes.

        Args:
            action: a target for each of `names`, clipped to the `action_space`.

        Raises:
            ValueError: the action does not have one finite number for each of `names`.
            gymnasium.error.ResetNeeded: no episode has begun, or it is over.
        """
        if self._is_over or self._station is None or self._simulator is None:
            raise gymnasium.error.ResetNeeded("no episode is running: call reset() first")
        given = np.asarray(action, dtype=float)
        if given.shape != self._target.shape or not np.isfinite(given).all():
            raise ValueError(f"an action must have {len(self.names)} finite numbers, not {given}")
        failure = None
        try:
            self._advance(given)
        except RuntimeError as error:
            failure = " ".join(str(error).split())
        self._steps += 1
        reward = self._station.reward(self._context)
        gained, self._earned = reward - self._earned, reward
        rests = bool(self._station.at_rest(self._context).all())
        terminated = failure is None and reward > ALL and rests
        is_late = self._context.get_time() > self.scenario.time_limit - 1e-6
        truncated = not terminated and (failure is not None or is_late)
        self._is_over = terminated or truncated
        return self._observe(), float(gained), terminated, truncated, self._info(failure)

    def _advance(self, given: NDArray[np.float64]) -> None:
        """Moves the commands step by step to the targets, and advances the simulation meanwhile."""
        assert self._station is not None and self._simulator is not None
        space, fps = self.action_space, self._recording.fps
        assert isinstance(space, spaces.Box)
        wanted = np.clip(given, space.low, space.high)
        most = self._fastest / fps
        way = wanted - self._target
        way[:-1] = np.clip(way[:-1], -most, most)
        step = self._station.plant.time_step()
        first, last = (round(n / fps / step) for n in (self._steps, self._steps + 1))
        start, rate = self._target.copy(), way / ((last - first) * step)
        for number in range(first, last):
            self._command(start + (number - first) * step * rate, rate)
            self._simulator.AdvanceTo((number + 1) * step)
        self._target = start + way

    def _command(self, target: NDArray[np.float64], rate: NDArray[np.float64]) -> None:
        assert self._station is not None
        motion = [*target[:-1], *rate[:-1], *np.zeros(len(rate) - 1)]
        for name, value in (
            ("desired_motion", motion),
            ("desired_opening", [target[-1], rate[-1]]),
            ("closing_force", [0.0]),
        ):
            self._station.GetInputPort(name).FixValue(self._context, np.array(value))

    @property
    def _context(self) -> Any:
        assert self._simulator is not None
        return self._simulator.get_mutable_context()

    def _observe(self) -> dict[str, NDArray[Any]]:
        assert self._view is not None
        return {STATE: self._view.state(self._context), **self._view.images(self._context)}

    def _info(self, failure: str | None) -> dict[str, Any]:
        assert self._station is not None
        station, context = self._station, self._context
        placements = station.placements(context)
        results = object_results(station, context, placements)
        return {
            "seed": station.seed,
            "seconds": context.get_time(),
            "is_success": station.reward(context) > ALL,
            "success_rate": station.reward(context),
            "strict_success_rate": strict_reward(station.scene.goals, placements),
            "failure": failure,
            "objects": [dataclasses.asdict(item) for item in results],
        }

    def render(self) -> NDArray[np.uint8] | None:
        """Returns a picture (800, 1280, 3) of the whole cell; None without a render mode.

        Raises:
            gymnasium.error.ResetNeeded: there is no scene yet.
        """
        if self.render_mode is None:
            return None
        if self._station is None:
            raise gymnasium.error.ResetNeeded("there is no scene to render: call reset() first")
        scene_graph = self._station.scene_graph
        context = scene_graph.GetMyContextFromRoot(self._context)
        return render_picture(scene_graph, context, self._station.X_WOverview)

    def close(self) -> None:
        """Frees the simulation."""
        self._station = self._simulator = self._view = None
        self._is_over = True
        # A Diagram and its systems form reference cycles, which only the garbage collector frees.
        gc.collect()
