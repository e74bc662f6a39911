"""The stages of a decision after the networks' own. None of them is in the paper, which quantizes
every action and never stops.

Each takes a `Draft` and returns it refined; a policy is its networks and a list of these.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from kitting_drake.policies.draft import Draft, Stage, expected_position
from kitting_drake.policies.matching.recovery import recovery_action
from kitting_drake.policies.matching.refinement import refine_grasp, refine_place
from kitting_drake.policies.matching.release_clearance import blocked_at_place
from kitting_drake.policies.matching.shape_matching import belonging, certain_fits
from systems.pick_place_parameters import PickPlaceParameters

_AS_GOOD = 2.0
"""A rotation whose score is less by at most this is as good, in nats, ..."""
_SAME_PLACE = 4.0
"""... where the places are at most this far apart, in pixels."""
_SOMETHING_FITS, _NOTHING_FITS = -1.0, 2.0
"""By how much the threshold for stopping moves with what the outlines say, in nats. With everything
kitted and other things about, networks and outlines each err at times, and seldom both."""


def make_stages(
    planner: PickPlaceParameters,
    *,
    insertion: bool,
    continuous: bool = True,
    fit_outlines: bool = True,
    recover: bool = False,
    may_stop: bool = True,
) -> tuple[Stage, ...]:
    """The stages of a policy's decisions, as `!Learned` of a scenario names them.

    Args:
        planner: how the hand will pick and place.
        insertion: whether objects are put into recesses: outlines mean something only there.
        continuous: refine actions beyond pixels and bins.
        fit_outlines: with `continuous`, refine them by the geometry of o_t too.
        recover: mend what earlier actions left undone.
        may_stop: whether to stop where there is nothing left to pick.
    """
    outlines = insertion and continuous and fit_outlines
    stages: list[Stage] = []
    if continuous:
        stages.append(SubPixel())
    if outlines:
        stages += [JawRoom(planner), OutlinePlace()]
    elif continuous and fit_outlines:
        stages.append(ReleaseRoom(planner))
    if recover:
        stages.append(BelongingFirst())
    if may_stop:
        stages.append(StopRule(ask_outlines=recover))
    if outlines and may_stop and not recover:
        stages.append(CertainFits())
    if recover:
        stages.append(Recovery(planner))
    return tuple(stages)


@dataclass(frozen=True)
class SubPixel:
    """Positions between pixels and angles between bins."""

    def refine(self, draft: Draft) -> Draft:
        refined = draft.angles.refined
        draft = dataclasses.replace(
            draft,
            continuous=True,
            pick=expected_position(draft.logits, draft.pixel),
            theta=draft.theta if refined is None else refined,
        )
        rotation, goal = draft.placement(draft.placing.candidates[0])
        return dataclasses.replace(draft, rotation=rotation, goal=goal)


@dataclass(frozen=True)
class JawRoom:
    """A grasp for which o_t leaves the jaws no room moves to where it does (`refine_grasp`)."""

    planner: PickPlaceParameters

    def refine(self, draft: Draft) -> Draft:
        look = draft.look
        grasp = refine_grasp(
            look.segmentation,
            draft.pick,
            draft.theta,
            look.resolution,
            self.planner,
            look.failed_pixels,
        )
        if grasp is None:
            return draft
        return dataclasses.replace(draft, pick=grasp.pick, theta=grasp.theta)


@dataclass(frozen=True)
class OutlinePlace:
    """The place by the outlines of object and recess, where they agree (`refine_place`)."""

    def refine(self, draft: Draft) -> Draft:
        look = draft.look
        fitted = refine_place(
            look.segmentation, draft.pick, draft.rotation, draft.place, look.resolution
        )
        if fitted is None:
            return draft
        return dataclasses.replace(
            draft, rotation=fitted.rotation, fitted=fitted.place, belongs=True
        )


@dataclass(frozen=True)
class ReleaseRoom:
    """Of rotations that score equally well, as a cube has four, the one in which the fingers have
    most room when they let go (`blocked_at_place`)."""

    planner: PickPlaceParameters

    def refine(self, draft: Draft) -> Draft:
        candidates = draft.placing.candidates
        score = candidates[0].best()[0]
        as_good = [
            found
            for candidate in candidates
            if candidate.best()[0] >= score - _AS_GOOD
            and np.linalg.norm((found := draft.placement(candidate))[1] - draft.goal) <= _SAME_PLACE
        ]
        pixel = np.array(draft.pixel, float)

        def blocked(placement: tuple[float, NDArray[np.float64]]) -> float:
            look = draft.look
            return blocked_at_place(
                look.image[3], look.resolution, pixel, draft.theta, *placement, self.planner
            )

        # Of equals the first: it has the best score.
        rotation, goal = min(as_good, key=blocked)
        return dataclasses.replace(draft, rotation=rotation, goal=goal)


@dataclass(frozen=True)
class BelongingFirst:
    """What belongs into a recess goes before anything else (`belonging`)."""

    def refine(self, draft: Draft) -> Draft:
        if draft.belongs:
            return draft
        mask = belonging(draft.look.segmentation, draft.look.resolution)
        found = None if mask is None else draft.among(mask)
        return draft if found is None else dataclasses.replace(found, belongs=True)


@dataclass(frozen=True)
class StopRule:
    """Stops where the networks' log-odds that there is something to pick are below their
    threshold."""

    ask_outlines: bool = False
    """Whether the threshold moves with what the outlines say."""

    def refine(self, draft: Draft) -> Draft:
        odds, threshold = draft.look.picking.log_odds, draft.look.networks.stop_threshold
        if odds is None or threshold is None:
            return draft
        if self.ask_outlines and draft.look.segmentation.fixture.any():
            threshold += _SOMETHING_FITS if draft.belongs else _NOTHING_FITS
        return dataclasses.replace(draft, stop=odds < threshold)


@dataclass(frozen=True)
class CertainFits:
    """Where the policy would stop while an object certainly fits into a recess, picks that one:
    to the networks nothing looks like an object, and an outline says that something is one."""

    def refine(self, draft: Draft) -> Draft:
        if not draft.stop:
            return draft
        found = draft.among(certain_fits(draft.look.segmentation, draft.look.resolution))
        return draft if found is None else dataclasses.replace(found, stop=False)


@dataclass(frozen=True)
class Recovery:
    """Mends what an earlier action left undone (`recovery_action`): presses down what protrudes at
    once; takes out what could not be pressed down when nothing is left that belongs into a
    recess, because that may fail again, and actions are counted."""

    planner: PickPlaceParameters

    def refine(self, draft: Draft) -> Draft:
        look = draft.look
        mending = recovery_action(
            look.observation, look.segmentation, self.planner, look.failed_picks
        )
        if mending is None or not (mending.press or draft.stop or not draft.belongs):
            return draft
        return dataclasses.replace(draft, mending=mending)
