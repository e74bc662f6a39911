"""Measures, during an episode, how much of its limits an arm uses, and whether its links touch
anything."""

from __future__ import annotations

import dataclasses

import numpy as np
from numpy.typing import NDArray
from pydrake.geometry import GeometryId
from pydrake.multibody.plant import ContactResults, MultibodyPlant
from pydrake.multibody.tree import BodyIndex
from pydrake.systems.framework import Context

from kitting_drake.scenario.robots import FrankaArm
from kitting_drake.station import KittingStation
from kitting_drake.station.robot import ARM, HAND
from systems.arm_limits import ARM_LIMITS, JOINTS, limits_used

_PALM = "hand"
"""Name of the hand's body that carries the fingers."""


@dataclasses.dataclass
class ArmUse:
    """How much of its limits an arm used. The field names are keys of `results.json`.

    Each number is the largest share over all joints and steps: 1 stands for the limit.
    """

    position: float = 0.0
    """Distance from the middle of a joint's range, commanded or measured; its limit is half the
    range."""
    velocity: float = 0.0
    """Commanded velocity. Limits that depend on the position are taken at the commanded one."""
    acceleration: float = 0.0
    """Commanded acceleration."""
    jerk: float = 0.0
    """Change of the commanded acceleration in a step, divided by the step."""
    torque: float = 0.0
    """Torque of a joint's drive."""
    collisions: list[str] = dataclasses.field(default_factory=list)
    """The pairs of bodies of which one is a link of the arm or the palm. The fingers are meant to
    touch things and do not count."""


class ArmUseMeter:
    """Samples the arm of a station. `sample` must be called after every step."""

    def __init__(self, station: KittingStation) -> None:
        """
        Args:
            station: a station with an arm.

        Raises:
            ValueError: the station has no arm.
        """
        robot = station.scenario.robot
        if not isinstance(robot, FrankaArm):
            raise ValueError("the station has no arm")
        self._station, self._limits = station, ARM_LIMITS[robot.model]
        plant = station.plant
        self._names = _collision_names(plant)
        self._ports = [station.GetOutputPort(name) for name in ("commanded", "robot_state")]
        arm = plant.GetModelInstanceByName(ARM)
        self._torque = plant.get_net_actuation_output_port(arm)
        self._contact_torque = plant.get_generalized_contact_forces_output_port(arm)
        self._contacts = plant.get_contact_results_output_port()
        self._samples: list[tuple[float, NDArray, NDArray, NDArray]] = []
        self._collisions: dict[str, None] = {}

    def sample(self, root_context: Context) -> None:
        """Reads the arm's state, its targets, its torques and the contacts, in the context of the
        outermost Diagram."""
        context = self._station.GetMyContextFromRoot(root_context)
        plant_context = self._station.plant.GetMyContextFromRoot(root_context)
        desired, state = (port.Eval(context) for port in self._ports)
        torque = self._torque.Eval(plant_context)
        self._samples.append((root_context.get_time(), desired, state[:JOINTS], torque))
        # The contact results take long to compute, so do it only if something touches the arm.
        if self._contact_torque.Eval(plant_context).any():
            for pair in self._touching(self._contacts.Eval(plant_context)):
                self._collisions.setdefault(pair)

    def result(self) -> ArmUse:
        """The largest shares and all collisions so far."""
        samples = np.array([np.hstack(sample) for sample in self._samples])
        samples = samples.reshape(-1, 1 + 5 * JOINTS)
        # After a pause, the first sample is a repetition.
        samples = samples[np.unique(samples[:, 0], return_index=True)[1], 1:]
        desired, measured, torque = np.split(samples, [3 * JOINTS, 4 * JOINTS], axis=1)
        limits = self._limits
        lower, upper = np.array(limits.lower), np.array(limits.upper)
        shares = dict(limits_used(desired, limits, 1 / self._station.plant.time_step()))
        away = abs(2 * (measured - lower) / (upper - lower) - 1).max(initial=0)
        return ArmUse(
            **shares | {"position": max(shares["position"], float(away))},
            torque=float((abs(torque) / limits.torque).max(initial=0)),
            collisions=list(self._collisions),
        )

    def _touching(self, contacts: ContactResults) -> list[str]:
        found = []
        for index in range(contacts.num_hydroelastic_contacts()):
            surface = contacts.hydroelastic_contact_info(index).contact_surface()
            found.append((self._names[surface.id_M()], self._names[surface.id_N()]))
        return [
            " and ".join(sorted((one[0], other[0]))) for one, other in found if one[1] or other[1]
        ]


def _collision_names(plant: MultibodyPlant) -> dict[GeometryId, tuple[str, bool]]:
    """For each collision geometry, the name of its body and whether the body is a link of the arm
    or the palm."""
    names = {}
    for index in range(plant.num_bodies()):
        body = plant.get_body(BodyIndex(index))
        model = plant.GetModelInstanceName(body.model_instance())
        is_link = model == ARM or (model == HAND and body.name() == _PALM)
        name = body.name() if model in (ARM, HAND) else model
        for geometry in plant.GetCollisionGeometriesForBody(body):
            names[geometry] = name, is_link
    return names
