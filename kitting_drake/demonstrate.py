"""`python -m kitting_drake.demonstrate FOLDER --camera CALIBRATION.yaml`: a bench's own
demonstrations.

A folder of frames and actions becomes a file that `train` takes; `--click` serves a page on which a
person tells the actions. No Drake. See docs/bench.md.
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
        f"{path} holds {found.demonstrations} demonstrations of {found.steps} steps in all; "
        f"{found.finals} of them show in the end that nothing is left to do",
        highlight=False,
        markup=False,
        soft_wrap=True,
    )
    return 0


def _annotate(folder: Path, calibration: Calibration, port: int) -> None:
    steps = [step for steps in find_demonstrations(folder) for step in steps]
    with AnnotationServer(steps, calibration, port) as server:
        # Without the address nobody finds the page: it is told even where all else is quiet.
        print(f"annotate at {server.url}; Ctrl-C ends, and what was saved is kept", flush=True)
        server.serve_forever()


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m kitting_drake.demonstrate",
        description="Make demonstrations for `train` of a real bench's frames and actions.",
    )
    parser.add_argument(
        "folder",
        type=Path,
        metavar="FOLDER",
        help="holds a folder for each demonstration, and that a folder for each step: its frames, "
        "and action.json",
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
        help="where demonstrations.h5 goes, or a FILE.h5 (output/FOLDER-demonstrations)",
    )
    parser.add_argument(
        "--click", action="store_true", help="serve a page on which to click the actions"
    )
    parser.add_argument(
        "--port", type=_port_type, default=0, metavar="N", help="of the page (any that is free)"
    )
    parser.add_argument(
        "--no_later_picks",
        action="store_true",
        help="what was picked later could not have been picked at once: for stacking",
    )
    parser.add_argument(
        "--no_curvature",
        action="store_true",
        help="objects come in one shape only: do not bend them to learn more",
    )
    parser.add_argument(
        "--no_reflection", action="store_true", help="mirror images of objects never occur"
    )
    parser.add_argument(
        "--table_height", type=float, metavar="Z", help="in the base frame, in m (the file's, or 0)"
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
