"""The command line of `hkd kit`, and its conversion to a kit's parameters."""

import argparse
import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from kitting_drake.common.command_line import count_type
from kitting_drake.common.errors import UserError
from kitting_drake.hkd.fabrication.foam_sheet import MOST_KITS
from kitting_drake.hkd.fabrication.outside import PITCH, grid_side
from kitting_drake.hkd.kits.layout import layout_kit
from kitting_drake.hkd.kits.parameters import KitParameters
from kitting_drake.hkd.tools.tool import Tool

FITS = {"snug": 0.15, "easy": 0.35, "loose": 0.75}
"""The named clearances between a tool and its cavity's wall, on each side, in mm."""

_WIDEST_MM = 10.0
"""The largest clearance that can be given, in mm."""
_LONGEST_MM = 1000.0
"""The largest length or width that can be given for a block, in mm."""


@dataclass(frozen=True)
class SheetRequest:
    """A foam sheet or a drawer to fill with kits. Lengths in mm."""

    size_mm: tuple[float, float]
    margin_mm: float = 10.0
    gap_mm: float = 5.0
    copies: int | None = None
    """The number of copies of each kit. None: as many as fit."""
    others: tuple[Path, ...] = ()
    """Folders of other kits that are placed on the same sheet."""


@dataclass(frozen=True)
class KitRequest:
    """A kit to make; lengths in mm."""

    tools: tuple[str, ...]
    """Names of tools, or paths of tool folders."""
    output: Path
    clearance_mm: float | None = None
    """The clearance between a tool and its cavity's wall. None: the default, 2 mm."""
    compensate_mm: float = 0.0
    """How much too narrow the printer or router makes cavities, on each side.

    The cavities in the files to print and cut are wider by this amount. The cavities of the
    simulated kit are not.
    """
    lead_in_mm: float | None = None
    """The width of the bevel around the cavities' rims. None: the default, 1 mm."""
    fit_of: tuple[tuple[str, float], ...] = ()
    """Pairs of a tool's name or path, and this tool's clearance, which replaces `clearance_mm`."""
    stand_out_mm: float = 0.0
    """The height of the tools' tops above the block's top."""
    wall_mm: float | None = None
    """The least thickness of the walls between and around the cavities. None: the default, 6 mm."""
    block_mm: tuple[float, float, float] | None = None
    """The block's length, width and height.

    None: the smallest length and width that are found, and a height of 50 mm.
    """
    notches: bool = False
    labels: bool = False
    two_colours: bool = False
    """Whether the engraved labels are filled with letters of a second colour."""
    chamfer_mm: float = 0.0
    """The width of the bevel along the block's outer edges."""
    gridfinity: bool = False
    """Whether the block gets sides and feet for Gridfinity's grid."""
    nozzle_mm: float = 0.4
    """The width of the printer's nozzle. Walls that are thinner are reported."""
    bed_mm: tuple[float, float] | None = None
    """The sides of the printer's bed. None: the block is not split.

    A block that is larger than the bed is split into pieces that fit the bed.
    """
    joint_play_mm: float = 0.1
    """The gap between a dovetail and its socket, on each side."""
    sheet: SheetRequest | None = None
    robot: str = ""
    """YAML lines that set the robot in the kit's scenario; empty: the default robot."""


def check_request(request: KitRequest) -> None:
    """Raises UserError if a length is out of range."""
    for flag, value, low, high in (
        ("--clearance_mm", request.clearance_mm, 0.0, _WIDEST_MM),
        ("--wall_mm", request.wall_mm, 2.0, 50.0),
        ("--lead_in_mm", request.lead_in_mm, 0.0, 5.0),
        ("--compensate_mm", request.compensate_mm, -1.0, 1.0),
        ("--stand_out_mm", request.stand_out_mm, 0.0, 100.0),
        ("--chamfer_mm", request.chamfer_mm, 0.0, 3.0),
        ("--nozzle_mm", request.nozzle_mm, 0.1, 2.0),
        ("--joint_play_mm", request.joint_play_mm, 0.0, 1.0),
        *(("--bed", side, 50.0, 2000.0) for side in request.bed_mm or ()),
        *_sheet_limits(request.sheet),
    ):
        if value is not None and not low <= value <= high:
            raise UserError(f"{flag} {value:g} is out of range: give {low:g} to {high:g}")
    if request.block_mm is not None:
        limits = ((40.0, _LONGEST_MM), (40.0, _LONGEST_MM), (10.0, 200.0))
        for value, name, (low, high) in zip(
            request.block_mm, ("length", "width", "height"), limits, strict=True
        ):
            if not low <= value <= high:
                raise UserError(
                    f"--block_mm: a {name} of {value:g} is out of range: give {low:g} to {high:g}"
                )
    most = (request.wall_mm or 1e3 * KitParameters().nested_wall) / 2
    if request.chamfer_mm > most:
        raise UserError(
            f"--chamfer_mm {request.chamfer_mm:g} is more than half of the wall's thickness: give "
            f"at most {most:g}"
        )


def kit_parameters(request: KitRequest, loaded: Mapping[str, Tool]) -> KitParameters:
    """Returns the parameters of a requested kit.

    Args:
        request: the request.
        loaded: the request's tools, by the names in the request.

    Raises:
        UserError: `fit_of` is invalid, or the block's sides are not on Gridfinity's grid, or the
            tools do not fit on any block.
    """
    parameters = _lengths(request)
    parameters.clearance_of = _clearance_of(request, loaded)
    if request.gridfinity:
        return _on_grid([loaded[name] for name in request.tools], parameters)
    return parameters


def _lengths(request: KitRequest) -> KitParameters:
    """Returns the parameters of a requested kit, except `clearance_of`."""
    parameters = KitParameters(always_nested=True)
    if request.clearance_mm is not None:
        parameters.clearance = round(1e-3 * request.clearance_mm, 7)
    given = [
        value
        for value in (request.clearance_mm, *dict(request.fit_of).values())
        if value is not None
    ]
    if given:
        # Keep the outline's simplification small compared to the clearance.
        finest = max(1e-3 * min(given) / 20, 1e-6)
        parameters.tolerance = min(parameters.tolerance, finest)
    parameters.stand_out = round(1e-3 * request.stand_out_mm, 7)
    if request.lead_in_mm is not None:
        parameters.lead_in = round(1e-3 * request.lead_in_mm, 7)
    if request.wall_mm is not None:
        parameters.nested_wall = round(1e-3 * request.wall_mm, 7)
    if request.block_mm is not None:
        parameters.length, parameters.width, parameters.height = (
            round(1e-3 * value, 7) for value in request.block_mm
        )
        parameters.fixed_size = True
    return parameters


def _clearance_of(request: KitRequest, loaded: Mapping[str, Tool]) -> dict[str, float]:
    """Returns the clearances of tools that have their own, in metres, by the tools' names.

    These are the tools in `fit_of`, and those whose outline is uncertain.

    Raises:
        UserError: the kit has no such tool, or a clearance is out of range.
    """
    clearances = {}
    for name, value in request.fit_of:
        tool = loaded.get(name) or next((t for t in loaded.values() if t.name == name), None)
        if tool is None:
            names = ", ".join(tool.name for tool in loaded.values())
            raise UserError(f"--fit_of: the kit has no tool '{name}': give one of {names}")
        if not 0.0 <= value <= _WIDEST_MM:
            raise UserError(f"--fit_of {name}={value:g} is out of range: give 0 to {_WIDEST_MM:g}")
        clearances[tool.name] = round(1e-3 * value, 7)
    for tool in loaded.values():
        if tool.outline_error and tool.name not in clearances:
            clearances[tool.name] = _widened(request, tool)
    return clearances


def _widened(request: KitRequest, tool: Tool) -> float:
    """Returns the clearance, in metres, of a tool whose outline is uncertain.

    The requested clearance is increased by the outline's error, but not beyond the default of 2 mm.
    """
    default = KitParameters().clearance
    asked = default if request.clearance_mm is None else 1e-3 * request.clearance_mm
    return round(max(asked, min(asked + tool.outline_error, default)), 7)


def error_notes(request: KitRequest, tools: Sequence[Tool]) -> list[str]:
    """Returns a sentence for each tool whose cavity is wider because its outline is uncertain."""
    given = {name for name, _ in request.fit_of}
    notes = {
        tool.name: f"the cavity of '{tool.name}' has a clearance of "
        f"{1e3 * _widened(request, tool):g} mm on each side, because its outline may be off by "
        f"{1e3 * tool.outline_error:g} mm: "
        f"--fit_of {tool.name}=FIT sets another clearance"
        for name, tool in zip(request.tools, tools, strict=True)
        if tool.outline_error and not given & {name, tool.name}
    }
    return list(notes.values())


def _on_grid(tools: Sequence[Tool], parameters: KitParameters) -> KitParameters:
    """Returns the parameters with a length and a width on Gridfinity's grid.

    Raises:
        UserError: the given sides are not on the grid, or the tools do not fit on any block.
    """
    if not parameters.fixed_size:
        least = layout_kit(tools, parameters).parameters
        sides = [grid_side(1e3 * side) for side in (least.length, least.width)]
        if max(sides) > _LONGEST_MM:
            raise UserError("the tools do not fit on a Gridfinity base: use fewer tools")
        length, width = (round(1e-3 * side, 7) for side in sides)
        return dataclasses.replace(parameters, length=length, width=width, fixed_size=True)
    given = [round(1e3 * side, 4) for side in (parameters.length, parameters.width)]
    right = [grid_side(side) for side in given]
    if given != right:
        advice = " ".join(f"{side:g}" for side in right)
        raise UserError(
            f"--block_mm {given[0]:g} {given[1]:g}: with --base gridfinity, length and width must "
            f"be half a millimetre less than multiples of {PITCH:g} mm: give {advice}"
        )
    return parameters


def _sheet_limits(sheet: SheetRequest | None) -> list[tuple[str, float, float, float]]:
    """Returns (flag, value, lowest, highest) for each flag of a sheet."""
    if sheet is None:
        return []
    return [
        *(("--sheet", side, 50.0, 5000.0) for side in sheet.size_mm),
        ("--margin_mm", sheet.margin_mm, 0.0, 500.0),
        ("--gap_mm", sheet.gap_mm, 0.0, 500.0),
        ("--copies", 1 if sheet.copies is None else sheet.copies, 1, MOST_KITS),
    ]


def request_of(args: argparse.Namespace, robot: str) -> KitRequest:
    """Makes a request from a command line.

    Args:
        args: the parsed arguments of `describe_kit`.
        robot: see `KitRequest`.

    Raises:
        UserError: a flag is given without another one that it needs.
    """
    if args.two_colours and not args.labels:
        raise UserError("--two_colours needs --labels")
    if args.sheet is None and (args.beside or args.copies):
        raise UserError("--beside and --copies need --sheet")
    sheet = args.sheet and SheetRequest(
        size_mm=tuple(args.sheet),
        margin_mm=args.margin_mm,
        gap_mm=args.gap_mm,
        copies=args.copies,
        others=tuple(args.beside),
    )
    return KitRequest(
        tools=tuple(args.tools),
        output=args.output,
        clearance_mm=args.clearance_mm if args.fit is None else FITS[args.fit],
        compensate_mm=args.compensate_mm,
        lead_in_mm=args.lead_in_mm,
        fit_of=tuple(args.fit_of),
        stand_out_mm=args.stand_out_mm,
        wall_mm=args.wall_mm,
        block_mm=tuple(args.block_mm) if args.block_mm else None,
        notches=args.notches,
        labels=args.labels,
        two_colours=args.two_colours,
        chamfer_mm=args.chamfer_mm,
        gridfinity=args.base == "gridfinity",
        nozzle_mm=args.nozzle_mm,
        bed_mm=tuple(args.bed) if args.bed else None,
        joint_play_mm=args.joint_play_mm,
        sheet=sheet,
        robot=robot,
    )


def _fit_of(text: str) -> tuple[str, float]:
    """Parses `TOOL=FIT` into the tool and its clearance on each side, in mm."""
    name, equals, fit = text.rpartition("=")
    try:
        value = FITS[fit] if fit in FITS else float(fit)
    except ValueError:
        value = None
    if not name or not equals or value is None:
        names = ", ".join(FITS)
        raise argparse.ArgumentTypeError(
            f"'{text}' is not TOOL=FIT, where FIT is {names} or the clearance on each side in mm"
        )
    return name, value


def describe_kit(maker: argparse.ArgumentParser) -> None:
    """Adds the arguments of `hkd kit`."""
    maker.add_argument("tools", nargs="+", metavar="TOOL", help="names or folders of tools")
    maker.add_argument(
        "--output", type=Path, required=True, metavar="DIR", help="the folder to write"
    )
    _describe_cavities(maker)
    _describe_block(maker)
    _describe_sheet(maker)
    maker.add_argument(
        "--robot",
        type=Path,
        metavar="ROBOT.yaml",
        help="a file that describes your robot arm, as for `decide`; `kit` then reports in how "
        "many simulated scenes the arm reaches all tools and cavities",
    )
    maker.add_argument("--quiet", action="store_true", help="print nothing but errors")


def _describe_cavities(maker: argparse.ArgumentParser) -> None:
    room = maker.add_mutually_exclusive_group()
    room.add_argument(
        "--clearance_mm",
        type=float,
        help="the clearance between a tool and its cavity's wall (default: 2)",
    )
    room.add_argument(
        "--fit",
        choices=FITS,
        help="the clearance by name: snug (0.15 mm on each side), easy (0.35) or loose (0.75)",
    )
    maker.add_argument(
        "--fit_of",
        type=_fit_of,
        action="append",
        default=[],
        metavar="TOOL=FIT",
        help="the clearance of one tool, by name or in mm on each side; may be repeated",
    )
    maker.add_argument(
        "--compensate_mm",
        type=float,
        default=0.0,
        help="how much too narrow your printer or router makes cavities, on each side. It is "
        "half the difference between 20 mm and the side of the printed hole of test_piece.stl "
        "(default: 0)",
    )
    maker.add_argument(
        "--stand_out_mm",
        type=float,
        default=0.0,
        help="the height of the tools' tops above the block's top (default: 0, flush)",
    )
    maker.add_argument(
        "--lead_in_mm", type=float, help="the width of the bevel around the rims (default: 1)"
    )
    maker.add_argument(
        "--wall_mm", type=float, help="the wall between and around the cavities (default: 6)"
    )
    maker.add_argument("--notches", action="store_true", help="add finger notches")
    maker.add_argument("--labels", action="store_true", help="engrave the tools' names")
    maker.add_argument(
        "--two_colours",
        action="store_true",
        help="fill the engraved names with letters of a second colour (3MF, labels.stl)",
    )


def _describe_block(maker: argparse.ArgumentParser) -> None:
    maker.add_argument(
        "--block_mm",
        type=float,
        nargs=3,
        metavar=("LENGTH", "WIDTH", "HEIGHT"),
        help="the block's size (default: as small as possible, and 50 high)",
    )
    maker.add_argument(
        "--base",
        choices=("flat", "gridfinity"),
        default="flat",
        help="gridfinity: with sides and feet for Gridfinity's grid of 42 mm (default: flat)",
    )
    maker.add_argument(
        "--chamfer_mm", type=float, default=0.0, help="the bevel of the outer edges (default: 0)"
    )
    maker.add_argument(
        "--nozzle_mm",
        type=float,
        default=0.4,
        help="the width of the printer's nozzle; thinner walls are reported (default: 0.4)",
    )
    maker.add_argument(
        "--bed",
        type=float,
        nargs=2,
        metavar=("X", "Y"),
        help="split a larger block into pieces that fit the printer's bed (mm), with dovetails",
    )
    maker.add_argument(
        "--joint_play_mm",
        type=float,
        default=0.1,
        help="the gap between a dovetail and its socket, on each side (default: 0.1)",
    )


def _describe_sheet(maker: argparse.ArgumentParser) -> None:
    maker.add_argument(
        "--sheet",
        type=float,
        nargs=2,
        metavar=("X", "Y"),
        help="fill a foam sheet or a drawer of this size (mm) with the kit",
    )
    maker.add_argument(
        "--beside",
        type=Path,
        action="append",
        default=[],
        metavar="DIR",
        help="the folder of another kit to put on the sheet; may be repeated",
    )
    maker.add_argument(
        "--copies",
        type=count_type,
        help="the number of copies of each kit on the sheet (default: as many as fit)",
    )
    maker.add_argument(
        "--margin_mm",
        type=float,
        default=10.0,
        help="the least distance of a kit from the sheet's edge (default: 10)",
    )
    maker.add_argument(
        "--gap_mm",
        type=float,
        default=5.0,
        help="the least distance between two kits on the sheet (default: 5)",
    )
