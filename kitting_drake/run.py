"""`python -m kitting_drake.run SCENARIO.yaml`: one episode, shown live; leaves a replay."""

import shutil
import subprocess
from pathlib import Path
from typing import TYPE_CHECKING

from pydrake.geometry import Meshcat, MeshcatParams
from pydrake.systems.framework import Context, Diagram
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

from kitting_drake.common.command_line import FAILED, INTERRUPTED, run_command, seed_type
from kitting_drake.common.errors import UserError
from kitting_drake.common.files import require_folder, write_atomically, write_json
from kitting_drake.common.rendering import render_picture, save_png
from kitting_drake.episode import ModeChange
from kitting_drake.episode.chosen import build_chosen, run_chosen
from kitting_drake.evaluation.terminal import print_episode
from kitting_drake.scenario.choosing import choose_scenario, output_folder, scenario_parser
from kitting_drake.station import Cell
from kitting_drake.station.hidden_table import hidden_table_note
from systems.pick_place_parameters import Mode
from systems.signals import Observation

if TYPE_CHECKING:
    from kitting_drake.policies.learned_policy import Decision

REPLAY = "replay.html"
"""The file of an episode's recording, in the folder of its files."""


def main() -> int:
    """Parses the command line and runs the episode; returns the exit code."""
    parser = scenario_parser("run", "Run an episode, watch it in Meshcat, keep a replay.")
    parser.add_argument("--seed", type=seed_type, help="of the scene (default: the scenario's)")
    parser.add_argument(
        "--no-meshcat", action="store_true", help="show nothing, and leave no replay.html"
    )
    parser.add_argument(
        "--graphviz",
        type=Path,
        metavar="FILE",
        help="also draw the Diagram: .svg, .png or .pdf, or .dot for its source",
    )
    parser.add_argument(
        "--picture", type=Path, metavar="FILE.png", help="also render the cell as the episode ends"
    )
    parser.add_argument(
        "--video", type=Path, metavar="FILE.gif", help="also film the episode (.gif or .webp)"
    )
    arguments = parser.parse_args()
    chosen = choose_scenario(arguments)
    scenario = chosen.scenario
    seed = scenario.random_seed if arguments.seed is None else arguments.seed
    console = Console(quiet=arguments.quiet)
    if note := hidden_table_note(chosen.scenario):
        console.print(f"note: {note}", highlight=False, markup=False)
    folder = require_folder(output_folder(arguments, chosen.name))
    _check_files(arguments.picture, arguments.video, folder / REPLAY)

    decisions: list[tuple[Observation, Decision]] = []
    meshcat = None if arguments.no_meshcat else _start_meshcat(console)
    cell = build_chosen(
        chosen,
        seed=seed,
        meshcat=meshcat,
        picture=arguments.picture is not None,
        video=arguments.video,
        observer=lambda observation, decision: decisions.append((observation, decision)),
    )
    if arguments.graphviz:
        draw_diagram(cell.diagram, arguments.graphviz)
    if meshcat is not None:
        meshcat.StartRecording(frames_per_second=32.0, set_visualizations_while_recording=True)

    with _EpisodeProgress(console, cell) as progress:
        result = run_chosen(
            chosen,
            cell,
            seed=seed,
            realtime_rate=scenario.target_realtime_rate,
            observers=[progress.observe],
        )
    write_json(folder / "results.json", result.as_dict())
    # What an earlier run left is not of this one.
    (folder / REPLAY).unlink(missing_ok=True)
    _save_decisions(folder / "decisions", decisions)
    if meshcat is not None:
        meshcat.StopRecording()
        meshcat.PublishRecording()
        write_atomically(folder / REPLAY, meshcat.StaticHtml())
    if arguments.picture and progress.last_context is not None:
        context = cell.scene_graph.GetMyMutableContextFromRoot(progress.last_context)
        save_png(render_picture(cell.scene_graph, context), arguments.picture)
    if cell.video_writer is not None:
        cell.video_writer.Save()
    print_episode(console, result)
    console.print(f"files: {folder}/", highlight=False, markup=False)
    if result.failure:
        return FAILED
    return INTERRUPTED if result.interrupted else 0


def _save_decisions(folder: Path, decisions: "list[tuple[Observation, Decision]]") -> None:
    """A picture for each decision of a learned policy; those of an earlier run go."""
    for path in folder.glob("decision_*.png"):
        path.unlink()
    if decisions:
        # Who draws nothing does not wait for matplotlib.
        from kitting_drake.evaluation.decision_figure import draw_decision

        for number, (observation, decision) in enumerate(decisions, start=1):
            picture = draw_decision(observation, decision)
            write_atomically(folder / f"decision_{number:02}.png", picture)


def _check_files(picture: Path | None, video: Path | None, replay: Path) -> None:
    """Raises UserError for a file that cannot be written after the episode."""
    if picture is not None and picture.suffix != ".png":
        raise UserError(f"--picture writes .png files, not '{picture}'")
    if video is not None and video.suffix not in (".gif", ".webp"):
        raise UserError(f"--video writes .gif and .webp files, not '{video}'")
    # Told before the episode, not after it.
    for path in (picture, video, replay):
        if path is not None and path.is_dir():
            raise UserError(f"{path} is a folder")
        if path is not None:
            require_folder(path.parent)


def _start_meshcat(console: Console) -> Meshcat:
    # Drake's default host is every interface.
    try:
        meshcat = Meshcat(MeshcatParams(host="localhost", show_stats_plot=False))
    except RuntimeError as error:
        raise UserError(
            "Meshcat finds no free port from 7000 to 7099: close viewers, or give --no-meshcat"
        ) from error
    meshcat.SetProperty("/Background", "top_color", [0.93, 0.95, 0.97])
    meshcat.SetProperty("/Background", "bottom_color", [0.80, 0.83, 0.86])
    meshcat.SetProperty("/Grid", "visible", False)
    meshcat.SetProperty("/Axes", "visible", False)
    meshcat.SetCameraPose(camera_in_world=[1.02, -0.48, 0.62], target_in_world=[0.45, -0.02, 0.08])
    console.print(f"watch at {meshcat.web_url()}", highlight=False)
    return meshcat


def draw_diagram(diagram: Diagram, path: Path) -> None:
    """Draws a Diagram with Graphviz.

    Raises:
        UserError: an ending other than .svg, .png, .pdf and .dot, or Graphviz is not there or
            cannot write it.
    """
    source = diagram.GetGraphvizString(max_depth=1)
    if path.suffix == ".dot":
        write_atomically(path, source)
        return
    if path.suffix not in (".svg", ".png", ".pdf"):
        raise UserError(f"--graphviz writes .svg, .png, .pdf and .dot files, not '{path}'")
    if shutil.which("dot") is None:
        raise UserError(
            "--graphviz needs the program dot: install it (Debian and Ubuntu: apt-get install "
            "graphviz), or write the source to a .dot file"
        )
    drawn = subprocess.run(
        ["dot", f"-T{path.suffix[1:]}"], input=source.encode(), capture_output=True
    )
    if drawn.returncode:
        reason = drawn.stderr.decode(errors="replace").strip().splitlines()[-1:]
        raise UserError(f"--graphviz: dot cannot write {path}: {' '.join(reason)}")
    write_atomically(path, drawn.stdout)


class _EpisodeProgress:
    """A progress bar of an episode, one step for each action: an `EpisodeObserver`."""

    def __init__(self, console: Console, cell: Cell) -> None:
        self._cell = cell
        self._progress = Progress(
            TextColumn("{task.description:9}"),
            BarColumn(),
            TextColumn("{task.fields[seconds]:.1f} s simulated"),
            TimeElapsedColumn(),
            console=console,
            transient=True,
            disable=not console.is_terminal,
        )
        self._task = self._progress.add_task("", total=len(cell.scene.goals), seconds=0.0)
        self.last_context: Context | None = None

    def __enter__(self) -> "_EpisodeProgress":
        self._progress.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._progress.stop()

    def observe(self, event: ModeChange) -> None:
        """Shows what the planner is doing now."""
        self.last_context = event.root_context
        planner = self._cell.planner
        counts = planner.GetOutputPort("counts").Eval(
            planner.GetMyContextFromRoot(event.root_context)
        )
        finished = counts[0] - (event.mode not in (Mode.OBSERVE, Mode.DONE))
        self._progress.update(
            self._task,
            completed=min(finished, len(self._cell.scene.goals)),
            description=event.mode.name.lower(),
            seconds=event.root_context.get_time(),
        )


if __name__ == "__main__":
    run_command(main)
