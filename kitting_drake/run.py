"""`python -m kitting_drake.run SCENARIO.yaml`: runs an episode, shows it in Meshcat, saves a
replay."""

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from pydrake.geometry import Meshcat
from pydrake.systems.framework import DiagramBuilder
from rich.console import Console

from kitting_drake.common.command_line import FAILED, INTERRUPTED, run_command, seed_type
from kitting_drake.common.errors import UserError
from kitting_drake.common.files import require_folder, write_atomically, write_json
from kitting_drake.common.provenance import commit
from kitting_drake.common.rendering import add_picture_renderer, render_picture, save_png
from kitting_drake.episode.chosen import run_chosen
from kitting_drake.episode.episode_log import add_log_flag, check_log
from kitting_drake.evaluation.episode_progress import EpisodeProgress
from kitting_drake.evaluation.terminal import print_episode
from kitting_drake.scenario.choosing import choose_scenario, output_folder, scenario_parser
from kitting_drake.station import build_station, connect_policy, make_policy
from kitting_drake.station.hidden_table import hidden_table_note
from kitting_drake.station.visualization import add_meshcat, add_video, draw_diagram, start_meshcat
from systems.signals import Observation

if TYPE_CHECKING:
    from kitting_drake.policies.learned_policy import Decision

REPLAY = "replay.html"
"""The name of the file with the recording."""


def main() -> int:
    """Parses the command line and runs the episode; returns the exit code."""
    arguments = _parser().parse_args()
    chosen = choose_scenario(arguments)
    scenario = chosen.scenario
    seed = scenario.random_seed if arguments.seed is None else arguments.seed
    console = Console(quiet=arguments.quiet)
    folder = require_folder(output_folder(arguments, chosen.name))
    _check_files(arguments.picture, arguments.video, folder / REPLAY)
    if arguments.log is not None:
        check_log(arguments.log)
    if note := hidden_table_note(chosen.scenario):
        console.print(f"note: {note}", highlight=False, markup=False)

    decisions: list[tuple[Observation, Decision]] = []
    meshcat = None if arguments.no_meshcat else start_meshcat(scenario.meshcat)
    if meshcat is not None:
        console.print(f"watch at {meshcat.web_url()}", highlight=False)
    builder = DiagramBuilder()
    with chosen.named_in_errors():
        station = builder.AddNamedSystem("station", build_station(scenario, seed, chosen.base))
        policy = builder.AddNamedSystem(
            "policy", make_policy(station, lambda *decided: decisions.append(decided))
        )
        connect_policy(builder, station, policy)
    if meshcat is not None:
        add_meshcat(builder, station, meshcat)
    if arguments.picture:
        add_picture_renderer(station.scene_graph)
    video = add_video(builder, station, arguments.video) if arguments.video else None
    diagram = builder.Build()
    diagram.set_name("kitting")
    if arguments.graphviz:
        draw_diagram(diagram, arguments.graphviz)
    if meshcat is not None:
        meshcat.StartRecording(frames_per_second=32.0, set_visualizations_while_recording=True)

    with EpisodeProgress(console, station) as progress:
        result = run_chosen(
            chosen,
            diagram,
            station,
            realtime_rate=scenario.target_realtime_rate,
            observers=[progress.observe],
            log=arguments.log,
        )
    told = {
        "policy_digest": scenario.policy.digest(chosen.base),
        "policy_details": scenario.policy.details(chosen.base),
        "commit": commit(),
    }
    write_json(folder / "results.json", result.as_dict() | told)
    _save_replay(folder / REPLAY, meshcat)
    _save_decisions(folder / "decisions", decisions)
    if arguments.picture and progress.last_context is not None:
        context = station.scene_graph.GetMyMutableContextFromRoot(progress.last_context)
        save_png(
            render_picture(station.scene_graph, context, station.X_WOverview), arguments.picture
        )
    if video is not None:
        video.Save()
    print_episode(console, result)
    named = (arguments.log, arguments.picture, arguments.video, arguments.graphviz)
    elsewhere = [str(path) for path in named if path is not None and folder not in path.parents]
    files = ", ".join([f"{folder}/", *elsewhere])
    console.print(f"files: {files}", highlight=False, markup=False, soft_wrap=True)
    if result.failure:
        return FAILED
    return INTERRUPTED if result.interrupted else 0


def _parser() -> argparse.ArgumentParser:
    parser = scenario_parser("run", "Run an episode, show it in Meshcat, save a replay.")
    parser.add_argument(
        "--seed", type=seed_type, help="seed of the scene (default: the scenario's)"
    )
    parser.add_argument(
        "--no-meshcat", action="store_true", help="no visualization and no replay.html"
    )
    parser.add_argument(
        "--graphviz",
        type=Path,
        metavar="FILE",
        help="also draw the Diagram (.svg, .png, .pdf, or .dot for its source)",
    )
    parser.add_argument(
        "--picture",
        type=Path,
        metavar="FILE.png",
        help="also render the station at the end of the episode (.png)",
    )
    add_log_flag(parser)
    parser.add_argument(
        "--video", type=Path, metavar="FILE.gif", help="also record a video (.gif or .webp)"
    )
    return parser


def _save_replay(path: Path, meshcat: Meshcat | None) -> None:
    """Saves the recording. If there is none, removes the file of an earlier run."""
    path.unlink(missing_ok=True)
    if meshcat is not None:
        meshcat.StopRecording()
        meshcat.PublishRecording()
        write_atomically(path, meshcat.StaticHtml())


def _save_decisions(folder: Path, decisions: "list[tuple[Observation, Decision]]") -> None:
    """Saves a picture of each decision of a learned policy; removes the pictures of earlier
    runs."""
    for path in folder.glob("decision_*.png"):
        path.unlink()
    if decisions:
        # Import matplotlib lazily.
        from kitting_drake.evaluation.decision_figure import draw_decision

        for number, (observation, decision) in enumerate(decisions, start=1):
            picture = draw_decision(observation, decision)
            write_atomically(folder / f"decision_{number:02}.png", picture)


def _check_files(picture: Path | None, video: Path | None, replay: Path) -> None:
    """Checks that the episode's files can be written; raises UserError if not."""
    if picture is not None and picture.suffix != ".png":
        raise UserError(f"--picture writes .png files, not '{picture}'")
    if video is not None and video.suffix not in (".gif", ".webp"):
        raise UserError(f"--video writes .gif and .webp files, not '{video}'")
    for path in (picture, video, replay):
        if path is not None and path.is_dir():
            raise UserError(f"{path} is a folder: name a file")
        if path is not None:
            require_folder(path.parent)


if __name__ == "__main__":
    run_command(main)
