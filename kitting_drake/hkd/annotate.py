"""A Meshcat page on which a user moves a gripper over a tool and saves a grasp.

The command `hkd annotate NAME` serves the page.
"""

import dataclasses
import math
import re
import time
from pathlib import Path

import numpy as np
import yaml
from pydrake.geometry import Box, Mesh, Meshcat, MeshcatParams, Rgba, Sphere
from pydrake.math import RigidTransform, RollPitchYaw
from rich.console import Console
from rich.table import Table

from kitting_drake.common.errors import UserError
from kitting_drake.common.files import write_atomically
from kitting_drake.common.paths import MODELS
from kitting_drake.hkd.generation.catalogue import load_catalogue
from kitting_drake.hkd.generation.generate import generate_tool
from kitting_drake.hkd.grasps.grip import find_grip, jaw_axes
from kitting_drake.hkd.grasps.holds import WIDEST
from kitting_drake.hkd.grasps.proposals import (
    FLOOR_CLEARANCE,
    GRASP_DEPTH,
    GraspProposal,
    propose_grasps,
)
from kitting_drake.hkd.tools.tool import Tool, load_tool
from systems.grasp import Grasp
from systems.hand_geometry import FINGER_BASE_DISTANCE, FINGERTIP_DISTANCE, PAD_LENGTH

_HAND_MESHES = MODELS / "franka_hand" / "meshes"


def measure_grasp(tool: Tool, x: float, y: float, theta: float) -> Grasp | None:
    """Measures the grasp that results when the jaws close at a given pose.

    Args:
        tool: the tool; T is its frame.
        x: the x of the middle of the pads in T, in metres.
        y: the y of the middle of the pads in T, in metres. Closing jaws centre the tool, so only
            the component of (x, y) along the pads matters.
        theta: the rotation of the hand about T's z, in radians.

    Returns:
        The grasp, centred between the gripped faces; None if nothing is between the pads.
    """
    grip = find_grip(tool.triangles, x, y, theta, PAD_LENGTH)
    if grip is None:
        return None
    _, across = jaw_axes(theta)
    centre = np.array([x, y]) + grip.middle * across
    return Grasp(
        x=float(centre[0]),
        y=float(centre[1]),
        theta=theta,
        width=grip.width,
        surface_height=grip.top,
    )


def save_grasp(tool: Tool, grasp: Grasp, models: Path = MODELS) -> None:
    """Saves a grasp as the annotated grasp of a tool.

    If the tool is in the catalogue, the catalogue is changed and the tool is generated again.
    Otherwise, the grasp is written to the tool's record, `tool.yaml`.

    Args:
        tool: the tool.
        grasp: the grasp in the tool's frame T.
        models: the folder with the catalogue in `tools/`.

    Raises:
        UserError: the tool is too wide for the jaws at the grasp, or the generator rejects the
            grasp. Nothing is changed then.
    """
    if grasp.width > WIDEST:
        raise UserError(
            f"the tool is {1e3 * grasp.width:.0f} mm wide at this place, but the jaws hold at most "
            f"{1e3 * WIDEST:.0f} mm: grasp it where it is narrower"
        )
    if tool.directory.parent != models / "tools":
        record_path = tool.directory / "tool.yaml"
        record = yaml.safe_load(record_path.read_text())
        record["grasp"] = {key: round(value, 6) for key, value in dataclasses.asdict(grasp).items()}
        # Drop the other grasps: they were chosen to complement the previous annotated grasp.
        record.pop("other_grasps", None)
        # Mark the grasp, so that a repeated import does not overwrite it.
        record["annotated"] = True
        write_atomically(record_path, yaml.safe_dump(record, sort_keys=False))
        return
    path = models / "tools" / "catalogue.yaml"
    before = path.read_text()
    write_atomically(path, with_grasp(before, tool.name, grasp))
    try:
        entry = next(entry for entry in load_catalogue(path) if entry.name == tool.name)
        generate_tool(entry, tool.directory)
    except UserError:
        write_atomically(path, before)
        raise


def with_grasp(catalogue: str, name: str, grasp: Grasp) -> str:
    """Returns the catalogue's text with a new grasp for one tool, and all else unchanged.

    Raises:
        UserError: the catalogue has no such tool, or its grasp is not on one line.
    """
    entry = re.compile(
        rf"(^  - name: {re.escape(name)}\n(?:(?!  - name:).*\n)*?    grasp: )\{{.*\}}", re.M
    )
    text = (
        f"{{x_mm: {1e3 * grasp.x:.2f}, y_mm: {1e3 * grasp.y:.2f}, "
        f"theta_deg: {math.degrees(grasp.theta):.1f}}}"
    )
    changed, count = entry.subn(lambda match: match[1] + text, catalogue)
    if count != 1:
        raise UserError(
            f"the catalogue has no tool '{name}', or its grasp is not on one line, as in "
            "grasp: {x_mm: 0, y_mm: 0, theta_deg: 0}"
        )
    return changed


class AnnotationPage:
    """The page with the tool, the hand above it, sliders and buttons.

    The sliders move the hand. The slider "proposal" selects a proposed grasp, and the button "take
    proposal" moves the hand to it.
    """

    def __init__(self, tool: Tool, proposals: list[GraspProposal], meshcat: Meshcat) -> None:
        """Opens the page.

        Args:
            tool: the tool to annotate.
            proposals: the proposed grasps, best first.
            meshcat: the server of the page.
        """
        self._tool = tool
        self._proposals = proposals
        self._meshcat = meshcat
        self._shown: tuple[float, ...] | None = None
        self._draw_tool()
        if proposals:
            meshcat.AddSlider("proposal", 1, len(proposals), 1, 1)
            meshcat.AddButton("take proposal")
        half_length, half_width = 500 * tool.length, 500 * tool.width
        meshcat.AddSlider("x, mm", -half_length, half_length, 0.25, 1e3 * tool.grasp.x)
        meshcat.AddSlider("y, mm", -half_width, half_width, 0.25, 1e3 * tool.grasp.y)
        theta = math.degrees(math.remainder(tool.grasp.theta, math.pi))
        meshcat.AddSlider("rotation, deg", -90, 90, 0.5, theta)
        meshcat.AddButton("save")
        meshcat.AddButton("done")
        self._taken = 0
        self.refresh()

    @property
    def grasp(self) -> Grasp | None:
        """The grasp at the sliders' pose; None if nothing is between the pads."""
        x, y, theta_deg = (
            self._meshcat.GetSliderValue(name) for name in ("x, mm", "y, mm", "rotation, deg")
        )
        return measure_grasp(self._tool, 1e-3 * x, 1e-3 * y, math.radians(theta_deg))

    def clicks(self, button: str) -> int:
        """The number of clicks on a button."""
        return int(self._meshcat.GetButtonClicks(button))

    def refresh(self) -> None:
        """Draws the hand at the sliders' pose.

        If "take proposal" was clicked, first sets the sliders to the selected proposal.
        """
        if self._proposals and self.clicks("take proposal") != self._taken:
            self._taken = self.clicks("take proposal")
            chosen = self._proposals[round(self._meshcat.GetSliderValue("proposal")) - 1]
            self._meshcat.SetSliderValue("x, mm", 1e3 * chosen.x)
            self._meshcat.SetSliderValue("y, mm", 1e3 * chosen.y)
            theta = math.degrees(math.remainder(chosen.theta, math.pi))
            self._meshcat.SetSliderValue("rotation, deg", theta)
        values = tuple(
            self._meshcat.GetSliderValue(name) for name in ("x, mm", "y, mm", "rotation, deg")
        )
        if values != self._shown:
            self._shown = values
            self._draw_hand()

    def _draw_tool(self) -> None:
        meshcat, tool = self._meshcat, self._tool
        meshcat.SetProperty("/Background", "top_color", [0.93, 0.95, 0.97])
        meshcat.SetProperty("/Background", "bottom_color", [0.80, 0.83, 0.86])
        meshcat.SetProperty("/Axes", "visible", False)
        meshcat.SetProperty("/Grid", "visible", False)
        meshcat.SetObject("table", Box(0.4, 0.3, 0.01), Rgba(0.46, 0.48, 0.50))
        meshcat.SetTransform("table", RigidTransform([0, 0, -0.005]))
        for path, rgba in zip(tool.visual_meshes, _colours(tool), strict=True):
            meshcat.SetObject(f"tool/{path.stem}", Mesh(path), rgba)
        for rank, proposal in enumerate(self._proposals):
            # Draw the best proposal in green and the worst in red.
            share = rank / max(len(self._proposals) - 1, 1)
            path_name = f"proposals/{rank + 1}"
            meshcat.SetObject(path_name, Sphere(0.002), Rgba(share, 1 - share, 0.1))
            height = proposal.surface_height + 0.004
            meshcat.SetTransform(path_name, RigidTransform([proposal.x, proposal.y, height]))
        for side in ("left", "right"):
            meshcat.SetObject(
                f"hand/{side}", Mesh(_HAND_MESHES / "finger.obj"), Rgba(0.18, 0.18, 0.19)
            )
        meshcat.SetObject("hand/palm", Mesh(_HAND_MESHES / "hand.obj"), Rgba(0.9, 0.91, 0.92, 0.2))
        meshcat.SetCameraPose([0.03, -0.2, 0.17], [0.0, 0.0, 0.02])

    def _draw_hand(self) -> None:
        grasp = self.grasp
        self._meshcat.SetProperty("hand", "visible", grasp is not None)
        if grasp is None:
            return
        tips = max(grasp.surface_height - GRASP_DEPTH, FLOOR_CLEARANCE)
        X_THand = RigidTransform(
            RollPitchYaw(math.pi, 0, grasp.theta), [grasp.x, grasp.y, tips + FINGERTIP_DISTANCE]
        )
        self._meshcat.SetTransform("hand", X_THand)
        for side, yaw in (("left", 0.0), ("right", math.pi)):
            X_HandFinger = RigidTransform(RollPitchYaw(0, 0, yaw), [0, 0, FINGER_BASE_DISTANCE])
            opened = RigidTransform([0, grasp.width / 2, 0])
            self._meshcat.SetTransform(f"hand/{side}", X_HandFinger @ opened)


def _colours(tool: Tool) -> list[Rgba]:
    """Returns the colour of each visual mesh in the SDFormat model."""
    text = tool.sdf.read_text()
    colours = []
    for path in tool.visual_meshes:
        found = re.search(rf"{re.escape(path.name)}</uri>.*?<diffuse>(.*?)</diffuse>", text, re.S)
        colours.append(Rgba(*map(float, found[1].split())) if found else Rgba(0.6, 0.6, 0.6))
    return colours


def proposal_table(tool: Tool, proposals: list[GraspProposal]) -> Table:
    """Makes a table of the ranked proposals and the tool's annotated grasp."""
    table = Table(title=f"grasps of {tool.name}, best first", title_justify="left")
    for heading in (
        "rank",
        "x mm",
        "y mm",
        "rotation deg",
        "width mm",
        "mm from centre of mass",
        "cost",
    ):
        table.add_column(heading, justify="right")
    for rank, proposal in enumerate(proposals, start=1):
        table.add_row(
            str(rank), *_numbers(proposal), f"{1e3 * proposal.offset:.1f}", f"{proposal.cost:.2f}"
        )
    table.add_section()
    table.add_row("now", *_numbers(tool.grasp), "", "")
    return table


def _numbers(grasp: Grasp) -> list[str]:
    theta = math.degrees(math.remainder(grasp.theta, math.pi))
    return [
        f"{1e3 * grasp.x:.1f}",
        f"{1e3 * grasp.y:.1f}",
        f"{theta:.1f}",
        f"{1e3 * grasp.width:.1f}",
    ]


def annotate(name: str, console: Console) -> None:
    """Serves the page on localhost until the user clicks "done" or presses Ctrl-C.

    Raises:
        UserError: the tool does not exist, or no port is free.
    """
    tool = load_tool(name)
    path = tool.directory / "tool.yaml"
    com = yaml.safe_load(path.read_text()).get("center_of_mass")
    if not isinstance(com, list) or len(com) != 3:
        raise UserError(f"{path}: center_of_mass must be three numbers; import the tool again")
    proposals = propose_grasps(tool.triangles, np.array(com, dtype=float))
    console.print(proposal_table(tool, proposals))
    try:
        meshcat = Meshcat(MeshcatParams(host="localhost", show_stats_plot=False))
    except RuntimeError as error:
        raise UserError(
            "Meshcat found no free port from 7000 to 7099: stop other programs that use Meshcat"
        ) from error
    page = AnnotationPage(tool, proposals, meshcat)
    console.print(
        f"annotate at {meshcat.web_url()}: open the controls, move the hand, and save",
        highlight=False,
    )
    saved = 0
    while not page.clicks("done"):
        page.refresh()
        if page.clicks("save") != saved:
            saved = page.clicks("save")
            _save_and_tell(tool, page.grasp, console)
        time.sleep(0.05)


def _save_and_tell(tool: Tool, grasp: Grasp | None, console: Console) -> None:
    if grasp is None:
        console.print("not saved: there is nothing between the pads")
        return
    try:
        save_grasp(tool, grasp)
    except UserError as error:
        console.print(f"not saved: {error}")
    else:
        console.print(f"saved: {', '.join(_numbers(grasp))} (x, y, rotation, width; mm, deg)")
