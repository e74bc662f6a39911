"""`python -m kitting_drake.decide FRAME... --camera CALIBRATION.yaml`: decides on one action.

Computes a pick and a place in the robot's base frame from the images of real cameras, without
Drake. See docs/bench.md.
"""

import argparse
import dataclasses
import json
import math
import time
from pathlib import Path

from rich.console import Console

from kitting_drake.common.command_line import count_type, run_command
from kitting_drake.common.errors import MachineError, UserError
from kitting_drake.common.files import require_folder, write_atomically, write_json
from kitting_drake.real_camera import (
    BenchPolicy,
    BenchRobot,
    Calibration,
    ShapeMatching,
    decide,
    load_policy,
    read_calibration,
    read_frames,
    read_robot,
    save_trajectory,
)
from kitting_drake.real_camera.checking.check import check_cameras
from kitting_drake.real_camera.checking.kit_block import Block
from kitting_drake.real_camera.checking.report import (
    CHECK_FILES,
    FOUND_FILES,
    print_check,
    print_decision,
    print_found,
    save_check,
    save_found,
)
from kitting_drake.real_camera.checking.table_finding import find_table
from kitting_drake.real_camera.checking.views import check_frames, observe
from kitting_drake.real_camera.markers.board_calibration import calibrate_cameras
from kitting_drake.real_camera.markers.board_report import (
    clear_earlier,
    print_calibrated,
    save_calibrated,
)
from kitting_drake.real_camera.markers.boards import read_board
from kitting_drake.real_camera.robots.bench_robot import check_rate
from kitting_drake.real_camera.robots.trajectory_files import TRAJECTORY_FILES
from systems.signals import PixelGrid


def main() -> int:
    """Parses the command line, and decides or checks; returns the exit code."""
    arguments = _parser().parse_args()
    console = Console(quiet=arguments.quiet)
    _check_robot_flags(arguments)
    folder = require_folder(arguments.output)
    if arguments.calibrate is not None:
        _calibrate(arguments, folder, console)
        return 0
    if arguments.find:
        _find(arguments, folder, console)
        return 0
    action, picture = folder / "action.json", folder / "decision.png"
    # Remove stale files, so that nobody uses the action of an earlier frame after a failure.
    names = CHECK_FILES if arguments.check else (action.name, picture.name, *TRAJECTORY_FILES)
    if not arguments.check:
        _check_decided(action)
    for name in names:
        _remove(folder / name, arguments.camera)
    robot = _robot(arguments)
    calibration = read_calibration(arguments.camera, table_height=arguments.table_height)
    block = _block(arguments, calibration.grid)
    frames = read_frames(arguments.frames, calibration, time=arguments.time)
    if arguments.check:
        checked = check_cameras(frames, calibration, block)
        save_check(folder, checked)
        print_check(console, checked)
        console.print(f"files: {folder}/", highlight=False, markup=False)
        return 0

    policy = _policy(arguments)
    begun = time.perf_counter()
    decision = decide(frames, calibration, policy, robot=robot)
    seconds = time.perf_counter() - begun
    record = {
        "units": "metres and radians, in the base frame; docs/bench.md",
        "policy": policy.name,
        "seconds": round(seconds, 3),
        **decision.as_dict(),
    }
    if robot is not None and decision.trajectory is not None:
        save_trajectory(folder, decision.trajectory, robot.joint_names, robot.as_dict())
        record["trajectory"] = TRAJECTORY_FILES[0]
    write_atomically(picture, decision.draw())
    write_json(action, record)
    if decision.result == "calibration":
        raise UserError(decision.reason)
    print_decision(console, record)
    console.print(f"files: {folder}/", highlight=False, markup=False)
    return 0


def _check_robot_flags(arguments: argparse.Namespace) -> None:
    """Raises UserError if `--robot` or `--rate` contradicts other flags."""
    if arguments.robot is None:
        if arguments.rate is not None:
            raise UserError("--rate needs --robot")
        return
    for flag, given in (
        ("--check", arguments.check),
        ("--find", arguments.find),
        ("--calibrate", arguments.calibrate is not None),
    ):
        if given:
            raise UserError(f"--robot cannot be combined with {flag}")


def _robot(arguments: argparse.Namespace) -> BenchRobot | None:
    if arguments.robot is None:
        return None
    robot = read_robot(arguments.robot)
    if arguments.rate is None:
        return robot
    return dataclasses.replace(robot, rate=check_rate(arguments.rate, "--rate"))


def _calibrate(arguments: argparse.Namespace, folder: Path, console: Console) -> None:
    for flag, given in (
        ("--check", arguments.check),
        ("--find", arguments.find),
        ("--time", arguments.time is not None),
    ):
        if given:
            raise UserError(f"{flag} cannot be combined with --calibrate")
    path = clear_earlier(folder, arguments.camera)
    board = read_board(arguments.calibrate)
    lenses = read_calibration(arguments.camera, table_height=arguments.table_height, poses=False)
    calibrated = calibrate_cameras(board, arguments.frames, lenses)
    save_calibrated(path, calibrated)
    print_calibrated(console, calibrated)
    console.print(f"calibration: {path}", highlight=False, markup=False)


def _find(arguments: argparse.Namespace, folder: Path, console: Console) -> None:
    for flag, given in (
        ("--check", arguments.check),
        ("--kit_size_mm", arguments.kit_size_mm is not None),
        ("--table_height", arguments.table_height is not None),
    ):
        if given:
            raise UserError(f"{flag} cannot be combined with --find")
    for name in FOUND_FILES:
        _remove(folder / name, arguments.camera)
    calibration = read_calibration(arguments.camera)
    frames = read_frames(arguments.frames, calibration, time=arguments.time)
    found = find_table(frames, calibration)
    around = Calibration(found.calibration.cameras, found.around)
    save_found(folder, found, observe(check_frames(frames, around), around))
    print_found(console, found)
    console.print(f"files: {folder}/", highlight=False, markup=False)


def _check_decided(action: Path) -> None:
    """Raises UserError if `action.json` exists, but was not written by this command. Such a file
    may hold a person's action for a demonstration."""
    try:
        record = json.loads(action.read_text())
    except FileNotFoundError:
        return
    except (OSError, ValueError):
        record = None
    if not isinstance(record, dict) or not {"policy", "seconds"} <= set(record):
        raise UserError(f"{action} was not written by decide: give another --output")


def _remove(path: Path, camera: Path) -> None:
    """Removes a file of an earlier run, unless it is the given calibration."""
    try:
        if path.resolve() != camera.resolve():
            path.unlink(missing_ok=True)
    except OSError as error:
        raise MachineError(f"cannot remove {path}: {error.strerror}") from error


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m kitting_drake.decide",
        description="Decide one pick and place from a real camera's frames, or check the cameras.",
    )
    parser.add_argument(
        "frames",
        type=Path,
        nargs="+",
        metavar="FRAME",
        help="a folder of frames, or a colour image and a depth image for each camera",
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
        default=Path("output/decide"),
        metavar="DIR",
        help="folder for the files",
    )
    _add_policy_flags(parser)
    _add_camera_flags(parser)
    parser.add_argument(
        "--time",
        type=float,
        metavar="S",
        help="for a recording: the time of the frame since the start, in s",
    )
    parser.add_argument(
        "--robot",
        type=Path,
        metavar="ROBOT.yaml",
        help="also plan the joint trajectory of a Franka arm, and refuse actions that it cannot "
        "reach",
    )
    parser.add_argument(
        "--rate", type=int, metavar="HZ", help="points of the trajectory per second (1000)"
    )
    parser.add_argument("--quiet", action="store_true", help="print nothing but errors")
    return parser


def _add_policy_flags(parser: argparse.ArgumentParser) -> None:
    policy = parser.add_mutually_exclusive_group()
    policy.add_argument(
        "--weights",
        type=Path,
        metavar="FILE",
        help="weights of the networks (default: the generalist)",
    )
    policy.add_argument(
        "--shape_matching", action="store_true", help="match outlines instead of using networks"
    )
    parser.add_argument(
        "--orientations",
        type=count_type,
        metavar="N",
        help="number of orientations of the networks (180)",
    )
    parser.add_argument(
        "--no_outlines",
        action="store_true",
        help="with networks: do not refine actions by outlines (for tasks without cavities)",
    )
    parser.add_argument(
        "--least_confidence",
        type=_share,
        metavar="P",
        help="act only if the probability of success is at least this (default: that "
        "of confidence.json, 0.9)",
    )
    parser.add_argument("--recover", action="store_true", help="recover from failed insertions")


def _add_camera_flags(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--table_height",
        type=float,
        metavar="Z",
        help="height of the table in the base frame, in m (default: the calibration's, or 0)",
    )
    parser.add_argument(
        "--check", action="store_true", help="check the calibration with frames of the empty table"
    )
    parser.add_argument(
        "--find",
        action="store_true",
        help="propose the table's height, the workspace and the region from one frame of each "
        "camera",
    )
    parser.add_argument(
        "--kit_size_mm",
        type=float,
        nargs=3,
        metavar=("L", "W", "H"),
        help="with --check: the size of a block that lies on the table, in mm",
    )
    parser.add_argument(
        "--kit_pose",
        type=float,
        nargs=3,
        metavar=("X", "Y", "YAW"),
        help="with --kit_size_mm: the block's middle in the base frame, in m, and its yaw, in rad",
    )
    parser.add_argument(
        "--calibrate",
        type=Path,
        metavar="BOARD.yaml",
        help="find the cameras' poses from a board of markers on the table; --camera may lack "
        "poses",
    )


def _policy(arguments: argparse.Namespace) -> BenchPolicy:
    if arguments.shape_matching:
        for flag, given in (
            ("--orientations", arguments.orientations is not None),
            ("--no_outlines", arguments.no_outlines),
        ):
            if given:
                raise UserError(
                    f"{flag} cannot be combined with --shape_matching: {flag} is only for networks"
                )
        return ShapeMatching(recover=arguments.recover, least_confidence=arguments.least_confidence)
    return load_policy(
        arguments.weights,
        orientations=arguments.orientations or 180,
        fit_outlines=not arguments.no_outlines,
        recover=arguments.recover,
        least_confidence=arguments.least_confidence,
    )


def _share(text: str) -> float:
    """Parses a number from 0 to 1, for argparse."""
    try:
        value = float(text)
    except ValueError:
        value = -1.0
    if not 0 <= value <= 1:
        raise argparse.ArgumentTypeError(f"'{text}' is not a probability from 0 to 1")
    return value


def _block(arguments: argparse.Namespace, grid: PixelGrid) -> Block | None:
    if arguments.kit_size_mm is None:
        if arguments.kit_pose is not None:
            raise UserError("--kit_pose needs --kit_size_mm")
        return None
    if not arguments.check:
        raise UserError("--kit_size_mm needs --check")
    if not all(0 < side < 1000 for side in arguments.kit_size_mm):
        given = " ".join(f"{side:g}" for side in arguments.kit_size_mm)
        raise UserError(
            f"--kit_size_mm takes length, width and height between 0 and 1000 mm, not {given}"
        )
    length, width, height = (side / 1e3 for side in arguments.kit_size_mm)
    pose = None if arguments.kit_pose is None else tuple(arguments.kit_pose)
    if pose is not None and not all(map(math.isfinite, pose)):
        raise UserError("--kit_pose takes three finite numbers: x and y in m, and yaw in rad")
    if pose is not None and not grid.contains(pose[:2]):
        raise UserError(
            f"--kit_pose: ({pose[0]:g}, {pose[1]:g}) m is outside the workspace: give x and y of "
            "the kit block's middle in m"
        )
    if pose is not None and abs(pose[2]) > math.tau:
        raise UserError(f"--kit_pose: the yaw {pose[2]:g} is more than a full turn: give it in rad")
    return Block((length, width, height), pose)


if __name__ == "__main__":
    run_command(main)
