"""The command line of `hkd trace`."""

import argparse
import shlex
from pathlib import Path
from typing import TYPE_CHECKING

from rich.console import Console
from rich.markup import escape

from kitting_drake.common.errors import UserError
from kitting_drake.hkd.listing import size_text

if TYPE_CHECKING:
    from kitting_drake.hkd.importing.importer import ImportReport
    from kitting_drake.hkd.tracing.scales import Scale
    from kitting_drake.hkd.tracing.tracer import TracedTool

_OUTLINE_ERROR_MM = 0.8
"""`Tool.outline_error` of a traced tool, in mm.

If the trace reports no doubtful place, the real tool extends beyond the traced outline by at most
this, almost everywhere. `hkd kit` adds this distance to small clearances.
"""


def describe_trace(tracer: argparse.ArgumentParser) -> None:
    """Adds the arguments of `hkd trace`."""
    tracer.add_argument(
        "photos",
        type=Path,
        nargs="+",
        metavar="PHOTO",
        help="a photo of the tools from above (JPEG, PNG); better two photos, from opposite sides "
        "of the sheet",
    )
    tracer.add_argument(
        "--output", type=Path, required=True, metavar="DIR", help="the folder to write"
    )
    tracer.add_argument(
        "--sheet",
        nargs="+",
        metavar="SIZE",
        help="size of the sheet under the tools: a4, letter, or two sides in mm (default: A4 or "
        "Letter, by its proportions)",
    )
    tracer.add_argument(
        "--height_mm",
        type=float,
        nargs="+",
        metavar="MM",
        help="height of the tools above the ground, in mm: one for all, or one for each from "
        "left to right (default: found from several photos)",
    )
    tracer.add_argument(
        "--edges",
        choices=("upright", "round"),
        default="upright",
        help="shape of the tools' sides: upright, or round with the widest point at half the "
        "height (default: upright)",
    )
    tracer.add_argument(
        "--camera_mm",
        type=float,
        metavar="MM",
        help="height of the camera above the ground, in mm (default: from the focal length)",
    )
    tracer.add_argument(
        "--points",
        type=Path,
        metavar="FILE",
        help="a file of corrections (YAML): see docs/printing.md",
    )
    tracer.add_argument("--name", help="name of the outlines (default: the first photo's name)")
    tracer.add_argument(
        "--category",
        nargs="+",
        metavar="NAME",
        help="also import the outlines as tools: one category for all, or one for each from left "
        "to right",
    )
    _describe_scales(tracer.add_argument_group("scale without a sheet"))
    tracer.add_argument("--quiet", action="store_true", help="print nothing but errors")


def _describe_scales(scales: "argparse._ArgumentGroup") -> None:
    scales.add_argument(
        "--scale_px",
        type=float,
        nargs=4,
        metavar=("U1", "V1", "U2", "V2"),
        help="two points in the photo, in pixels, for instance on a ruler",
    )
    scales.add_argument(
        "--scale_mm",
        type=float,
        metavar="MM",
        help="the distance between the two points of --scale_px, in mm",
    )
    scales.add_argument(
        "--disc_mm",
        type=float,
        metavar="MM",
        help="the diameter, in mm, of a coin beside the tools",
    )
    scales.add_argument(
        "--board",
        type=float,
        nargs=4,
        metavar=("COLUMNS", "ROWS", "SQUARE_MM", "MARKER_MM"),
        help="a ChArUco board beside the tools",
    )
    scales.add_argument(
        "--dictionary",
        default="DICT_4X4_50",
        help="OpenCV's name of the board's marker dictionary (default: DICT_4X4_50)",
    )


def _print_tool(console: Console, tool: "TracedTool") -> None:
    size = " x ".join(f"{side:.1f}" for side in tool.size_mm)
    holes = "1 hole" if tool.holes == 1 else f"{tool.holes or 'no'} holes"
    console.print(f"{tool.name}: {size} mm, {holes}")
    if not tool.doubts:
        return
    places = ", ".join(f"({x:.0f}, {y:.0f})" for x, y in (item.place for item in tool.doubts))
    console.print(
        f"  DOUBT: its outline may be wrong near {places} mm, where tool, shine and shadow look "
        "alike: see the red circles in trace.png, and mend it with --points, add a photo from "
        "another side, or take the photo in softer light",
        soft_wrap=True,
    )


def trace_photo(args: argparse.Namespace) -> None:
    """Traces photos and prints what was found; imports the tools on request.

    Raises:
        UserError: the arguments or the photos cannot be used.
    """
    # Import lazily, because OpenCV is slow to import.
    from kitting_drake.hkd.tracing.tracer import TraceRequest, trace

    if args.category and not args.height_mm and len(args.photos) == 1:
        raise UserError("--category needs the tools' height: give --height_mm or a second photo")
    request = TraceRequest(
        photos=tuple(args.photos),
        output=args.output,
        sheet_mm=_sheet(args.sheet),
        scale=_scale(args),
        heights_mm=tuple(args.height_mm or ()),
        edges=args.edges,
        camera_mm=args.camera_mm,
        points=args.points,
        name=args.name,
    )
    console = Console(quiet=args.quiet, highlight=False, markup=False)
    with Console(stderr=True, quiet=args.quiet).status(f"tracing {escape(str(args.photos[0]))}"):
        report = trace(request)
    for tool in report.tools:
        _print_tool(console, tool)
    for note in report.notes:
        console.print(f"  {note}", soft_wrap=True)
    console.print(f"look at {args.output}/trace.png before you cut", soft_wrap=True)
    if not args.category:
        return
    categories = args.category * len(report.tools) if len(args.category) == 1 else args.category
    if len(categories) != len(report.tools):
        raise UserError(
            f"--category has {len(categories)} names, and {args.photos[0]} shows "
            f"{len(report.tools)} tools: give one name, or one for each tool from left to right"
        )
    made = []
    for tool, category in zip(report.tools, categories, strict=True):
        with Console(stderr=True, quiet=args.quiet).status(f"importing {tool.name}"):
            imported = import_traced(tool, category, tool.name, args.output / "tools")
        record = imported.record
        console.print(f"{tool.name}: {size_text(record)} mm, {1e3 * record['mass']:.0f} g")
        made.append(shlex.quote(str(imported.directory)))
    console.print(
        f"next: python -m kitting_drake.hkd kit {' '.join(made)} --output DIR", soft_wrap=True
    )


def import_traced(tool: "TracedTool", category: str, name: str, folder: Path) -> "ImportReport":
    """Makes a tool from a traced outline, in a folder of tools.

    Raises:
        UserError: the tool cannot be made.
    """
    # Import lazily, because the importer is slow to import.
    from kitting_drake.hkd.importing.importer import ImportRequest, import_tool

    return import_tool(
        ImportRequest(
            mesh=tool.svg,
            category=category,
            name=name,
            output=folder,
            height_mm=tool.height_mm,
            outline_error_mm=_OUTLINE_ERROR_MM,
        )
    )


def _sheet(given: list[str] | None) -> tuple[float, float] | None:
    from kitting_drake.hkd.tracing.sheet_plane import SHEETS

    if given is None:
        return None
    if len(given) == 1 and given[0].lower() in SHEETS:
        return SHEETS[given[0].lower()]
    try:
        length, width = (float(text) for text in given)
    except ValueError as error:
        raise UserError(
            f"--sheet {' '.join(given)} must be {', '.join(SHEETS)} or two sides in mm"
        ) from error
    return length, width


def _scale(args: argparse.Namespace) -> "Scale | None":
    from kitting_drake.hkd.tracing.scales import Scale

    if (args.scale_px is None) != (args.scale_mm is None):
        raise UserError("give both --scale_px and --scale_mm, or neither")
    kinds = {"--sheet": args.sheet, "--scale_px": args.scale_px, "--disc_mm": args.disc_mm}
    given = [flag for flag, value in (kinds | {"--board": args.board}).items() if value is not None]
    if len(given) > 1:
        raise UserError(f"{' and '.join(given)} each set the scale: give one of them")
    if args.scale_px is not None:
        return Scale(points=tuple(args.scale_px), length_mm=args.scale_mm)
    if args.disc_mm is not None:
        if not 5 <= args.disc_mm <= 300:
            raise UserError(f"--disc_mm {args.disc_mm:g} is out of range: give 5 to 300")
        return Scale(disc_mm=args.disc_mm)
    if args.board is not None:
        columns, rows, square, marker = args.board
        return Scale(board=(int(columns), int(rows), square, marker), dictionary=args.dictionary)
    return None
