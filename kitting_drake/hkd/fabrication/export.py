"""Writes all files of a kit into one folder (`hkd kit`). The folder appears atomically."""

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
from manifold3d import Manifold

import kitting_drake
from kitting_drake.common.errors import UserError
from kitting_drake.common.files import replace_folder, write_json
from kitting_drake.hkd.fabrication.block_files import stl_bytes, threemf_bytes
from kitting_drake.hkd.fabrication.design import (
    Design,
    design_kit,
    letters,
    openings,
    solid,
    surface,
    test_piece,
)
from kitting_drake.hkd.fabrication.drawings import dxf_text, svg_text
from kitting_drake.hkd.fabrication.foam_sheet import (
    FoamSheet,
    SheetKit,
    fill_sheet,
    kit_of_dxf,
    kit_of_folder,
    sheet_dxf,
    sheet_svg,
)
from kitting_drake.hkd.fabrication.kit_request import (
    KitRequest,
    check_request,
    error_notes,
    kit_parameters,
)
from kitting_drake.hkd.fabrication.labels import DEPTH
from kitting_drake.hkd.fabrication.outside import Outside, foot_sections
from kitting_drake.hkd.fabrication.picture import picture_png, sheet_png
from kitting_drake.hkd.fabrication.splitting.assembly_picture import assembly_png
from kitting_drake.hkd.fabrication.splitting.pieces import Split, split_block
from kitting_drake.hkd.fabrication.thin_walls import undercut_notes, wall_notes
from kitting_drake.hkd.generation.part_models import load_named
from kitting_drake.hkd.kits.kit import Kit, make_kit
from kitting_drake.hkd.kits.layout import MOST_TOOLS
from kitting_drake.hkd.kits.parameters import KitParameters
from kitting_drake.hkd.tools.tool import Tool, tool_names

RECORD = "kit.json"
"""The name of the file that describes the kit in a folder, and lists the folder's files."""

_SCENARIO = """\
# Written by `hkd kit`: the tools and the kit of this folder, for `python -m kitting_drake.run`.
Kit:
  task: !Kitting
    tools: [{tools}]
    tries: 2
    kit: {kit}
  # The pads reach below the middle of thick round handles, so that these are not squeezed out.
  planner: {{grasp_depth_share: 0.6, max_grasp_depth: 0.025}}
  policy: !Learned {{recover: true}}
{robot}"""


@dataclass(frozen=True)
class KitFiles:
    """The results of `export_kit`."""

    design: Design
    block: Manifold
    """The block from `design.solid`, in mm."""
    letters: Manifold | None
    """The letters of a second colour from `design.letters`, in mm. None: there are none."""
    split: Split | None
    """The pieces of the block. None: the block is not split."""
    sheet: FoamSheet | None
    notes: tuple[str, ...]
    """Sentences for the user, for instance on labels without room and on thin walls."""


def export_kit(request: KitRequest) -> KitFiles:
    """Writes the folder of a kit; replaces a folder written by an earlier call.

    Raises:
        UserError: the kit cannot be made, or the folder holds other files or cannot be written.
            Nothing is changed then.
    """
    if not 1 <= len(request.tools) <= MOST_TOOLS:
        raise UserError(f"a kit holds 1 to {MOST_TOOLS} tools, not {len(request.tools)}")
    check_request(request)
    loaded = {name: load_named(name) for name in dict.fromkeys(request.tools)}
    tools = [loaded[name] for name in request.tools]
    parameters = kit_parameters(request, loaded)
    folder = request.output
    _check_replaceable(folder)
    others = [kit_of_folder(path) for path in request.sheet.others] if request.sheet else []
    made = _made(request, make_kit(tools, parameters), others)
    new_folders = [p for p in folder.parents if not p.exists()]
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=folder.parent, prefix=".making-") as scratch:
            inside = Path(scratch) / "kit"
            inside.mkdir()
            _write(inside, made, parameters, request.robot)
            replace_folder(folder, inside, Path(scratch) / "replaced")
    except OSError as error:
        raise UserError(f"cannot write {folder}: {error.strerror or error}") from error
    finally:
        for path in new_folders:
            if path.is_dir() and not any(path.iterdir()):
                path.rmdir()
    return made


def _made(request: KitRequest, kit: Kit, others: Sequence[SheetKit]) -> KitFiles:
    """Designs a kit's block; on request, splits the block and arranges kits on a sheet."""
    design = design_kit(
        kit,
        notches=request.notches,
        labels=request.labels,
        compensation=1e-3 * request.compensate_mm,
        outside=Outside(request.chamfer_mm, request.gridfinity),
    )
    block = solid(design)
    notes = [
        *design.notes,
        *error_notes(request, kit.tools),
        *wall_notes(design, 1e-3 * request.nozzle_mm),
        *undercut_notes(block, design),
    ]
    split = sheet = None
    if request.bed_mm is not None:
        feet = foot_sections(design.size_mm[:2]) if request.gridfinity else ()
        split = split_block(block, openings(design), request.bed_mm, request.joint_play_mm, feet)
        notes += split.notes if split else ()
    if request.sheet is not None:
        own = kit_of_dxf(request.output.name, dxf_text(design), design.size_mm[2])
        wanted = request.sheet
        sheet = fill_sheet(
            wanted.size_mm, wanted.margin_mm, wanted.gap_mm, [own, *others], wanted.copies
        )
        notes += sheet.notes
    filled = letters(design) if request.two_colours else None
    if filled is not None and filled.is_empty():
        filled = None
    return KitFiles(design, block, filled, split, sheet, tuple(notes))


def _check_replaceable(folder: Path) -> None:
    """Raises UserError unless the folder is missing, is empty or holds only a kit's files."""
    if not folder.exists():
        return
    advice = f"give another --output, or delete {folder}"
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
        raise UserError(f"{folder} holds {what}, which `hkd kit` did not write: {advice}")


def _write(folder: Path, made: KitFiles, parameters: KitParameters, robot: str) -> None:
    """Writes a kit's files into an empty folder."""
    design = made.design
    title = f"Kit of {', '.join(tool.name for tool in design.kit.tools)}"
    _write_solid(folder / "kit", made.block, title, made.letters)
    if made.letters is not None:
        (folder / "labels.stl").write_bytes(stl_bytes(surface(made.letters)))
    if made.split is not None:
        for piece in made.split.pieces:
            x, y, z = (-float(v) for v in piece.corner)
            name = f"piece_{piece.number}"
            own = made.letters
            if own is not None:
                # Keep the letters that have material of this piece below them.
                own = (own ^ piece.body.translate((0, 0, 1e3 * DEPTH))).translate((x, y, z))
            _write_solid(folder / name, piece.body.translate((x, y, z)), f"{title}, {name}", own)
        (folder / "pieces.png").write_bytes(assembly_png(made.split, openings(design)))
    (folder / "test_piece.stl").write_bytes(stl_bytes(surface(test_piece())))
    (folder / "cavities.dxf").write_text(dxf_text(design))
    (folder / "cavities.svg").write_text(svg_text(design))
    if made.sheet is not None:
        (folder / "sheet.dxf").write_text(sheet_dxf(made.sheet))
        (folder / "sheet.svg").write_text(sheet_svg(made.sheet))
        (folder / "sheet.png").write_bytes(sheet_png(made.sheet))
    (folder / "kit.png").write_bytes(picture_png(design))
    shutil.copytree(design.kit.sdf.parent, folder / "sdf")
    names = _bring_tools(design.kit.tools, folder)
    (folder / "scenario.yaml").write_text(_scenario_text(names, parameters, robot))
    files = sorted(
        path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file()
    )
    record = {**_record(design, names), "notes": list(made.notes), **_parts_record(made)}
    write_json(folder / RECORD, {**record, "files": [*files, RECORD]})


def _write_solid(stem: Path, solid: Manifold, title: str, letters: Manifold | None = None) -> None:
    """Writes a solid in mm to `stem` with the suffixes .stl and .3mf. The 3MF also has the letters
    of a second colour."""
    triangles = surface(solid)
    stl = stl_bytes(triangles)
    _check_closed(stl)
    stem.with_suffix(".stl").write_bytes(stl)
    filled = None if letters is None or letters.is_empty() else surface(letters)
    stem.with_suffix(".3mf").write_bytes(threemf_bytes(triangles, title, filled))


def _check_closed(stl: bytes) -> None:
    mesh = trimesh.load_mesh(trimesh.util.wrap_as_stream(stl), file_type="stl")
    if not (mesh.is_watertight and mesh.is_winding_consistent):
        raise UserError(
            "the block with these cavities is not watertight: change --clearance_mm or --wall_mm "
            "by a tenth of a millimetre"
        )


def _bring_tools(tools: Sequence[Tool], folder: Path) -> list[str]:
    """Copies the user's own tools into `folder/tools/`.

    Returns:
        The entry of each tool in the kit's scenario: its name, or the path of its copy.
    """
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
        "raised_mm": design.outside.raised_mm,
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
    }


def _parts_record(made: KitFiles) -> dict[str, Any]:
    """Returns the entries of `kit.json` that describe the block's pieces and the sheet, in mm."""
    record: dict[str, Any] = {}
    if made.split is not None:
        record["pieces"] = [
            {
                "file": f"piece_{piece.number}.stl",
                "position": np.round(piece.corner, 4).tolist(),
                "size": np.round(piece.size, 4).tolist(),
            }
            for piece in made.split.pieces
        ]
        record["joint_play_mm"] = made.split.play
    if made.sheet is not None:
        record["sheet"] = {
            "size": list(made.sheet.size),
            "kits": [
                {
                    "name": made.sheet.kits[place.kit].name,
                    "position": [place.x, place.y],
                    "turned_deg": 90 if place.turned else 0,
                }
                for place in made.sheet.places
            ],
        }
    return record
