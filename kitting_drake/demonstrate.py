"""`python -m kitting_drake.demonstrate FOLDER --camera CALIBRATION.yaml`: real demonstrations.

Converts a folder of frames and actions to a file for `train`, without Drake. With `--click`, it
serves a page on which a person enters the actions. See docs/bench.md.
"""

import argparse
from pathlib import Path

from rich.console import Console

from kitting_drake.common.command_line import run_command
from kitting_drake.common.files import require_folder
from kitting_drake.policies.data.learning import Learning
from kitting_drake.real_camera.annotation_page import AnnotationServer
from kitting_drake.real_camera.calibrations.calibration import Calibration, read_calibration
from kitting_drake.real_camera.outside_demonstrations import (
    check_replaceable,
    convert,
    find_demonstrations,
)


def main() -> int:
    """Parses the command line, and converts or annotates; returns the exit code."""
    arguments = _parser().parse_args()
    console = Console(quiet=arguments.quiet)
    calibration = read_calibration(arguments.camera, table_height=arguments.table_height)
    if arguments.click:
        _annotate(arguments.folder, calibration, arguments.port)
        return 0
    path = arguments.output or Path("output") / f"{arguments.folder.resolve().name}-demonstrations"
    if path.suffix != ".h5":
        path = path / "demonstrations.h5"
    check_replaceable(path, arguments.folder)
    require_folder(path.parent)
    learning = Learning(
        later_picks_possible=not arguments.no_later_picks,
        curvature=not arguments.no_curvature,
        reflection=not arguments.no_reflection,
    )
    with console.status("projecting frames"):
        found = convert(arguments.folder, calibration, learning, path)
    console.print(
        f"{path} holds {found.demonstrations} demonstrations with {found.steps} steps in all; "
        f"{found.finals} of them end with a frame of the finished task",
        highlight=False,
        markup=False,
        soft_wrap=True,
    )
    return 0


def _annotate(folder: Path, calibration: Calibration, port: int) -> None:
    steps = [step for steps in find_demonstrations(folder) for step in steps]
    with AnnotationServer(steps, calibration, port) as server:
        # Print the address even with --quiet, because the user must open it.
        print(
            f"annotate at {server.url}; Ctrl-C ends the server, and keeps the saved actions",
            flush=True,
        )
        server.serve_forever()


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m kitting_drake.demonstrate",
        description="Convert frames and actions of a real bench to demonstrations for `train`.",
    )
    parser.add_argument(
        "folder",
        type=Path,
        metavar="FOLDER",
        help="folder of the demonstrations; FOLDER/DEMONSTRATION/STEP/ holds the frame and the "
        "action.json of a step",
    )
    parser.add_argument(
        "--camera",
        type=Path,
        required=True,
        metavar="CALIBRATION.yaml",
        help="intrinsics and poses of the cameras",
    )
    parser.add_argument(
        "--output",
        type=Path,
        metavar="DIR",
        help="folder for demonstrations.h5, or a FILE.h5 (output/FOLDER-demonstrations)",
    )
    parser.add_argument(
        "--click", action="store_true", help="serve a page for entering the actions"
    )
    parser.add_argument(
        "--port",
        type=_port_type,
        default=0,
        metavar="N",
        help="port of the page (default: any free one)",
    )
    parser.add_argument(
        "--no_later_picks",
        action="store_true",
        help="the order of the picks matters, as in stacking: learn each step only from its own "
        "pick, not from later ones",
    )
    parser.add_argument(
        "--no_curvature",
        action="store_true",
        help="do not bend objects for augmentation: their shapes are fixed",
    )
    parser.add_argument(
        "--no_reflection", action="store_true", help="do not mirror images for augmentation"
    )
    parser.add_argument(
        "--table_height",
        type=float,
        metavar="Z",
        help="height of the table in the base frame, in m (default: the calibration's, or 0)",
    )
    parser.add_argument("--quiet", action="store_true", help="print nothing but errors")
    return parser


def _port_type(text: str) -> int:
    try:
        port = int(text)
    except ValueError:
        port = -1
    if not 0 <= port < 2**16:
        raise argparse.ArgumentTypeError(f"'{text}' is not a whole number from 0 to {2**16 - 1}")
    return port


if __name__ == "__main__":
    run_command(main)
