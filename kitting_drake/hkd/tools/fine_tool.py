"""Tools whose collision geometry suits cavities with little clearance."""

import copy
import dataclasses
import hashlib
import json
import math
import xml.etree.ElementTree as ElementTree
from pathlib import Path

from kitting_drake.common.cached_folder import cached_folder
from kitting_drake.common.errors import UserError
from kitting_drake.common.paths import cache_directory
from kitting_drake.hkd.tools.fine_hulls import INSIDE_MM, NOTCH_MM, fine_hulls
from kitting_drake.hkd.tools.meshes import write_convex_obj
from kitting_drake.hkd.tools.tool import Tool

_FORMAT_VERSION = "3"
"""The version of the files in the cache. Increase it if a change of the code changes the files."""
_STIFFER = 25.0
"""The factor by which the hydroelastic modulus is increased. It keeps the kit's walls from sinking
into the tool by more than the clearance."""
_LIST = "hulls.json"
_DRAKE = "http://drake.mit.edu"


def fine_tool(tool: Tool, closing_radius: float) -> Tool:
    """Returns a tool with finer and stiffer collision hulls (see `fine_hulls`).

    The model is in the cache. All other properties of the tool are unchanged.

    Args:
        tool: the tool; it may be scaled and have another mass.
        closing_radius: half the width, in metres, of the notches that the cavity bridges.

    Raises:
        UserError: the tool's surface is not closed, its model is not valid, or the cache cannot be
            written.
    """
    # Make the hulls at the original size, so that randomly scaled tools share them. Round the scale
    # up to a power of sqrt(2), and divide the tolerances by it.
    finer = 2.0 ** (math.ceil(2 * math.log2(tool.scale) - 1e-9) / 2)
    notch = min(NOTCH_MM, 1e3 * closing_radius) / finer
    hulls = _hulls(tool, notch, INSIDE_MM / finer)
    try:
        text = _with_hulls(tool, hulls)
    except (ElementTree.ParseError, OSError, UnicodeDecodeError, ValueError) as error:
        raise UserError(f"{tool.sdf} cannot have finer collision hulls: {error}") from error
    folder = cached_folder(
        cache_directory() / "tools" / _digest(f"fine {text}".encode()),
        [tool.sdf.name],
        lambda made: (made / tool.sdf.name).write_text(text),
    )
    return dataclasses.replace(tool, directory=folder)


def _hulls(tool: Tool, notch: float, inside: float) -> list[Path]:
    """Returns the OBJ files of a tool's fine hulls, at the size of the tool's mesh files."""
    meshes = b"".join(path.read_bytes() for path in tool.visual_meshes)

    def write(folder: Path) -> None:
        parts = [1e3 / tool.scale * triangles for _, triangles in tool.parts]
        names = []
        for number, hull in enumerate(fine_hulls(parts, notch, inside)):
            names.append(f"fine_{number}.obj")
            write_convex_obj(folder / names[-1], hull)
        (folder / _LIST).write_text(json.dumps(names))

    try:
        folder = cached_folder(
            cache_directory() / "tools" / _digest(f"hulls {notch} {inside}".encode() + meshes),
            [_LIST],
            write,
        )
    except ValueError as error:
        raise UserError(
            f"the tool '{tool.name}' cannot have fine collision hulls: {error}; import its mesh "
            "again"
        ) from error
    return [folder / name for name in json.loads((folder / _LIST).read_text())]


def _digest(content: bytes) -> str:
    return hashlib.sha256(_FORMAT_VERSION.encode() + content).hexdigest()[:24]


def _with_hulls(tool: Tool, hulls: list[Path]) -> str:
    """Returns the tool's SDFormat text with the given collision hulls."""
    ElementTree.register_namespace("drake", _DRAKE)
    root = ElementTree.fromstring(tool.sdf.read_text())
    for mesh in root.iter("mesh"):
        uri = mesh.find("uri")
        if uri is not None and uri.text and "://" not in uri.text:
            uri.text = str(tool.sdf.resolve().parent / uri.text)
    link = root.find(".//link")
    coarse = [] if link is None else link.findall("collision")
    if link is None or not coarse:
        raise ValueError("it has no link with collision geometry")
    for collision in coarse:
        link.remove(collision)
    for modulus in coarse[0].iter(f"{{{_DRAKE}}}hydroelastic_modulus"):
        modulus.text = f"{_STIFFER * float(modulus.text or ''):.9g}"
    for path in hulls:
        collision = copy.deepcopy(coarse[0])
        collision.set("name", path.stem)
        geometry = collision.find("geometry")
        if geometry is None:
            raise ValueError("a collision has no geometry")
        geometry.clear()
        mesh = ElementTree.SubElement(geometry, "mesh")
        ElementTree.SubElement(mesh, "uri").text = str(path)
        ElementTree.SubElement(mesh, "scale").text = " ".join([f"{tool.scale:.12g}"] * 3)
        ElementTree.SubElement(mesh, f"{{{_DRAKE}}}declare_convex")
        link.append(collision)
    return '<?xml version="1.0"?>\n' + ElementTree.tostring(root, encoding="unicode") + "\n"
