"""`python -m kitting_drake.collect SCENARIO.yaml`: collects demonstrations of the oracle."""

import argparse
import dataclasses
import re
import time
from pathlib import Path

from rich.console import Console

from kitting_drake.common.command_line import count_type, run_command, seed_type
from kitting_drake.common.errors import MachineError, UserError
from kitting_drake.common.files import (
    alone_in,
    claim_folder,
    files_digest,
    require_folder,
)
from kitting_drake.common.processes import (
    ProcessCrashed,
    Workers,
    counting_bar,
    side_by_side,
)
from kitting_drake.common.provenance import versions
from kitting_drake.common.rendering import require_rendering
from kitting_drake.common.seeds import DEMONSTRATION_SEEDS, seeds_from
from kitting_drake.episode.chosen import build_any_chosen, build_chosen, run_chosen
from kitting_drake.episode.collection import Collection
from kitting_drake.episode.demonstration_recorder import DemonstrationRecorder
from kitting_drake.episode.episode_log import add_log_flag, log_of_many, log_of_seed
from kitting_drake.episode.frame_recorder import FrameRecorder
from kitting_drake.episode.joint_view import chosen_cameras
from kitting_drake.policies.data.demonstrations import (
    Demonstration,
    Origin,
    Rejection,
    read_contents,
)
from kitting_drake.policies.data.frames import (
    DEFAULT_RATE,
    DEFAULT_WIDTH,
    RATES,
    EpisodeFrames,
    FrameSettings,
)
from kitting_drake.policies.data.lerobot_export import (
    export_lerobot,
    require_export,
    require_pyarrow,
)
from kitting_drake.scenario.choosing import (
    ChosenScenario,
    choose_scenario,
    output_folder,
    scenario_parser,
)
from kitting_drake.scenario.policies import Oracle
from kitting_drake.scenario.workers import add_workers_flags, open_workers
from kitting_drake.station.hidden_table import hidden_table_note


def main() -> int:
    """Parses the command line and collects; returns the exit code."""
    parser = scenario_parser("collect", "Collect demonstrations of the oracle.")
    parser.add_argument(
        "--demos", type=count_type, default=100, help="number of demonstrations (100)"
    )
    add_workers_flags(parser)
    parser.add_argument(
        "--seed",
        type=seed_type,
        default=DEMONSTRATION_SEEDS.start,
        help=f"seed of the first episode ({DEMONSTRATION_SEEDS.start})",
    )
    _add_export_flags(parser)
    add_log_flag(parser)
    arguments = parser.parse_args()
    log = log_of_many(arguments.log, arguments.ray)
    chosen = _by_oracle(choose_scenario(arguments))
    folder = require_folder(output_folder(arguments, f"{chosen.name}-demonstrations"))
    console = Console(quiet=arguments.quiet)
    if note := hidden_table_note(chosen.scenario):
        console.print(f"note: {note}", highlight=False, markup=False)
    start = time.perf_counter()
    with alone_in(folder):
        # Check before a folder is claimed, so that a failure leaves no folder behind.
        if not chosen.scenario.cameras:
            raise UserError(f"{chosen.path}: cameras is empty: collect needs at least one camera")
        require_rendering()
        build_any_chosen(chosen, seeds_from(arguments.seed))
        export = _Export.of(arguments, chosen, folder) if arguments.export else None
        identity = {
            **chosen.described,
            "versions": versions(),
            # After a tool is imported again, refuse to add to the demonstrations of the old tool.
            "task_digest": files_digest(chosen.scenario.task.input_files(chosen.base)),
        }
        claim_folder(folder, "scenario.json", identity, of="scenario, tools or version")
        if export:
            export.claim()
        collection = Collection(folder, _origin(chosen, arguments.seed))
        if collection.assembled >= arguments.demos:
            nothing = "nothing to collect" if export else "nothing to do"
            console.print(f"{nothing}: {collection.summary()}", highlight=False, soft_wrap=True)
        else:
            if export:
                require_export(export.folder)
            with open_workers(arguments, chosen) as (workers, sent):
                collection.collect(
                    arguments.demos,
                    lambda seed: _run(workers, sent, seed, log, export),
                    workers=workers,
                    console=console,
                )
            seconds = time.perf_counter() - start
            told = f"{collection.summary()}; {seconds:.0f} s"
            console.print(told, highlight=False, markup=False, soft_wrap=True)
        if export:
            with open_workers(arguments, chosen) as (workers, sent):
                export.write(collection.path, workers=workers, sent=sent, console=console)
    return 0


def _add_export_flags(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--export",
        choices=("lerobot",),
        help="also record frames, and write them as a LeRobotDataset v3.0 to the folder lerobot "
        "in --output",
    )
    parser.add_argument(
        "--fps",
        type=count_type,
        default=DEFAULT_RATE,
        help=f"frames per simulated second, {RATES[0]} to {RATES[-1]} (default: {DEFAULT_RATE})",
    )
    parser.add_argument(
        "--cameras",
        nargs="+",
        default=(),
        metavar="NAME",
        help="cameras whose images are exported (default: all)",
    )
    parser.add_argument(
        "--image_width",
        type=count_type,
        default=DEFAULT_WIDTH,
        metavar="PIXELS",
        help=f"largest width of the exported images in pixels (default: {DEFAULT_WIDTH})",
    )
    parser.add_argument(
        "--instruction",
        metavar="TEXT",
        help="the task in words, for policies that take text (default: the scenario's task)",
    )


@dataclasses.dataclass(frozen=True)
class _Export:
    """Exports the demonstrations' frames to `frames/`, and a LeRobot dataset made of them to
    `lerobot/`."""

    folder: Path
    frames: Path
    recording: FrameSettings
    instruction: str

    @staticmethod
    def of(arguments: argparse.Namespace, chosen: ChosenScenario, folder: Path) -> "_Export":
        """Makes the export that the flags ask for. Checks the flags before anything is written.

        Raises:
            UserError: a flag cannot be used, or pyarrow is not installed.
        """
        require_pyarrow()
        named = FrameSettings(arguments.fps, arguments.image_width, tuple(arguments.cameras))
        cameras = chosen_cameras(named, chosen.scenario.cameras)
        return _Export(
            folder=folder / "lerobot",
            frames=folder / "frames",
            recording=dataclasses.replace(named, cameras=cameras),
            instruction=arguments.instruction or _task_in_words(chosen),
        )

    def claim(self) -> None:
        """Marks the folder `frames/` as belonging to this export.

        Raises:
            UserError: the folder holds other files, or frames of other cameras, width or rate.
        """
        described = dataclasses.asdict(self.recording)
        claim_folder(require_folder(self.frames), "recording.json", described, of="recording")

    def file(self, seed: int) -> Path:
        """The file with the frames of an episode."""
        return self.frames / f"seed_{seed:08d}.npz"

    def write(
        self, demonstrations: Path, *, workers: Workers, sent: ChosenScenario, console: Console
    ) -> None:
        """Writes the dataset; repeats the demonstrations whose frames are missing.

        Raises:
            UserError: the dataset cannot be written, or an episode cannot be repeated.
        """
        contents = read_contents(demonstrations)
        missing = [seed for seed in contents.seeds if not self.file(seed).exists()]
        queue = iter(missing)
        with counting_bar(console, "recorded again") as progress:
            task = progress.add_task("", total=len(missing))
            for outcome in side_by_side(
                lambda seed: (seed, _run(workers, sent, seed, None, self)),
                lambda: next(queue, None),
                workers=workers,
            ):
                seed, found = outcome
                if not isinstance(found, Demonstration):
                    raise UserError(
                        f"the frames of seed {seed} are missing, and its demonstration could not "
                        "be repeated: give another --output"
                    )
                progress.advance(task)
        origin = contents.origin
        with counting_bar(console, "exported") as progress:
            export_lerobot(
                [self.file(seed) for seed in contents.seeds],
                self.folder,
                self.instruction,
                robot=origin.scenario.get("robot", {}).get("_tag", "").lstrip("!") or None,
                about={"episode_seeds": contents.seeds, **dataclasses.asdict(origin)},
                track=progress.track,
            )
        console.print(
            f"as a LeRobotDataset: {self.folder}/", highlight=False, markup=False, soft_wrap=True
        )


def _by_oracle(chosen: ChosenScenario) -> ChosenScenario:
    scenario = dataclasses.replace(chosen.scenario, policy=Oracle())
    return dataclasses.replace(chosen, scenario=scenario)


def _origin(chosen: ChosenScenario, first_seed: int) -> Origin:
    return Origin(
        scenario_name=chosen.name,
        scenario=chosen.described,
        grid=chosen.scenario.heightmap.grid(),
        learning=chosen.scenario.task.learning,
        first_seed=first_seed,
        versions=versions(),
    )


def _task_in_words(chosen: ChosenScenario) -> str:
    """Returns the task's name in words: `stack block pyramid` for `!StackBlockPyramid`."""
    name = type(chosen.scenario.task).__name__
    return re.sub(r"(?<=[a-z])(?=[A-Z])", " ", name).lower()


def _run(
    workers: Workers, chosen: ChosenScenario, seed: int, log: Path | None, export: _Export | None
) -> Demonstration | Rejection | ProcessCrashed:
    """Makes the demonstration of a seed in a worker. Saves its frames if they are exported."""
    recording = None if export is None else export.recording
    outcome = workers.run(_demonstrate, chosen, seed, log, recording)
    if isinstance(outcome, ProcessCrashed):
        return outcome
    found, frames = outcome
    if export is not None and frames is not None and isinstance(found, Demonstration):
        frames.save(export.file(seed))
    return found


def _demonstrate(
    chosen: ChosenScenario, seed: int, log: Path | None, recording: FrameSettings | None
) -> tuple[Demonstration | Rejection, EpisodeFrames | None]:
    # Fail if this process cannot render: the station would have no cameras.
    require_rendering()
    try:
        diagram, station = build_chosen(chosen, seed=seed)
    except MachineError:
        raise
    except UserError as error:
        return Rejection(seed, 0.0, str(error)), None
    learning = chosen.scenario.task.learning
    recorder = DemonstrationRecorder(station, later_picks_possible=learning.later_picks_possible)
    sampler = None if recording is None else FrameRecorder(station, recording)
    file = None if log is None else log_of_seed(log, seed)
    result = run_chosen(
        chosen, diagram, station, observers=[recorder.observe], log=file, sampler=sampler
    )
    found = recorder.demonstration(result)
    return found, None if sampler is None else sampler.frames()


if __name__ == "__main__":
    run_command(main)
