"""Releases tools in MuJoCo at the poses at which Drake released them, and compares the outcomes."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from pydrake.common.eigen_geometry import Quaternion
from pydrake.math import RigidTransform
from rich.console import Console
from rich.table import Table

from kitting_drake.common.errors import UserError
from kitting_drake.common.extras import import_extra
from kitting_drake.common.processes import counting_bar
from kitting_drake.episode import ModeChange, run_episode
from kitting_drake.episode.action_log import nearest_object
from kitting_drake.hkd.mjcf import kit_mjcf, tool_mjcf
from kitting_drake.scenario import Scenario
from kitting_drake.scenario.policies import Oracle, QuantizedOracle
from kitting_drake.station import KittingStation, build_station, with_policy
from kitting_drake.tasks import ToolsetKitting
from systems.pick_place_parameters import Mode
from systems.placement import Placement, evaluate_placements

_TIME_STEP = 0.001
_REST = 2.0
"""The time in which a tool falls and comes to rest, in s."""
_CONTACT_TIME = 0.004
"""MuJoCo's time constant of contact, in s. It is short, for stiff contact, but must be at least
twice the time step."""
_FRICTION = 0.375
"""The friction between tool and kit: the harmonic mean of their coefficients 0.5 and 0.3, as in
Drake. MuJoCo would use the larger coefficient."""

_MOST_FRUITLESS = 5
"""The benchmark fails after this many episodes in a row without a release."""


@dataclass(frozen=True)
class Release:
    """A tool at the moment when the jaws begin to open, and the station of its episode."""

    station: KittingStation
    index: int
    """The index of the object in the scene."""
    X_WB: RigidTransform


def ask_mujoco(
    placements: int, seed: int, orientations: int | None, console: Console
) -> dict[str, Any]:
    """Releases tools in MuJoCo at the poses at which oracles release them in Drake.

    The tools are from unseen toolsets. The MuJoCo scene has only the table, the kit and the tool,
    which starts at rest.

    Args:
        placements: the number of releases to compare.
        seed: the seed of the first episode.
        orientations: the number of orientations of a quantized oracle, which misses more often;
            None for the exact oracle.
        console: the console for the progress bar.

    Returns:
        The record of `benchmark mujoco`: the share of equal outcomes, and each placement.

    Raises:
        UserError: the package mujoco is not installed, or the oracle releases nothing.
    """
    mujoco = import_extra("mujoco", purpose="benchmark mujoco", extra="mujoco")
    rows: list[dict[str, Any]] = []
    fruitless = 0
    with counting_bar(console, "placements") as progress:
        bar = progress.add_task("", total=placements)
        while len(rows) < placements:
            witness = _episode(seed, orientations)
            fruitless = 0 if witness.releases else fruitless + 1
            if fruitless == _MOST_FRUITLESS:
                raise UserError(
                    f"no tool was released in {fruitless} episodes: raise --orientations"
                )
            for release in witness.releases.values():
                rows.append(_row(seed, witness, release, _fall(mujoco, release)))
                progress.update(bar, completed=len(rows))
            seed += 1
    rows = rows[:placements]
    counts = {
        key: sum(row["here"][key] == row["mujoco"][key] for row in rows) / len(rows)
        for key in ("success", "strict_success")
    }
    return {
        "placements": len(rows),
        "policy": "oracle" if orientations is None else f"quantized oracle, N = {orientations}",
        "mujoco": mujoco.__version__,
        "time_step": _TIME_STEP,
        "equal_success": counts["success"],
        "equal_strict_success": counts["strict_success"],
        "rows": rows,
    }


class _Witness:
    """An `EpisodeObserver` that records where tools are released, and where they end."""

    def __init__(self, station: KittingStation) -> None:
        self._station = station
        self.releases: dict[int, Release] = {}
        """The last release of each object, by its index."""
        self.final_poses: list[RigidTransform] = []
        self.placements: list[Placement] = []

    def observe(self, event: ModeChange) -> None:
        """Records a release, or the end of the episode."""
        station = self._station
        poses = station.object_poses(event.root_context)
        if event.is_last:
            self.final_poses, self.placements = poses, station.placements(event.root_context)
        elif event.mode == Mode.RELEASE:
            action = station.accepted_action(event.root_context)
            index = nearest_object(station, poses, action.place)
            self.releases[index] = Release(station, index, poses[index])


def _episode(seed: int, orientations: int | None) -> _Witness:
    """Runs an oracle, which needs no cameras, on an unseen toolset."""
    policy = Oracle() if orientations is None else QuantizedOracle(orientations=orientations)
    scenario = Scenario(task=ToolsetKitting(split="test"), policy=policy, cameras={})
    station = build_station(scenario, seed)
    diagram = with_policy(station)
    witness = _Witness(station)
    run_episode(
        diagram, station, scenario="unseen", policy=policy.name, observers=[witness.observe]
    )
    return witness


def _row(seed: int, witness: _Witness, release: Release, X_WB: RigidTransform) -> dict[str, Any]:
    """Compares a placement in Drake with the object's pose X_WB in MuJoCo.

    The pose in MuJoCo is scored with all other objects at their final poses in Drake.
    """
    station, index = release.station, release.index
    poses = list(witness.final_poses)
    poses[index] = X_WB
    scene = station.scene
    theirs = evaluate_placements(station.objects, scene.goals, scene.success, poses)[index]
    ours = witness.final_poses[index]
    apart = np.linalg.norm(
        X_WB @ station.objects[index].p_BMiddle - ours @ station.objects[index].p_BMiddle
    )
    return {
        "seed": seed,
        "object": scene.objects[index].name,
        "here": _verdict(witness.placements[index]),
        "mujoco": _verdict(theirs),
        "apart_mm": 1e3 * float(apart),
    }


def _verdict(placement: Placement) -> dict[str, Any]:
    return {
        "success": placement.success,
        "strict_success": placement.strict_success,
        "add_s_mm": 1e3 * placement.add_s,
        "height_error_mm": 1e3 * placement.height_error,
    }


def _fall(mujoco: Any, release: Release) -> RigidTransform:
    """Lets a released tool fall in MuJoCo; returns its pose X_WB at rest."""
    scene = release.station.scene
    item = scene.objects[release.index]
    world = mujoco.MjSpec()
    world.option.timestep = _TIME_STEP
    world.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    world.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_PLANE, size=[2, 2, 0.1])
    for number, fixture in enumerate(scene.fixtures):
        kit = _spec(mujoco, kit_mjcf(fixture.model), fixture.model.parent)
        for geom in kit.geoms:
            # Give the kit priority, so that its friction is used instead of the tool's.
            geom.priority, geom.friction[0] = 1, _FRICTION
        _attach(world, kit, fixture.X_WF, f"fixture_{number}_")
    tool = _spec(mujoco, tool_mjcf(item.model), item.model.parent)
    _attach(world, tool, release.X_WB, "tool_")
    for geom in world.geoms:
        geom.solref[0] = _CONTACT_TIME
    model = world.compile()
    data = mujoco.MjData(model)
    for _ in range(round(_REST / _TIME_STEP)):
        mujoco.mj_step(model, data)
    quaternion = data.qpos[3:7] / np.linalg.norm(data.qpos[3:7])
    return RigidTransform(Quaternion(quaternion), data.qpos[:3])


def _spec(mujoco: Any, text: str, folder: Path) -> Any:
    spec = mujoco.MjSpec.from_string(text)
    spec.meshdir = str(folder)
    return spec


def _attach(world: Any, spec: Any, X_WF: RigidTransform, prefix: str) -> None:
    """Attaches a model to the world, with its frame F at X_WF."""
    quaternion = X_WF.rotation().ToQuaternion().wxyz()
    frame = world.worldbody.add_frame(pos=X_WF.translation(), quat=quaternion)
    world.attach(spec, prefix=prefix, frame=frame)


def opinion_table(measured: dict[str, Any]) -> Table:
    """Makes a table of the outcomes in Drake and in MuJoCo."""
    table = Table(title=f"{measured['placements']} placements of the {measured['policy']}")
    for heading in ("measure", "yes here", "yes in MuJoCo", "alike"):
        table.add_column(heading, justify="left" if heading == "measure" else "right")
    rows = measured["rows"]
    for key, name in (("success", "ADD-S"), ("strict_success", "strict")):
        counts = [str(sum(row[where][key] for row in rows)) for where in ("here", "mujoco")]
        table.add_row(name, *counts, f"{100 * measured[f'equal_{key}']:.0f} %")
    apart = np.median([row["apart_mm"] for row in rows])
    table.caption = f"they come to rest {apart:.2f} mm apart (median)"
    return table
