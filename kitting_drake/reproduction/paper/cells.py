"""The cells of the paper's tables, and of tables of our own: how each is trained and evaluated, and
which runs count."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

from kitting_drake.common.paths import SCENARIOS
from kitting_drake.reproduction.page.runs import described, scenario_differences
from kitting_drake.reproduction.paper.learning_rates import Rates, best_rate
from kitting_drake.scenario.loader import load_scenario
from kitting_drake.scenario.schema import Scenario

ORIENTATIONS = (180, 36, 72, 120)
"""The values of N in figure 6, in order of importance."""
PRESET = "small"
LEARNING_RATES = (1e-3, 3e-4, 3e-3)
"""The learning rates to try. The SO(2) method uses the first. Each baseline uses the one that is
best on validation scenes."""
VALIDATE_EVERY = 250
_EARLIER_RELEASE = ("planner.release_clearance: 0.006", "planner.open_width: 0.08")
"""Fields of the planner in older runs of Ravens tasks, in which the jaws opened wider and the
demonstrators were different."""
_NO_SEARCH = "planner: {search: {amplitude: 0.0, reach: 0.0}}"


@dataclass(frozen=True)
class Task:
    """A task with its scenarios for training and testing."""

    name: str
    file: str
    """The scenario file of the task."""
    tested: str
    """The name of the evaluated scenario."""
    demonstrated: str
    """The name of the scenario of the demonstrations."""
    first_seed: int
    table: str = "6"
    """The table to which the task belongs: `6` (figure 6), `I` (table I), `fresh` or `shapes`."""
    episodes: int = 100
    steps: int = 1500
    more_steps: int = 0
    """Additional steps for trainings that use more labels or augmentation than the paper."""
    demonstrations: int = 100
    """The largest number of training demonstrations. Their seeds start at 10000, those for
    validation at 20000."""
    validation: int = 24
    rates_from: str = "unseen"
    """The task on which the baselines' learning rates are chosen."""
    earlier: tuple[str, ...] = ()
    """How scenarios of older runs may differ from the task's scenario; see `Cell.is_earlier`."""


TASKS = {
    task.name: task
    for task in (
        Task(
            "unseen",
            "paper/kitting_unseen.yaml",
            "KittingUnseenToolsets",
            "KittingUnseenToolsetsTraining",
            first_seed=3000,
            more_steps=900,
        ),
        Task(
            "seen",
            "paper/kitting_seen.yaml",
            "KittingSeenToolset",
            "KittingSeenToolset",
            first_seed=3000,
            steps=1000,
        ),
        Task(
            "fresh",
            "paper/kitting_unseen.yaml",
            "FreshToolsets",
            "KittingUnseenToolsetsTraining",
            first_seed=3400,
            table="fresh",
        ),
        Task(
            "assembling_kits",
            "assembling_kits.yaml",
            "Test",
            "Train",
            first_seed=3600,
            table="shapes",
            episodes=25,
            steps=600,
            validation=12,
        ),
        *(
            Task(
                name,
                "ravens.yaml",
                scenario,
                scenario,
                first_seed=3200,
                table="I",
                episodes=episodes,
                steps=steps,
                validation=validation,
                rates_from=rates_from,
                earlier=earlier,
            )
            # Palletizing has eighteen decisions per episode, so few episodes suffice for
            # validation. It has many equally good places, so it takes more steps to learn.
            # On the pyramid and on align-box-corner, the learning rates of figure 6 are not the
            # best ones for a baseline. So these two tasks have their own learning rates.
            # Palletizing uses the rates of the pyramid.
            for name, scenario, episodes, steps, validation, rates_from, earlier in (
                ("block_insertion", "BlockInsertion", 100, 1000, 24, "unseen", _EARLIER_RELEASE),
                (
                    "place_red_in_green",
                    "PlaceRedInGreen",
                    100,
                    1000,
                    24,
                    "unseen",
                    _EARLIER_RELEASE,
                ),
                ("palletizing_boxes", "PalletizingBoxes", 50, 3000, 6, "stack_block_pyramid", ()),
                (
                    "align_box_corner",
                    "AlignBoxCorner",
                    100,
                    1000,
                    24,
                    "align_box_corner",
                    _EARLIER_RELEASE,
                ),
                (
                    "stack_block_pyramid",
                    "StackBlockPyramid",
                    100,
                    1000,
                    24,
                    "stack_block_pyramid",
                    (),
                ),
            )
        ),
    )
}


@dataclass(frozen=True)
class Training:
    """The training of a method's networks on a task's demonstrations."""

    task: str
    method: str
    orientations: int
    demonstrations: int
    seed: int = 0
    learning_rate: float | None = None
    """The learning rate. For the SO(2) method, None stands for the first of `LEARNING_RATES`; for a
    baseline, it stands for the best rate of the `reference`."""
    taken_only: bool = True
    """Whether only the action that was taken is a label, as in the paper."""
    rigid: bool = True
    """Whether the only augmentation is a rigid motion of the scene, as in the paper."""
    angle_only: bool = False
    """Whether only the pick-angle network is trained. The other networks are those of `base`."""
    times: int = 1
    """The training has this many times the usual number of steps."""
    preset: str = PRESET
    """The preset, which gives the size of the networks."""
    rotations: int | None = None
    """The number of rotations in a training step of the Transporter, as in `Networks`."""

    @property
    def base(self) -> Training | None:
        """The training that provides all networks but the pick-angle network."""
        if not self.angle_only:
            return None
        return dataclasses.replace(
            self, orientations=ORIENTATIONS[0], angle_only=False, preset=PRESET
        )

    @property
    def steps(self) -> int:
        """The number of steps. As in the paper, it depends on the task and not on the method. More
        labels or augmentation than in the paper, or `times`, increase it."""
        task = TASKS[self.task]
        more = 0 if self.taken_only and self.rigid else task.more_steps
        return self.times * (task.steps + more)

    @property
    def name(self) -> str:
        """The name of the training's folder, without the learning rate."""
        kind = "" if self.taken_only and self.rigid else "_ours"
        if kind and self.taken_only:
            kind += "_taken_only"
        if kind and self.rigid:
            kind += "_rigid"
        if self.angle_only:
            kind += "_angle_only"
        if self.times > 1:
            kind += f"_{self.times}_times_the_steps"
        if self.preset != PRESET:
            kind += f"_{self.preset}"
        if self.rotations is not None:
            kind += f"_{self.rotations}_rotations"
        return (
            f"{self.task}_{self.method}_{self.orientations}_{self.demonstrations}{kind}"
            f"_seed{self.seed}"
        )


def reference(training: Training) -> Training:
    """Returns the training that is run with each of `LEARNING_RATES` to choose the rate of a
    baseline's training. In the result, `learning_rate` is None."""
    return Training(TASKS[training.task].rates_from, training.method, 36, 100)


def rates_key(chosen_by: Training) -> str:
    """Returns the key in `Rates` of a training that was returned by `reference`."""
    return f"{chosen_by.task}_{chosen_by.method}"


@dataclass(frozen=True)
class Cell:
    """A cell of the paper's tables, or of our own: the evaluation of a policy on a task."""

    task: str
    policy: Training | str
    """The training of the policy's networks; for a policy without networks, its YAML text."""
    orientations: int | None
    """The number N of orientations at inference; None if the policy has none."""
    label: str = ""
    """A label that distinguishes the cell from the paper's cell with the same task, policy and
    N."""
    continuous: bool = False
    """Whether actions are refined beyond pixels and bins; the paper quantizes them."""
    fit_outlines: bool = False
    """Whether actions are refined by outlines, as in `Learned`. In the paper they are not."""
    search: bool = False
    """Whether the hand searches when an insertion is blocked. In the paper it does not."""
    end_at_success: bool = False
    """Whether the episode ends as soon as the task is done, as in the paper."""
    recover: bool = False
    """Whether the policy corrects failed insertions, with two actions per object."""
    avoid_failed_picks: bool = False
    """Whether the policy avoids failed picks. In the paper it does not."""

    @property
    def name(self) -> str:
        """The name of the run that fills this cell."""
        if isinstance(self.policy, str):
            parts = [self.task, self.label, str(self.orientations or "")]
            return "_".join(part for part in parts if part)
        training = self.policy
        parts = [
            self.task,
            training.method,
            str(self.orientations),
            str(training.demonstrations),
            self.label,
            f"seed{training.seed}" if training.seed else "",
        ]
        return "_".join(part for part in parts if part)

    @property
    def seeds(self) -> range:
        """The seeds of the episodes, which are the same for all cells of a task."""
        task = TASKS[self.task]
        return range(task.first_seed, task.first_seed + task.episodes)

    def scenario_text(self, weights: str) -> str:
        """Returns the YAML to merge over the task's scenario.

        Args:
            weights: the weights file; ignored for a policy without networks.
        """
        if isinstance(self.policy, str):
            policy = self.policy
        else:
            fields = {
                "weights": f'"{weights}"',
                "orientations": self.orientations,
                "continuous": str(self.continuous).lower(),
                "fit_outlines": str(self.fit_outlines).lower(),
                "recover": str(self.recover).lower(),
                "avoid_failed_picks": str(self.avoid_failed_picks).lower(),
            }
            policy = f"!Learned {{{', '.join(f'{key}: {value}' for key, value in fields.items())}}}"
        parts = [f"policy: {policy}"]
        if not self.search:
            parts.append(_NO_SEARCH)
        if self.end_at_success:
            parts.append("end_at_success: true")
        if self.recover:
            parts.append("task: {tries: 2}")
        return f"{{{', '.join(parts)}}}"

    def departure(self, summary: Mapping[str, Any], rates: Rates | None = None) -> str | None:
        """Returns the reason why a summary does not fit this cell; None if it fits.

        Args:
            summary: the summary from `evaluate`.
            rates: the costs of the baselines' learning rates, if known.
        """
        expected = _expected(self)
        allowed = TASKS[self.task].earlier
        for difference in scenario_differences(summary["resolved_scenario"], expected):
            if difference not in allowed:
                return difference
        if list(summary["seeds"]) != list(self.seeds):
            return f"its seeds are not {self.seeds[0]} to {self.seeds[-1]}"
        if isinstance(self.policy, str):
            # Runs that lack these fields did avoid failed picks, and always acted. Ignore the names
            # of weights, because weights are compared by their digest.
            earlier = {"avoid_failed_picks": True, "least_confidence": 0.0}
            policies = (summary["resolved_scenario"]["policy"], expected["policy"])
            found, wanted = (earlier | policy | {"weights": ""} for policy in policies)
            if found != wanted:
                return f"its policy is not {self.policy}"
            same = summary["policy_digest"] == _loaded(self).policy.digest(SCENARIOS / "paper")
            return None if same else "its weights are not those that come with the package"
        details = self._details(self.policy)
        # Runs that lack the field avoid_failed_picks did avoid failed picks. Accept these runs: the
        # page of results says how many actions this can have changed.
        lacking = {"angle_only": False, "avoid_failed_picks": self.avoid_failed_picks}
        found = lacking | {"rotations": None} | summary["policy_details"]
        key = rates_key(reference(self.policy))
        if rates and "learning_rate" not in details and key in rates:
            details["learning_rate"] = float(best_rate(rates[key]))
        for key, wanted in details.items():
            if found.get(key) != wanted:
                return f"{key} is {found.get(key)}, not {wanted}"
        return None

    def is_earlier(self, summary: Mapping[str, Any]) -> bool:
        """Whether a run of this cell used an earlier version of the cell's task."""
        return bool(scenario_differences(summary["resolved_scenario"], _expected(self)))

    def _details(self, training: Training) -> dict[str, Any]:
        learned_at = TASKS[training.task]
        wanted: dict[str, Any] = {
            "method": training.method,
            "scenario": f"{Path(learned_at.file).stem}:{learned_at.demonstrated}",
            "preset": training.preset,
            "rotations": training.rotations,
            "orientations": self.orientations,
            "trained_orientations": training.orientations,
            "demonstrations": training.demonstrations,
            "training_seed": training.seed,
            "steps": training.steps,
            "angle_only": training.angle_only,
            "decay": True,
            "continuous": self.continuous,
            "fit_outlines": self.fit_outlines,
            "recover": self.recover,
            "avoid_failed_picks": self.avoid_failed_picks,
        }
        if training.learning_rate is not None:
            wanted["learning_rate"] = training.learning_rate
        elif training.method == "so2":
            wanted["learning_rate"] = LEARNING_RATES[0]
        if learned_at.table != "I":
            # For tasks of table I, the task determines these two fields.
            wanted |= {"taken_only": training.taken_only, "rigid": training.rigid}
        return wanted


@cache
def _expected(cell: Cell) -> dict[str, Any]:
    return described(_loaded(cell))


def _loaded(cell: Cell) -> Scenario:
    task = TASKS[cell.task]
    return load_scenario(SCENARIOS / task.file, task.tested, cell.scenario_text(""))
