"""Computes the force of the pads, and how gently to move, from an object's weight and moment."""

import numpy as np

from systems.pick_place_parameters import PickPlaceParameters

GRAVITY = 9.81
"""Acceleration of gravity, in m/s^2."""

_TOO_EARLY = 1.5
"""If the required grip force is more than this factor times the present one, the lift waits until
the force has risen."""
_EASY_MOMENT = 0.18
"""A moment about the axis of the pads that friction holds easily, in N m."""
_MOMENT_ARM = 0.0030
"""While the hand accelerates, the pads withstand moments up to their force times this length, in m.
A long round handle begins to turn if the moment exceeds the force times 5 mm."""
_HELD_MOMENT = 0.30
"""An object that does not turn between the pads at rest may turn in motion if its moment is larger
than this, in N m."""
_NOTABLE_MOMENT = 0.10
"""A moment that a poor grip might not hold, in N m."""
_INDULGENCE = 0.5
"""Each time an object is set down because it turned, the allowed moment grows by this fraction of
the initial limit."""
_LONGEST_LEVER = 0.12
"""Largest plausible distance of a centre of mass from the pads' middle, in m."""
_SOFT, _SOFT_SHARE = 0.006, 0.2
"""If the jaws sink farther into an object than `_SOFT`, in m, or than `_SOFT_SHARE` of its width,
they press less."""
_MUCH_LESS = 0.85
"""When the jaws sink into an object, a lower force is used only if it is at most this fraction of
the present one."""
_GENTLE, _GENTLEST = 0.5, 0.25
"""Fractions of the limits of speed and acceleration. An object that may turn is moved with at most
`_GENTLE` of them; no object is moved with less than `_GENTLEST` of them."""
_GENTLER = 0.8
"""A lower acceleration is used only if it is below this fraction of the present one, because each
change restarts the motion."""
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


def grip_force(
    weight: float, present: float, parameters: PickPlaceParameters, moment: float = 0.0
) -> float:
    """The force of each pad on an object of a given weight, in N.

    Up to `heavy_load` it is proportional to the weight, but at least `grasp_force`; at `heavy_load`
    it is `firm_grasp_force`. From there it rises linearly to `peak_grasp_force` at `heaviest_load`.
    A moment about the axis of the pads may require more, up to the peak. The force never falls
    while the object is held: with less force, an object that has begun to turn between the pads
    would turn further.

    Args:
        weight: the weight that the hand feels, in N.
        present: the present force of each pad, in N.
        parameters: the forces and loads.
        moment: the moment about the axis of the pads while the hand rests, in N m.
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
    force = max(force, min(abs(moment) / _MOMENT_ARM, peak))
    return force if force > _LEAST_CHANGE * present or force == peak > present else present


def soft_force(
    force: float, sunk: float, width: float, present: float, parameters: PickPlaceParameters
) -> float:
    """The force of the pads on an object that gives way, in N.

    Pads that pierce a thin wall would neither hold the object well nor release it.

    Args:
        force: the result of `grip_force`, in N.
        sunk: how far the jaws have closed since they gripped, in m.
        width: the width of the object when the jaws gripped it, in m.
        present: the present force, in N.
        parameters: parameters with the least and the largest force.
    """
    peak = max(parameters.peak_grasp_force, parameters.grasp_force)
    soft = min(_SOFT, _SOFT_SHARE * width)
    most = max(peak * (soft / max(sunk, soft)) ** 2, parameters.grasp_force)
    if most > _MUCH_LESS * present:
        # Ignore a small decrease, because each change restarts the ramp of the force.
        most = max(most, present)
    return min(force, most)


def gentleness(
    weight: float, moment: float, present: float, parameters: PickPlaceParameters
) -> float:
    """The fraction of the limits of speed and acceleration that is used to move an object.

    It is 1 up to `heavy_load`, and inversely proportional to the weight above that load. If the
    object may turn between the pads, the fraction is at most a half. It never rises while the
    object is held.

    Args:
        weight: the weight that the hand feels, in N.
        moment: the moment about the axis of the pads while the hand rests, in N m.
        present: the fraction that is in use; 0 counts as 1.
        parameters: parameters with the load above which the hand is gentle.
    """
    present = present or 1.0
    share = max(parameters.heavy_load / max(weight, parameters.heavy_load), _GENTLEST)
    if may_turn(moment):
        share = min(share, _GENTLE)
    return share if share < _GENTLER * present else present


def moment_at_rest(moment: float, acceleration: float) -> float:
    """The moment about the axis of the pads that the object would exert at rest, in N m.

    The effect of an upward acceleration is removed. No correction is made while the hand brakes,
    because the hand then lags behind its command.

    Args:
        moment: the moment felt at the wrist, in N m.
        acceleration: the hand's vertical acceleration, in m/s^2.
    """
    return moment / max(1 + acceleration / GRAVITY, 1.0)


def felt_lever(moment: float, weight: float) -> float:
    """Position of the object's centre of mass relative to the pads' middle, along the hand's x
    axis, in m.

    The estimate also holds while one end of the object rests on the table, because moment and
    weight are then reduced in proportion.

    Args:
        moment: moment about the axis of the pads while the hand rests, in N m.
        weight: the result of `felt_weight`, in N.
    """
    return min(max(moment / max(weight, 1e-3), -_LONGEST_LEVER), _LONGEST_LEVER)


def may_turn(moment: float) -> bool:
    """Whether a poor grip may let an object turn between the pads.

    Args:
        moment: the moment about the axis of the pads while the hand rests, in N m.
    """
    return abs(moment) > _NOTABLE_MOMENT


def turns_in_the_pads(moment: float, times: float) -> bool:
    """Whether an object may turn between the pads, so that the planner must check how it hangs.

    Args:
        moment: moment about the axis of the pads while the hand rests, in N m.
        times: how often this object was set down because it turned. Each time, a larger moment is
            allowed, so that the attempts end.
    """
    return abs(moment) > _EASY_MOMENT * (1 + _INDULGENCE * times)


def slips_when_carried(moment: float, times: float) -> bool:
    """Whether an object may turn between the pads when it is carried, even if it does not turn
    while the hand rests.

    The arguments are those of `turns_in_the_pads`.
    """
    return abs(moment) > _HELD_MOMENT * (1 + _INDULGENCE * times)


def lifts_too_early(wanted: float, present: float) -> bool:
    """Whether the pads press far less than they should, so that the object would turn between them.

    Args:
        wanted: the result of `grip_force`, in N.
        present: the force of the pads now, in N.
    """
    return wanted > _TOO_EARLY * present
