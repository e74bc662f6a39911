"""Tools with another size or mass; section IV-B.2 of the paper scales a toolset's tools at random.

A uniform scale s at constant density multiplies all lengths by s, the mass by s^3 and the moments
of inertia by s^5.
"""

import dataclasses
import hashlib
import math
import xml.etree.ElementTree as ElementTree
from pathlib import Path

from kitting_drake.common.cached_folder import cached_folder
from kitting_drake.common.errors import UserError
from kitting_drake.common.paths import cache_directory
from kitting_drake.common.sdformat import model_text
from kitting_drake.hkd.tools.tool import Tool
from systems.grasp import Grasp
from systems.grip_force import GRAVITY
from systems.hand_geometry import MAX_OPENING

_FORMAT_VERSION = "1"
"""The version of the files in the cache. Increase it if a change of the code changes the files."""
_SAME_LENGTH = 1e-9
_EASY_MOMENT = 0.2
"""The grip easily withstands this moment about the axis through both pads, in N m."""
_WIDEST = MAX_OPENING - 0.015
"""The largest width of the `other_grasps` of a scaled tool, in metres; wider ones are dropped."""

_DRAKE = "http://drake.mit.edu"


def scaled_tool(tool: Tool, length: float) -> Tool:
    """Scales a tool uniformly to a length in metres; a tool of this length is returned unchanged.

    The scaled tool has its own SDFormat file in the cache, which scales the original's meshes. The
    mass and the grasps are scaled, too; `other_grasps` that become too wide are dropped.

    Raises:
        UserError: the length is not positive, the model cannot be scaled, or the cache cannot be
            written.
    """
    if not 0.0 < length < float("inf"):
        raise UserError(
            f"the tool '{tool.name}' cannot be scaled to a length of {length:g} m: give a positive "
            "length"
        )
    if abs(length - tool.length) <= _SAME_LENGTH:
        return tool
    factor = length / tool.length
    grasp, *others = (
        dataclasses.replace(
            grasp,
            x=factor * grasp.x,
            y=factor * grasp.y,
            width=factor * grasp.width,
            surface_height=factor * grasp.surface_height,
        )
        for grasp in tool.grasps
    )
    return dataclasses.replace(
        tool,
        directory=_scaled_model(tool, factor),
        length=length,
        width=factor * tool.width,
        height=factor * tool.height,
        mass=factor**3 * tool.mass,
        grasp=grasp,
        other_grasps=tuple(item for item in others if item.width <= _WIDEST),
        scale=factor * tool.scale,
    )


def weighted_tool(tool: Tool, mass: float) -> Tool:
    """Gives a tool a mass in kg; returns the tool unchanged if it already has this mass.

    The distribution of the mass stays the same. The contact stiffness changes with the mass, so
    that the tool rests as before. Grasps in which the tool would turn between the pads come last.

    Raises:
        UserError: the mass is not positive, the model is not valid, or the cache cannot be written.
    """
    if not 0.0 < mass < float("inf"):
        raise UserError(
            f"the tool '{tool.name}' cannot have a mass of {mass:g} kg: give a positive mass"
        )
    if mass == tool.mass:
        return tool
    text = model_text(tool.sdf, mass=mass / tool.mass)
    assert text is not None
    root = ElementTree.fromstring(text)
    for modulus in root.iter(f"{{{_DRAKE}}}hydroelastic_modulus"):
        _scale_numbers(modulus, [mass / tool.mass])
    text = '<?xml version="1.0"?>\n' + ElementTree.tostring(root, encoding="unicode") + "\n"
    key = f"{_FORMAT_VERSION} mass {text}".encode()
    folder = cached_folder(
        cache_directory() / "tools" / hashlib.sha256(key).hexdigest()[:24],
        [tool.sdf.name],
        lambda made: (made / tool.sdf.name).write_text(text),
    )
    grasp, *others = sorted(tool.grasps, key=lambda item: _excess_moment(item, root, mass))
    return dataclasses.replace(
        tool, directory=folder, mass=mass, grasp=grasp, other_grasps=tuple(others)
    )


def _excess_moment(grasp: Grasp, root: ElementTree.Element, mass: float) -> float:
    """Returns by how much the weight's moment about the pads exceeds `_EASY_MOMENT`, in N m; zero
    if it does not."""
    pose = root.findtext(".//inertial/pose") or "0 0"
    x, y, *_ = map(float, pose.split())
    lever = (x - grasp.x) * math.cos(grasp.theta) + (y - grasp.y) * math.sin(grasp.theta)
    return max(GRAVITY * mass * abs(lever) - _EASY_MOMENT, 0.0)


def _scaled_model(tool: Tool, factor: float) -> Path:
    """Returns the folder in the cache that has the SDFormat file of a scaled tool."""
    original = tool.sdf.read_bytes()
    key = f"{_FORMAT_VERSION} {tool.sdf.resolve()} {factor!r}".encode()
    name = hashlib.sha256(key + original).hexdigest()[:24]
    try:
        text = scaled_sdf(original.decode(), tool.sdf.resolve().parent, factor)
    except (ElementTree.ParseError, UnicodeDecodeError, ValueError) as error:
        raise UserError(f"{tool.sdf} cannot be scaled: {error}") from error
    return cached_folder(
        cache_directory() / "tools" / name,
        [tool.sdf.name],
        lambda folder: (folder / tool.sdf.name).write_text(text),
    )


def scaled_sdf(text: str, directory: Path, factor: float) -> str:
    """Returns the SDFormat text of a uniformly scaled model. All of its geometry must be meshes.

    Args:
        text: the original text.
        directory: the folder to which the original's relative URIs refer; the result has absolute
            URIs.
        factor: the scale.

    Raises:
        ValueError: the model has geometry other than meshes, or a number is malformed.
        xml.etree.ElementTree.ParseError: the text is not XML.
    """
    ElementTree.register_namespace("drake", _DRAKE)
    root = ElementTree.fromstring(text)
    for geometry in root.iter("geometry"):
        if [child.tag for child in geometry] != ["mesh"]:
            raise ValueError("a geometry must be exactly one mesh")
    for mesh in root.iter("mesh"):
        uri = mesh.find("uri")
        if uri is None or not uri.text:
            raise ValueError("a mesh has no uri")
        if "://" not in uri.text:
            uri.text = str(directory / uri.text)
        scale = mesh.find("scale")
        if scale is None:
            scale = ElementTree.SubElement(mesh, "scale")
        _scale_numbers(scale, [factor] * 3, default="1 1 1")
    for pose in root.iter("pose"):
        _scale_numbers(pose, [factor] * 3 + [1.0] * 3)
    for inertial in root.iter("inertial"):
        for mass in inertial.iter("mass"):
            _scale_numbers(mass, [factor**3])
        for moment in inertial.findall("inertia/*"):
            _scale_numbers(moment, [factor**5])
    return '<?xml version="1.0"?>\n' + ElementTree.tostring(root, encoding="unicode") + "\n"


def _scale_numbers(element: ElementTree.Element, factors: list[float], default: str = "") -> None:
    numbers = [float(word) for word in (element.text or default).split()]
    scaled = [factor * number for factor, number in zip(factors, numbers, strict=True)]
    element.text = " ".join(f"{number:.12g}" for number in scaled)
