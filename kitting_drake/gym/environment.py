"""The Gymnasium environment: one step is one pick and place."""

import dataclasses
import gc
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydrake.common.value import Value

from kitting_drake.common.errors import UserError
from kitting_drake.common.rendering import (
    add_picture_renderer,
    render_picture,
    require_rendering,
)
from kitting_drake.common.seeds import ALL_SEEDS
from kitting_drake.episode import Episode, EpisodeResult
from kitting_drake.gym.spaces import (
    action_space,
    as_action,
    as_arrays,
    observation_space,
)
from kitting_drake.scenario.choosing import find_scenario
from kitting_drake.scenario.schema import Scenario
from kitting_drake.station import KittingStation, build_station
from systems.placement import ALL
from systems.signals import Observation, PickPlaceAction
from systems.surface_heights import read_surface_heights


class KittingEnvironment(gymnasium.Env[dict[str, Any], NDArray[Any]]):
    """A scenario's station as an environment. The agent replaces the scenario's policy.

    - Observation and action: see `gym.spaces`. The observation is o_t at the time when a policy
      would be called, while the hand waits out of the cameras' sight.
    - Reward: the increase of the task's reward, so that the return equals `success_rate` in
      `results.json`. If the episode times out or fails, the last step subtracts the reward earned
      before, so that the return is 0, as is `success_rate`.
    - Terminated: the agent stopped, or every goal is filled. Truncated: no actions or no time are
      left, or the simulation failed (`info["failure"]`).
    - `info`: the present values of the keys of `results.json`, without `wall_seconds`, which would
      not be reproducible; `failed_picks`, (x, y, theta) of each failed grasp; and `history`, the
      last 64 actions as dicts with the fields of `systems.signals.Attempt`.
    - `reset(seed=N)` makes the scene of seed N, as in `evaluate` and `run`. Without a seed, it
      chooses one at random. `info["seed"]` holds the seed. `reset` has no `options`, and warns of
      any that are given.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 1}  # noqa: RUF012  Gymnasium's own way.

    def __init__(
        self,
        scenario: str | Path,
        scenario_name: str | None = None,
        scenario_text: str | None = None,
        perturb: str | None = None,
        *,
        cameras: bool = False,
        render_mode: str | None = None,
    ) -> None:
        """
        Args:
            scenario: a scenario file, or the name of a scenario file of the project. The scenario's
                policy is ignored.
            scenario_name: the name of a scenario in the file; None for the first.
            scenario_text: YAML that is merged over the scenario.
            perturb: perturbations, as for `--perturb`.
            cameras: whether observations also contain the cameras' images.
            render_mode: `rgb_array` for `render`, or None.

        Raises:
            UserError: the scenario is invalid.
            ValueError: the render mode does not exist.
        """
        if render_mode not in (None, *self.metadata["render_modes"]):
            raise ValueError(f"render_mode must be rgb_array or None, not {render_mode!r}")
        found = find_scenario(Path(scenario), scenario_name, scenario_text, perturb)
        if not found.scenario.cameras:
            raise UserError(f"{found.path}: cameras is empty: an agent needs at least one camera")
        self._chosen = found
        self.render_mode = render_mode
        self.grid = found.scenario.heightmap.grid()
        """The pixel grid of the observations."""
        self.observation_space = observation_space(found.scenario, cameras=cameras)
        self.action_space = action_space(self.grid)
        self._with_cameras = cameras
        self._station: KittingStation | None = None
        self._episode: Episode | None = None
        self._earned = 0.0

    @property
    def scenario(self) -> Scenario:
        """The scenario; its policy is ignored."""
        return self._chosen.scenario

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Any], dict[str, Any]]:
        """Makes a new scene; returns its observation and `info` (see the docstring of the class).

        Raises:
            ValueError: the seed is invalid.
            UserError: the scene cannot be made, or the episode ends before its first action.
        """
        if seed is not None and not 0 <= seed < ALL_SEEDS.stop:
            raise ValueError(f"seed must be an integer from 0 to {ALL_SEEDS[-1]}, not {seed}")
        if options:
            gymnasium.logger.warn(
                f"reset() ignores its options {', '.join(map(str, options))}: the scene follows "
                "from the seed alone"
            )
        super().reset(seed=seed)
        chosen_seed = int(self.np_random.integers(ALL_SEEDS.stop)) if seed is None else int(seed)
        self.close()
        station = self._station = self._build(chosen_seed)
        self._episode = Episode(
            station, station, scenario=self._chosen.name, policy="agent", pauses=True
        )
        self._earned = 0.0
        self._advance(self._episode)
        if self._episode.is_over:
            why = self._episode.failure or "planner.max_actions is 0"
            if self._episode.timed_out:
                why = f"time_limit is {self.scenario.time_limit:g} s"
            raise UserError(
                f"{self._chosen.path}: with seed {chosen_seed} the episode ended before the first "
                f"action: {why}"
            )
        return self._observe(), self._info(self._episode.result())

    def _build(self, seed: int) -> KittingStation:
        """Builds a station with cameras.

        Raises:
            UserError: the scene cannot be made.
            MachineError: this machine cannot render.
        """
        require_rendering()
        with self._chosen.named_in_errors():
            station = build_station(self.scenario, seed, self._chosen.base)
        if self.render_mode is not None:
            add_picture_renderer(station.scene_graph)
        return station

    def step(self, action: ArrayLike) -> tuple[dict[str, Any], float, bool, bool, dict[str, Any]]:
        """Executes one pick and place, or stops, as Gymnasium and the docstring of the class
        describe.

        Args:
            action: (7,) the entries of `gym.spaces.ACTION`. Positions are clipped to the workspace.

        Raises:
            ValueError: the action is not seven finite numbers.
            gymnasium.error.ResetNeeded: no episode has begun, or it is over.
        """
        if self._episode is None or self._episode.is_over:
            raise gymnasium.error.ResetNeeded("no episode is running: call reset() first")
        episode = self._episode
        given = as_action(action, self.grid)
        self._give(episode, self._with_heights(given))
        result = episode.result()
        is_done = result.success_rate > ALL
        if is_done and not episode.is_over:
            # The task is finished. Send a stop on behalf of the agent, as a policy would.
            self._give(episode, PickPlaceAction(stop=True))
            result = episode.result()
            is_done = result.success_rate > ALL
        reward, self._earned = result.success_rate - self._earned, result.success_rate
        was_cut = episode.timed_out or episode.failure is not None
        terminated = episode.is_over and not was_cut and (given.stop or is_done)
        truncated = episode.is_over and not terminated
        return self._observe(), reward, terminated, truncated, self._info(result)

    def render(self) -> NDArray[np.uint8] | None:
        """Returns a picture (800, 1280, 3) of the whole cell; None without a render mode.

        Raises:
            gymnasium.error.ResetNeeded: there is no scene yet.
        """
        if self.render_mode is None:
            return None
        if self._station is None or self._episode is None:
            raise gymnasium.error.ResetNeeded("there is no scene to render: call reset() first")
        scene_graph = self._station.scene_graph
        context = scene_graph.GetMyContextFromRoot(self._episode.context)
        return render_picture(scene_graph, context, self._station.X_WOverview)

    def close(self) -> None:
        """Frees the simulation. Drake 1.51 (for Python 3.11) keeps about 35 MB of it in memory."""
        self._station = self._episode = None
        # A Diagram and its systems form reference cycles, which only the garbage collector frees.
        gc.collect()

    def _give(self, episode: Episode, action: PickPlaceAction) -> None:
        assert self._station is not None
        self._station.GetInputPort("action").FixValue(episode.context, Value(action))
        self._advance(episode)

    @staticmethod
    def _advance(episode: Episode) -> None:
        episode.advance()
        if episode.interrupted:
            raise KeyboardInterrupt

    def _observation(self) -> Observation:
        return self._eval("observation")

    def _eval(self, port: str) -> Any:
        """Returns the value of an output port of the station."""
        assert self._station is not None and self._episode is not None
        return self._station.GetOutputPort(port).Eval(self._episode.context)

    def _with_heights(self, action: PickPlaceAction) -> PickPlaceAction:
        """Adds surface heights, which are read from the agent's o_t, to the action."""
        heights = read_surface_heights(self._observation(), action.pick, action.place)
        return dataclasses.replace(action, heights=heights)

    def _observe(self) -> dict[str, Any]:
        arrays: dict[str, Any] = dict(as_arrays(self._observation()))
        if self._with_cameras:
            arrays["cameras"] = {name: self._images(name) for name in self.scenario.cameras}
        return arrays

    def _images(self, camera: str) -> dict[str, NDArray[Any]]:
        """Returns a camera's images from which o_t was projected, with the scenario's noise."""
        colour, depth = (self._eval(f"{kind}_image_{camera}").data for kind in ("color", "depth"))
        return {"colour": np.array(colour[:, :, :3]), "depth": np.array(depth[:, :, 0])}

    def _info(self, result: EpisodeResult) -> dict[str, Any]:
        failed = self._eval("failed_picks")
        picks = tuple((pick.x, pick.y, pick.theta) for pick in failed)
        history = tuple(dataclasses.asdict(attempt) for attempt in self._eval("history"))
        info = {**result.as_dict(), "failed_picks": picks, "history": history}
        del info["wall_seconds"]
        return info
