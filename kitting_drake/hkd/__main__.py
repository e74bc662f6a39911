"""Tools and kits of the Hand-tool Kitting Dataset: `python -m kitting_drake.hkd COMMAND`."""

from __future__ import annotations

import argparse
import os
import shlex
from pathlib import Path
from typing import TYPE_CHECKING

from rich.console import Console
from rich.markup import escape
from rich.progress import Progress, track
from rich.table import Table

from kitting_drake.common.command_line import count_type, run_command
from kitting_drake.common.errors import UserError
from kitting_drake.common.paths import MODELS
from kitting_drake.hkd.fabrication.kit_request import describe_kit, request_of
from kitting_drake.hkd.generation.catalogue import ToolEntry, load_catalogue
from kitting_drake.hkd.generation.generate import generate_tool
from kitting_drake.hkd.generation.part_models import load_named
from kitting_drake.hkd.listing import chosen_entries, chosen_with_own, print_tools, size_text
from kitting_drake.hkd.proving import describe_proof, tools_to_prove
from kitting_drake.hkd.tools.tool import CATEGORIES
from kitting_drake.hkd.tools.toolsets import SPLITS, toolsets
from kitting_drake.hkd.tracing.command import describe_trace, trace_photo

if TYPE_CHECKING:
    from kitting_drake.scenario.schema import Scenario


def list_tools(args: argparse.Namespace, entries: list[ToolEntry]) -> None:
    """Prints a table of the available tools."""
    print_tools(args.models, entries, args.names, Console(markup=False))


def generate(args: argparse.Namespace, entries: list[ToolEntry]) -> None:
    """Regenerates models and prints how closely each one's collision hulls match its visual
    shape."""
    table = Table(caption="outline, top, grip: largest error of the collision hulls, in mm")
    table.add_column("name", no_wrap=True)
    for heading in ("triangles", "hulls", "outline", "top", "grip", "tilt, deg"):
        table.add_column(heading, justify="right")
    chosen = chosen_entries(entries, args.names)
    for entry in track(chosen, "generating", console=Console(stderr=True), disable=args.quiet):
        r = generate_tool(entry, args.models / "tools" / entry.name)
        outline = f"+{r.outside_mm:.2f}/-{r.inside_mm:.2f}"
        errors = (f"{v:.2f}" for v in (r.top_error_mm, r.grip_error_mm, r.tilt_deg))
        table.add_row(entry.name, str(r.triangles), str(r.collision_hulls), outline, *errors)
    if not args.quiet:
        Console().print(table)


def sheet(args: argparse.Namespace, entries: list[ToolEntry]) -> None:
    """Renders a contact sheet of tools or kits."""
    # Import Drake lazily, because it is slow to import.
    from kitting_drake.hkd.kits.kit import make_kit
    from kitting_drake.hkd.kits.parameters import KitParameters
    from kitting_drake.hkd.sheet import kit_subject, tool_subject, write_sheet

    if args.kits:
        if args.names:
            raise UserError(f"--kits draws kits, not tools: leave out --kits or '{args.names[0]}'")
        chosen = toolsets(args.split)[: args.kits]
        kits = [make_kit([load_named(name) for name in names], KitParameters()) for names in chosen]
        subjects = [kit_subject(f"{args.split} {i:03d}", kit) for i, kit in enumerate(kits)]
    else:
        shown, own = chosen_with_own(entries, args.names)
        names = [*(entry.name for entry in shown), *own]
        subjects = [tool_subject(load_named(name)) for name in names]
    with Progress(console=Console(stderr=True, quiet=args.quiet), transient=True) as progress:
        write_sheet(progress.track(subjects, description="drawing"), len(subjects), args.output)


def build(args: argparse.Namespace, entries: list[ToolEntry]) -> None:
    """Writes the paper's tools and kits to a folder, in formats that other simulators load."""
    from kitting_drake.hkd.dataset import build_dataset

    with Progress(console=Console(stderr=True), transient=True, disable=args.quiet) as progress:
        task = progress.add_task("kits", total=None)
        manifest = build_dataset(
            args.output,
            lambda done, total: progress.update(task, completed=done, total=total),
            mjcf=args.format == "mjcf",
        )
    if not args.quiet:
        counts = f"{len(manifest['tools'])} tools and {len(manifest['kits'])} kits"
        Console(markup=False).print(f"{counts}: {args.output}/manifest.json", highlight=False)


def annotate(args: argparse.Namespace, entries: list[ToolEntry]) -> None:
    """Opens a page on which you move a gripper over a tool and save a grasp."""
    from kitting_drake.hkd.annotate import annotate as annotate_tool

    annotate_tool(args.name, Console())


def import_mesh(args: argparse.Namespace, entries: list[ToolEntry]) -> None:
    """Makes a tool from a mesh (STL, OBJ, PLY, OFF, GLB, 3MF) or an outline (SVG, DXF)."""
    from kitting_drake.hkd.importing.importer import ImportRequest, import_tool

    console = Console(quiet=args.quiet, highlight=False, markup=False)
    request = ImportRequest(
        mesh=args.mesh,
        category=args.category,
        name=args.name,
        length_mm=args.length_mm,
        unit=args.unit,
        mass_g=args.mass_g,
        material=args.material,
        density=args.density,
        output=args.output,
        height_mm=args.height_mm,
        frame=args.frame,
    )
    with Console(stderr=True, quiet=args.quiet).status(f"importing {escape(str(args.mesh))}"):
        report = import_tool(request)
    d = report.record
    held = f"{1e3 * d['grasp']['width']:.1f} mm wide at the grasp"
    console.print(f"{d['name']}: {size_text(d)} mm, {1e3 * d['mass']:.0f} g, {held}")
    for note in report.notes:
        console.print(f"  {note}")
    console.print(f"  see {report.directory}/outline.png", soft_wrap=True)
    named = d["name"] if args.output is None else report.directory.resolve()
    console.print(
        f"files: {report.directory}/; the tool's name in a scenario is '{named}'", soft_wrap=True
    )


def trace(args: argparse.Namespace, entries: list[ToolEntry]) -> None:
    """Makes outlines (SVG, DXF), and tools, from a photo of tools on a sheet of paper."""
    trace_photo(args)


def kit(args: argparse.Namespace, entries: list[ToolEntry]) -> None:
    """Makes a kit of 1 to 12 tools: to print (STL, 3MF), to cut (DXF, SVG) and to simulate."""
    from kitting_drake.hkd.fabrication.export import export_kit

    request = request_of(args, "" if args.robot is None else _robot_text(args.robot))
    true_tools = tools_to_prove(args.tools, args.prove_with)
    if true_tools and not args.prove:
        raise UserError("--prove_with needs --prove")
    if args.prove:
        # Check early, so that missing libraries are reported before any work.
        from kitting_drake.common.rendering import require_rendering

        require_rendering()
    with Console(stderr=True, quiet=args.quiet).status("making the kit"):
        made = export_kit(request)
    console = Console(quiet=args.quiet, highlight=False, markup=False)
    size = " x ".join(f"{side:g}" for side in made.design.size_mm)
    files = "kit.stl, kit.3mf, cavities.dxf, cavities.svg, kit.png"
    console.print(f"a block of {size} mm in {args.output}/: {files}", soft_wrap=True)
    if made.split is not None:
        console.print(f"  {len(made.split.pieces)} pieces: piece_1.stl and on, see pieces.png")
    elif args.bed:
        console.print("  the block fits the bed in one piece")
    if made.sheet is not None:
        console.print(f"  {len(made.sheet.places)} kits on the sheet: sheet.dxf, .svg and .png")
    for note in made.notes:
        console.print(f"  {note}", soft_wrap=True)
    has_room = _check_scenario(args.output / "scenario.yaml", console)
    if args.prove and has_room:
        _prove(args.output, args.prove, true_tools, args.workers or os.cpu_count() or 1, console)


def _prove(
    folder: Path, episodes: int, true_tools: list[str], workers: int, console: Console
) -> None:
    from kitting_drake.evaluation.kit_proof import prove_kit

    with Console(stderr=True, quiet=console.quiet).status("proving the kit") as status:

        def progress(what: str, done: int, total: int) -> None:
            status.update(f"proving the kit: {what}, {done} of {total} episodes")

        verdict = prove_kit(folder, episodes, progress, tools=true_tools, workers=workers)
    console.print(f"{verdict}\nproof: {folder}/proof.html", soft_wrap=True)


_SCENES = 20
"""The number of scenes in which the reach of a robot arm is checked."""


def _robot_text(path: Path) -> str:
    """Reads the arm of a robot file and returns the YAML lines that set it in a scenario.

    Raises:
        UserError: the file is invalid, or the arm stands in the workspace.
    """
    from kitting_drake.real_camera import read_robot
    from kitting_drake.scenario.robots import FrankaArm
    from systems.signals import PixelGrid

    record = read_robot(path).as_dict()
    model, base, yaw_deg = record["model"], record["base"], record["yaw_deg"]
    try:
        FrankaArm(model=model, base=base, yaw_deg=yaw_deg).validate(PixelGrid())
    except ValueError as error:
        raise UserError(f"{path}: {str(error).removeprefix('robot.')}") from error
    text = f"  robot: !FrankaArm {{model: {model}, base: {base}, yaw_deg: {yaw_deg:g}}}\n"
    return text + (f"  planner: {{home: {record['home']}}}\n" if "home" in record else "")


def _check_scenario(path: Path, console: Console) -> bool:
    """Prints how to run a kit's scenario, or why it cannot be run.

    If the robot is an arm, also prints in how many scenes the arm reaches all tools and cavities.

    Returns:
        Whether the scenario can be run.
    """
    # Import the loader lazily, because it is slow to import.
    from kitting_drake.scenario.loader import load_scenario
    from kitting_drake.scenario.robots import FrankaArm
    from systems.signals import PixelGrid

    scenario = load_scenario(path)
    try:
        scenario.task.make_scene(grid=PixelGrid(), seed=0, base=path.parent)
    except UserError:
        console.print(
            "  the simulated table has no room for this block and its tools: to `run` it, make a "
            "smaller block or use fewer tools",
            soft_wrap=True,
        )
        return False
    if isinstance(scenario.robot, FrankaArm):
        try:
            note = _reach_note(scenario, path.parent)
        except UserError as error:
            console.print(f"  the arm cannot kit in the simulated cell: {error}", soft_wrap=True)
            return False
        console.print(f"  {note}", soft_wrap=True)
    console.print(f"try it: python -m kitting_drake.run {shlex.quote(str(path))}", soft_wrap=True)
    return True


def _reach_note(scenario: Scenario, base: Path) -> str:
    """Says in how many of `_SCENES` scenes an arm reaches all tools and cavities of a kit.

    Raises:
        UserError: the arm cannot reach its home position.
    """
    from kitting_drake.station.robot import make_motion
    from kitting_drake.station.scene_reach import scene_problems
    from systems.arm_motion import ArmMotion
    from systems.signals import PixelGrid

    motion = make_motion(scenario)
    assert isinstance(motion, ArmMotion)
    first, reached = "", 0
    console = Console(stderr=True)
    for seed in track(range(_SCENES), "checking the reach", console=console, transient=True):
        scene = scenario.task.make_scene(grid=PixelGrid(), seed=seed, base=base)
        problems = scene_problems(scene, motion, scenario.planner)
        reached += not problems
        first = first or (problems[0] if problems else "")
    found = f"the arm reaches all cavities and tools in {reached} of {_SCENES} scenes"
    return f"{found}; in one of the other scenes, {first}" if first else found


def main() -> int:
    """Runs one command and returns the exit status."""
    parser = argparse.ArgumentParser(prog="python -m kitting_drake.hkd", description=__doc__)
    verbs = parser.add_subparsers(dest="verb", required=True)
    for name, function in (("list", list_tools), ("generate", generate), ("sheet", sheet)):
        verb = verbs.add_parser(name, help=function.__doc__)
        verb.add_argument(
            "names", nargs="*", metavar="NAME", help="names of tools (default: all tools)"
        )
        verb.set_defaults(function=function)
        if name != "sheet":
            verb.add_argument(
                "--models", type=Path, default=MODELS, help="the folder with package.xml and tools/"
            )
        if name != "list":
            verb.add_argument("--quiet", action="store_true", help="print nothing but errors")
        if name == "sheet":
            verb.add_argument("--output", type=Path, required=True, help="the PNG to write")
            verb.add_argument(
                "--kits", type=count_type, help="draw this many kits instead of tools"
            )
            verb.add_argument(
                "--split", choices=SPLITS, default="train", help="the kits' split (default: train)"
            )
    builder = verbs.add_parser("build", help=build.__doc__)
    builder.add_argument("--output", type=Path, required=True, help="the folder to write")
    builder.add_argument(
        "--format",
        choices=("sdf", "mjcf"),
        default="sdf",
        help="mjcf: also write MuJoCo models beside the SDFormat ones",
    )
    builder.add_argument("--quiet", action="store_true", help="print nothing but errors")
    builder.set_defaults(function=build)
    annotator = verbs.add_parser("annotate", help=annotate.__doc__)
    annotator.add_argument("name", metavar="NAME", help="a tool's name, or its folder")
    annotator.set_defaults(function=annotate)
    _describe_import(verbs.add_parser("import", help=import_mesh.__doc__))
    tracer = verbs.add_parser("trace", help=trace.__doc__)
    describe_trace(tracer)
    tracer.set_defaults(function=trace)
    maker = verbs.add_parser("kit", help=kit.__doc__)
    describe_kit(maker)
    describe_proof(maker)
    maker.set_defaults(function=kit)
    args = parser.parse_args()
    models = getattr(args, "models", MODELS)
    args.function(args, load_catalogue(models / "tools" / "catalogue.yaml"))
    return 0


def _describe_import(importer: argparse.ArgumentParser) -> None:
    importer.add_argument("mesh", type=Path, metavar="FILE", help="a mesh or an outline")
    importer.add_argument(
        "--category",
        required=True,
        help=f"the tool's category: {', '.join(CATEGORIES)}, or any other name",
    )
    importer.add_argument("--name", help="the tool's name (default: the file's name)")
    importer.add_argument(
        "--output",
        type=Path,
        metavar="DIR",
        help="the folder in which to put the tool (default: $KITTING_DRAKE_TOOLS, or a folder in "
        "~/.local/share)",
    )
    importer.add_argument(
        "--length_mm",
        type=float,
        help="the length in mm to scale to (default: the true length)",
    )
    importer.add_argument(
        "--unit",
        help="the file's unit: mm, cm, m or inches; for an outline also pt (1/72 inch) or px",
    )
    importer.add_argument(
        "--height_mm", type=float, help="the height in mm to which an outline is extruded"
    )
    importer.add_argument(
        "--frame",
        metavar="WHAT",
        help="page or tool: what a rectangle around all other curves of a drawing is",
    )
    importer.add_argument("--mass_g", type=float, help="the weighed mass of the tool in grams")
    importer.add_argument(
        "--material",
        help="the material of the whole tool: steel, aluminium, brass, titanium, wood, plastic "
        "or rubber",
    )
    importer.add_argument(
        "--density",
        type=float,
        metavar="KG_M3",
        help="the density of the whole tool in kg/m^3 (default: the category's)",
    )
    importer.add_argument("--quiet", action="store_true", help="print nothing but errors")
    importer.set_defaults(function=import_mesh)


if __name__ == "__main__":
    run_command(main)
