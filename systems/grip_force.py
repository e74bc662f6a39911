"""The force of the pads, chosen by the weight that the hand feels."""

import numpy as np

from systems.pick_place_parameters import PickPlaceParameters

GRAVITY = 9.81
"""Acceleration of gravity, in m/s^2."""

_TOO_EARLY = 1.5
"""If the grip force should be more than this factor larger, the object is not lifted until it is.
"""
_EASY_MOMENT = 0.18
"""A moment about the axis of the pads that friction holds easily, in N m."""
_INDULGENCE = 0.5
"""Each time an object was set down again, the allowed moment grows by this share."""
_LONGEST_LEVER = 0.12
"""Largest plausible distance of a centre of mass from the pads' middle, in m."""
_LEAST_CHANGE = 1.05
"""The force rises only in steps of at least this factor, so that noise does not restart its
ramp."""


def felt_weight(contact_force: float, acceleration: float) -> float:
    """The weight of the object in the hand, in N.

    Args:
        contact_force: the vertical contact force on the hand, in N; negative for a load.
        acceleration: the hand's vertical acceleration, in m/s^2.
    """
    # The hand never falls freely, but unusual parameters must not cause a division by zero.
    return -contact_force / max(1 + acceleration / GRAVITY, 0.1)


def grip_force(weight: float, present: float, parameters: PickPlaceParameters) -> float:
    """The force of each pad on an object of a given weight, in N.

    It is proportional to the weight up to `firm_grasp_force` at `heavy_load`, but at least
    `grasp_force`. Beyond `heavy_load` it rises linearly to `peak_grasp_force` at `heaviest_load`.
    The force never falls while the object is held: with less force, an object that has begun to
    turn between the pads would turn further.

    Args:
        weight: the weight that the hand feels, in N.
        present: the present force of each pad, in N.
        parameters: the forces and loads.
    """
    heavy, heaviest = parameters.heavy_load, max(parameters.heaviest_load, parameters.heavy_load)
    firm = max(parameters.firm_grasp_force, parameters.grasp_force)
    peak = max(parameters.peak_grasp_force, firm)
    force = float(
        np.interp(
            weight,
            [heavy * parameters.grasp_force / firm, heavy, heaviest],
            [parameters.grasp_force, firm, peak],
        )
    )
    return force if force > _LEAST_CHANGE * present or force == peak > present else present


def moment_at_rest(moment: float, acceleration: float) -> float:
    """The moment about the axis of the pads that the object would exert at rest, in N m.

    An upward acceleration increases the felt moment, and is corrected for. While the hand brakes,
    it lags behind its command, so no correction is made.

    Args:
        moment: the moment felt at the wrist, in N m.
        acceleration: the hand's vertical acceleration, in m/s^2.
    """
    return moment / max(1 + acceleration / GRAVITY, 1.0)


def felt_lever(moment: float, weight: float) -> float:
    """Position of the object's centre of mass relative to the pads' middle, along the hand's x
    axis, in m.

    The estimate also holds while one end of the object rests on the table, because moment and
    weight are then reduced together.

    Args:
        moment: moment about the axis of the pads while the hand rests, in N m.
        weight: the result of `felt_weight`, in N.
    """
    return min(max(moment / max(weight, 1e-3), -_LONGEST_LEVER), _LONGEST_LEVER)


def turns_in_the_pads(moment: float, times: float) -> bool:
    """Whether an object turns between the pads, or is about to.

    Args:
        moment: moment about the axis of the pads while the hand rests, in N m.
        times: how often this object was set down because it turned. Each time, a larger moment is
            allowed, so that the attempts end.
    """
    return abs(moment) > _EASY_MOMENT * (1 + _INDULGENCE * times)


def lifts_too_early(wanted: float, present: float) -> bool:
    """Whether the pads press far less than they should, so that the object would turn between them.

    Args:
        wanted: the result of `grip_force`, in N.
        present: the force of the pads now, in N.
    """
    return wanted > _TOO_EARLY * present
