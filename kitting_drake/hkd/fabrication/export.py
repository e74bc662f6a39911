"""Writes all files of a kit into one folder, which appears atomically (`hkd kit`)."""

import dataclasses
import json
import shutil
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
import yaml

import kitting_drake
from kitting_drake.common.errors import UserError
from kitting_drake.common.files import replace_folder, write_json
from kitting_drake.hkd.fabrication.block_files import stl_bytes, threemf_bytes
from kitting_drake.hkd.fabrication.design import Design, design_kit, solid, test_piece
from kitting_drake.hkd.fabrication.drawings import dxf_text, svg_text
from kitting_drake.hkd.fabrication.picture import picture_png
from kitting_drake.hkd.generation.part_models import load_named
from kitting_drake.hkd.kits.kit import make_kit
from kitting_drake.hkd.kits.layout import MOST_TOOLS
from kitting_drake.hkd.kits.parameters import KitParameters
from kitting_drake.hkd.tools.tool import Tool, tool_names

FITS = {"snug": 0.15, "easy": 0.35, "loose": 0.75}
"""Named clearances between a tool and the wall, on each side, in mm."""

RECORD = "kit.json"
"""The name of the file that marks a folder as a kit's."""

_SCENARIO = """\
# Written by `hkd kit`: the tools and the kit of this folder, for `python -m kitting_drake.run`.
Kit:
  task: !Kitting
    tools: [{tools}]
    tries: 2
    kit: {kit}
  policy: !Learned {{recover: true}}
{robot}"""


@dataclass(frozen=True)
class KitRequest:
    """A kit to make; lengths in mm."""

    tools: tuple[str, ...]
    """Names of tools, or paths of tool folders."""
    output: Path
    clearance_mm: float | None = None
    """The clearance between a tool and its cavity's wall. None: the template's 2 mm."""
    compensate_mm: float = 0.0
    """How much too narrow the printer or router makes cavities, on each side. The cavities in the
    files to print and cut are wider by this; those of the simulated kit are not."""
    lead_in_mm: float | None = None
    """The width of the bevel around the rims. None: the template's 1 mm."""
    wall_mm: float | None = None
    block_mm: tuple[float, float, float] | None = None
    """The block's length, width and height. None: the smallest block found, with the template's
    height."""
    notches: bool = False
    labels: bool = False
    robot: str = ""
    """YAML lines that set the robot in the kit's scenario; empty: the default robot."""


def export_kit(request: KitRequest) -> Design:
    """Writes the folder of a kit; replaces a folder written by an earlier call.

    Raises:
        UserError: the kit cannot be made, or the folder holds other files or cannot be written.
            Nothing is changed then.
    """
    if not 1 <= len(request.tools) <= MOST_TOOLS:
        raise UserError(f"a kit holds 1 to {MOST_TOOLS} tools, not {len(request.tools)}")
    parameters = _parameters(request)
    loaded = {name: load_named(name) for name in dict.fromkeys(request.tools)}
    tools = [loaded[name] for name in request.tools]
    folder = request.output
    _check_replaceable(folder)
    kit = make_kit(tools, parameters)
    design = design_kit(
        kit,
        notches=request.notches,
        labels=request.labels,
        compensation=1e-3 * request.compensate_mm,
    )
    new_folders = [p for p in folder.parents if not p.exists()]
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=folder.parent, prefix=".making-") as scratch:
            made = Path(scratch) / "kit"
            made.mkdir()
            _write(made, design, parameters, request.robot)
            replace_folder(folder, made, Path(scratch) / "replaced")
    except OSError as error:
        raise UserError(f"cannot write {folder}: {error.strerror or error}") from error
    finally:
        for path in new_folders:
            if path.is_dir() and not any(path.iterdir()):
                path.rmdir()
    return design


def _parameters(request: KitRequest) -> KitParameters:
    """Builds the kit's parameters from a request.

    Raises:
        UserError: a length is out of range.
    """
    parameters = KitParameters(always_nested=True)
    for flag, value, low, high in (
        ("--clearance_mm", request.clearance_mm, 0.0, 10.0),
        ("--wall_mm", request.wall_mm, 2.0, 50.0),
        ("--lead_in_mm", request.lead_in_mm, 0.0, 5.0),
        ("--compensate_mm", request.compensate_mm, -1.0, 1.0),
    ):
        if value is not None and not low <= value <= high:
            raise UserError(f"{flag} {value:g} is out of range: give {low:g} to {high:g}")
    if request.clearance_mm is not None:
        parameters.clearance = round(1e-3 * request.clearance_mm, 7)
        # Keep the outline's simplification small compared to the clearance.
        finest = max(parameters.clearance / 20, 1e-6)
        parameters.tolerance = min(parameters.tolerance, finest)
    if request.lead_in_mm is not None:
        parameters.lead_in = round(1e-3 * request.lead_in_mm, 7)
    if request.wall_mm is not None:
        parameters.nested_wall = round(1e-3 * request.wall_mm, 7)
    if request.block_mm is not None:
        limits = ((50.0, 1000.0), (50.0, 1000.0), (10.0, 200.0))
        for value, name, (low, high) in zip(
            request.block_mm, ("length", "width", "height"), limits, strict=True
        ):
            if not low <= value <= high:
                raise UserError(
                    f"--block_mm: a {name} of {value:g} is out of range: give {low:g} to {high:g}"
                )
        parameters.length, parameters.width, parameters.height = (
            round(1e-3 * value, 7) for value in request.block_mm
        )
        parameters.fixed_size = True
    return parameters


def _check_replaceable(folder: Path) -> None:
    """Raises UserError unless the folder is missing or holds only a kit's files."""
    if not folder.exists():
        return
    advice = "give another --output, or delete it"
    if not folder.is_dir():
        raise UserError(f"{folder} is a file: {advice}")
    present = {path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file()}
    if not present and not any(folder.iterdir()):
        return
    try:
        own = set(json.loads((folder / RECORD).read_text())["files"])
    except (OSError, ValueError, KeyError, TypeError):
        own = set()
    foreign = sorted(present - own)
    if foreign or not present:
        what = foreign[0] if foreign else "an empty folder"
        raise UserError(f"{folder} holds {what}, which is not a kit's file: {advice}")


def _write(folder: Path, design: Design, parameters: KitParameters, robot: str) -> None:
    """Writes a kit's files into an empty folder."""
    surface = solid(design)
    title = f"Kit of {', '.join(tool.name for tool in design.kit.tools)}"
    stl = stl_bytes(surface)
    _check_closed(stl)
    (folder / "kit.stl").write_bytes(stl)
    (folder / "kit.3mf").write_bytes(threemf_bytes(surface, title))
    (folder / "test_piece.stl").write_bytes(stl_bytes(test_piece()))
    (folder / "cavities.dxf").write_text(dxf_text(design))
    (folder / "cavities.svg").write_text(svg_text(design))
    (folder / "kit.png").write_bytes(picture_png(design))
    shutil.copytree(design.kit.sdf.parent, folder / "sdf")
    names = _bring_tools(design.kit.tools, folder)
    (folder / "scenario.yaml").write_text(_scenario_text(names, parameters, robot))
    files = sorted(
        path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file()
    )
    write_json(folder / RECORD, {**_record(design, names), "files": [*files, RECORD]})


def _check_closed(stl: bytes) -> None:
    mesh = trimesh.load_mesh(trimesh.util.wrap_as_stream(stl), file_type="stl")
    if not (mesh.is_watertight and mesh.is_winding_consistent):
        raise UserError(
            "the block with these cavities is not watertight: change --clearance_mm or --wall_mm "
            "by a tenth of a millimetre"
        )


def _bring_tools(tools: Sequence[Tool], folder: Path) -> list[str]:
    """Copies the user's tools into `tools/` and returns the scenario's name of every tool."""
    names: dict[Path, str] = {}
    for tool in tools:
        if tool.directory in names:
            continue
        if tool.split != "user" and tool.name in tool_names():
            names[tool.directory] = tool.name
            continue
        place, number = f"tools/{tool.name}", 2
        while place in names.values():
            place, number = f"tools/{tool.name}_{number}", number + 1
        shutil.copytree(tool.directory, folder / place)
        names[tool.directory] = place
    return [names[tool.directory] for tool in tools]


def _scenario_text(names: Sequence[str], parameters: KitParameters, robot: str) -> str:
    defaults = KitParameters()
    changed = {
        key: value
        for key, value in dataclasses.asdict(parameters).items()
        if value != getattr(defaults, key)
    }
    kit = yaml.safe_dump(changed, default_flow_style=True, width=1000, sort_keys=False).strip()
    return _SCENARIO.format(tools=", ".join(names), kit=kit, robot=robot)


def _record(design: Design, names: Sequence[str]) -> dict[str, Any]:
    length, width, _ = design.kit.size
    return {
        "made_by": f"kitting_drake {kitting_drake.__version__}",
        "units": "millimetres; the origin is the lower left corner of the block's bottom",
        "block": list(design.size_mm),
        "compensate_mm": round(1e3 * design.compensation, 4),
        "kit_parameters_m": dataclasses.asdict(design.kit.parameters),
        "tools": [
            {
                "name": tool.name,
                "path": name,
                "position": [
                    round(1e3 * float(v), 3)
                    for v in (pose.x + length / 2, pose.y + width / 2, pose.z)
                ],
                "yaw_deg": round(float(np.degrees(pose.yaw)), 3),
                "cavity_depth": design.depth_mm(recess),
            }
            for tool, name, pose, recess in zip(
                design.kit.tools, names, design.kit.layout.poses, design.recesses, strict=False
            )
        ],
        "notes": list(design.notes),
    }
