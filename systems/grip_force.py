"""The force of the pads, chosen by the weight that the hand feels."""

import numpy as np

from systems.pick_place_parameters import PickPlaceParameters

GRAVITY = 9.81
"""In m/s^2."""

_TOO_EARLY = 1.5
"""A grip that is weaker than it should be by this factor must be firm before the object is lifted.
"""
_EASY_MOMENT = 0.18
"""A moment about the axis of the pads that they hold easily, in N m."""
_INDULGENCE = 0.5
"""After an object was set down, this much more is allowed, as a share, for each time."""
_LONGEST_LEVER = 0.12
"""In m."""
_LEAST_CHANGE = 1.05
"""The force rises in steps of at least this factor, so that its ramp is not restarted for noise."""


def felt_weight(contact_force: float, acceleration: float) -> float:
    """The weight of what the hand holds, in N.

    Args:
        contact_force: the vertical contact force on the hand, in N; negative for a load.
        acceleration: the hand's vertical acceleration, in m/s^2.
    """
    # The hand never falls freely, but an odd parameter must not divide by zero.
    return -contact_force / max(1 + acceleration / GRAVITY, 0.1)


def grip_force(weight: float, present: float, parameters: PickPlaceParameters) -> float:
    """The force of each pad on an object of a given weight, in N.

    It is proportional to the weight up to `firm_grasp_force` at `heavy_load`, but at least
    `grasp_force`. Above, it rises linearly to `peak_grasp_force` at `heaviest_load`. It never
    falls while the object is held: what has begun to turn between the pads must not go on.

    Args:
        weight: what the hand feels, in N.
        present: the present force, in N.
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
    """The moment about the axis of the pads without the part of a rising hand's inertia, in N m.

    A braking hand lags behind its command, so its moment is taken as it is.

    Args:
        moment: felt at the wrist, in N m.
        acceleration: the hand's vertical acceleration, in m/s^2.
    """
    return moment / max(1 + acceleration / GRAVITY, 1.0)


def felt_lever(moment: float, weight: float) -> float:
    """How far the centre of mass lies from the pads' middle along the hand's x axis, in m.

    This is right even while one end of the object still rests on the table near its centre of mass,
    since both moment and weight are less then.

    Args:
        moment: about the axis of the pads while the hand rests, in N m.
        weight: of `felt_weight`, in N.
    """
    return min(max(moment / max(weight, 1e-3), -_LONGEST_LEVER), _LONGEST_LEVER)


def turns_in_the_pads(moment: float, times: float) -> bool:
    """Whether an object turns between the pads, or is about to.

    Args:
        moment: about the axis of the pads while the hand rests, in N m.
        times: how often this object was set down because of this. The more often, the more is
            allowed, so that it comes to an end.
    """
    return abs(moment) > _EASY_MOMENT * (1 + _INDULGENCE * times)


def lifts_too_early(wanted: float, present: float) -> bool:
    """Whether the pads press far less than they should, so that the object would turn between them.

    Args:
        wanted: the force of `grip_force`, in N.
        present: the force of the pads now, in N.
    """
    return wanted > _TOO_EARLY * present
