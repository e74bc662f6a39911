"""Measures how reliable the confidence of decisions is, on static scenes with random cameras.

Scenes are drawn at random as for training, with seeds that no training uses. Decisions are judged
by geometry (`judging`), without physics.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict, dataclass, replace
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from scipy.optimize import minimize

from kitting_drake.common.errors import UserError
from kitting_drake.common.files import (
    append_line,
    claim_folder,
    files_digest,
    read_lines,
    write_json,
)
from kitting_drake.common.processes import counting_bar
from kitting_drake.common.provenance import commit, versions
from kitting_drake.policies.confidence import (
    MOST_PROPOSALS,
    Reliability,
    evidence_of_networks,
    ranked,
    read_reliability,
)
from kitting_drake.policies.factory import load_learned_policy, make_shape_matching
from kitting_drake.policies.matching.evidence import Evidence
from kitting_drake.reproduction.benchmarks.judging import judge
from kitting_drake.scenario import Scenario
from kitting_drake.static_scenes.drawing import DrawnScene, draw_scenes
from systems.pick_place_parameters import PickPlaceParameters
from systems.sensor_noise import SensorNoiseParameters
from systems.signals import Observation, PickPlaceAction, PixelGrid

Array = NDArray[np.float64]

POLICIES = ("networks", "shape_matching")
_CAMERAS = {
    "all": (0, 1, 2, 3),
    "default cameras": (0,),
    "one random camera": (1,),
    "two or three": (2, 3),
}
_RANDOM_VIEWS = 0.7
"""The share of scenes with random cameras. The other scenes have the default cameras."""
_EVERY = 4
"""Only every fourth scene of a seed is used. The scenes of a seed share their tools, so using fewer
of each seed gives more different tools."""
_WITHOUT_KIT = 0.1
"""The share of scenes without a kit."""
LEAST_CONFIDENCE = 0.9
"""The confidence below which a robot does not act. This threshold is not fitted: confidence is a
probability of success, so the threshold follows from the cost of a wrong action."""
_OTHER_LIMITS = (0.8, 0.95)
"""Other limits for which the errors are reported."""
_FOLDS, _FOLD = 6, 10
"""The number of parts in the cross-validation, and the number of successive scenes that stay in one
part."""
_LINES = "decisions.jsonl"
_BINS = 10
_SHRINKAGE = 10.0
"""The weight of half the squared coefficients in the fit, beside the sum of all decisions' losses.
Features are scaled to a standard deviation of 1."""


@dataclass(frozen=True)
class Judged:
    """A proposal of a policy, with the verdict on it. A policy makes up to `MOST_PROPOSALS` in a
    scene."""

    policy: str
    """The policy: `networks` or `shape_matching`."""
    scene: int
    verdict: str
    """The result of `judge`; `stop` if the policy stops."""
    evidence: Evidence
    cameras: int
    """The number of random cameras; zero for the default cameras."""
    reason: str = ""
    """The reason why the policy stopped."""


def measure_reliability(
    first_seed: int,
    count: int,
    weights: Path | None,
    folder: Path,
    console: Console,
    *,
    fits: bool,
) -> dict[str, Any]:
    """Measures how reliable the confidence of decisions is. Scenes that are in the folder already
    are skipped, so the same command resumes the work, and a larger `count` adds scenes.

    Args:
        first_seed: the seed of the first scene.
        count: the number of scenes.
        weights: the file of the networks; None for the generalist.
        folder: the folder for `decisions.jsonl`, which has a line for each scene, and for
            `confidence.json` if `fits`.
        console: the console for the progress.
        fits: whether to fit the confidence to these decisions; else the existing fit is used.

    Returns:
        A summary of each policy's decisions, by the number of cameras.

    Raises:
        UserError: there are too few scenes for a fit; or the folder holds other files, or decisions
            of other scenes, networks or code.
    """
    if fits and count < _FOLDS * _FOLD:
        raise UserError(f"--fit needs at least {_FOLDS * _FOLD} scenes: give more --scenes")
    networks = None if weights is None else files_digest([weights])
    described = {"seed": first_seed, "networks": networks, "commit": commit()} | versions()
    claim_folder(folder, "decisions_of.json", described, of="seed, networks or version")
    lines = read_lines(folder / _LINES)[:count]
    judged = [Judged(**item) for line in lines for item in line]
    with counting_bar(console, "scenes") as progress:
        bar = progress.add_task("", total=count, completed=len(lines))
        for found in draw_judged(first_seed, range(len(lines), count), weights):
            append_line(folder / _LINES, [asdict(item) for item in found])
            judged += found
            progress.advance(bar)
    return summarize_all(judged, weights, folder if fits else None) | {
        "seeds": [first_seed, count],
        "commit": commit(),
    }


def summarize_all(
    judged: list[Judged], weights: Path | None, fitted: Path | None
) -> dict[str, Any]:
    """Summarizes decisions by policy and number of cameras, and for all cameras by the least
    confidence.

    Args:
        judged: all decisions.
        weights: the file of the networks; None for the generalist.
        fitted: the folder in which to write `confidence.json`, fitted to these decisions; None uses
            the confidence that is fitted already.
    """
    found, summaries = {}, {}
    for policy in POLICIES:
        chosen = [item for item in judged if item.policy == policy]
        if fitted is None:
            found[policy] = read_reliability(policy, weights)
            confidences = [_confidence(found[policy], item) for item in chosen]
        else:
            confidences = _cross_validated(chosen)
            found[policy] = fit(chosen)
        summaries[policy] = _by_cameras(chosen, confidences, found[policy].threshold)
        limits = sorted({found[policy].threshold, *_OTHER_LIMITS})
        summaries[policy]["limits"] = [_at(limit, chosen, confidences) for limit in limits]
    if fitted is not None:
        write_json(fitted / "confidence.json", {k: asdict(item) for k, item in found.items()})
    return summaries


def _at(limit: float, judged: list[Judged], confidences: list[float]) -> dict[str, float]:
    """Returns the errors of a policy that acts with at least the confidence `limit`."""
    found = summarize(judged, confidences, limit)
    return {
        "least_confidence": limit,
        "wrong_answers": found.wrong_answers,
        "refused": found.refused,
    }


def _by_cameras(judged: list[Judged], confidences: list[float], threshold: float) -> dict[str, Any]:
    summaries: dict[str, Any] = {"threshold": threshold}
    for name, cameras in _CAMERAS.items():
        chosen = [k for k, item in enumerate(judged) if item.cameras in cameras]
        if any(judged[k].verdict != "stop" for k in chosen):
            part = [judged[k] for k in chosen], [confidences[k] for k in chosen]
            summaries[name] = asdict(summarize(*part, threshold))
    return summaries


def _confidence(reliability: Reliability, item: Judged) -> float:
    return reliability.confidence(item.evidence) if item.evidence else 0.0


def _cross_validated(judged: list[Judged]) -> list[float]:
    """Returns the confidence of each decision by a regression that was fitted to other scenes."""
    confidences = [0.0] * len(judged)
    for fold in range(_FOLDS):
        inside = [item.scene // _FOLD % _FOLDS == fold for item in judged]
        others = [item for item, out in zip(judged, inside, strict=True) if not out]
        reliability = fit(others)
        for k in np.flatnonzero(inside):
            confidences[k] = _confidence(reliability, judged[k])
    return confidences


def draw_judged(
    first_seed: int, numbers: range, weights: Path | None = None
) -> Iterator[list[Judged]]:
    """Yields, for each of the scenes that are drawn at random, the judged proposals of all
    `POLICIES`.

    Args:
        first_seed: the seed of the first scene.
        numbers: the successive numbers of the scenes; that of the first scene is 0.
        weights: the file of the networks; None for the generalist.
    """
    if not numbers:
        return
    planner = PickPlaceParameters()
    networks = load_learned_policy(weights, planner, insertion=True).function
    matching = make_shape_matching(planner)

    def by_networks(seen: Observation) -> Iterator[tuple[PickPlaceAction, Evidence]]:
        for action, decision in networks.proposals(seen):
            if decision is not None and decision.kit_seen is False:
                yield PickPlaceAction(stop=True, reason="no kit seen"), {}
                return
            if decision is None or action.stop:
                yield action, {}
            else:
                yield action, evidence_of_networks(seen, decision)

    def by_matching(seen: Observation) -> Iterator[tuple[PickPlaceAction, Evidence]]:
        for matched in matching.proposals(seen):
            yield matched.action, matched.geometry or {}

    scenes = islice(_scenes(first_seed), numbers.start, None)
    for number, scene in zip(numbers, scenes, strict=False):
        observation = scene.render(PixelGrid())
        cameras = len(scene.cameras) if scene.cameras != Scenario().cameras else 0
        judged = []
        for policy, propose in (("networks", by_networks), ("shape_matching", by_matching)):
            for action, evidence in islice(propose(observation), MOST_PROPOSALS):
                verdict = (
                    "stop" if action.stop else judge(action, scene.loose, planner, observation)
                )
                judged.append(Judged(policy, number, verdict, evidence, cameras, action.reason))
        yield judged


def _scenes(first_seed: int) -> Iterator[DrawnScene]:
    """Yields scenes of successive seeds, some of them without their kit."""
    seed = first_seed
    while True:
        rng = np.random.default_rng([seed, 3])
        for number, scene in enumerate(draw_scenes(seed, default_views=0.0)):
            if number % _EVERY:
                continue
            scene = replace(scene, noise=_draw_noise(rng))
            if rng.random() >= _RANDOM_VIEWS:
                scene = replace(scene, cameras=dict(Scenario().cameras))
            if rng.random() < _WITHOUT_KIT:
                # The first body is the kit. Without it, no tool has a goal.
                scene = replace(scene, bodies=scene.bodies[1:], loose=())
            yield scene
        seed += 1


def _draw_noise(rng: np.random.Generator) -> SensorNoiseParameters:
    """Draws image noise, and calibration errors of up to about 1 mm and 0.1 degrees.

    In 30 % of the draws there is neither noise nor an error.
    """
    if rng.random() < 0.3:
        return SensorNoiseParameters()
    share = rng.uniform(0.0, 1.0, 7)
    return SensorNoiseParameters(
        depth_std=float(0.002 * share[0]),
        depth_step=float(0.001 * share[1]),
        flying_share=float(0.2 * share[2]),
        hole_share=float(0.03 * share[3]),
        steepest_deg=float(90 - 10 * share[4]),
        camera_position_error=float(0.0004 * share[5]),
        camera_angle_error_deg=float(0.04 * share[5]),
        rig_position_error=float(0.001 * share[6]),
        rig_angle_error_deg=float(0.1 * share[6]),
    )


def fit(judged: list[Judged]) -> Reliability:
    """Fits a logistic regression that predicts, from a decision's evidence, whether it is right.

    The threshold is `LEAST_CONFIDENCE`.
    """
    acted = [item for item in judged if item.verdict != "stop"]
    names = sorted(acted[0].evidence)
    facts = np.array([[item.evidence[name] for name in names] for item in acted])
    right = np.array([item.verdict == "right" for item in acted])
    middle, spread = facts.mean(axis=0), np.maximum(facts.std(axis=0), 1e-6)
    scaled = np.column_stack([(facts - middle) / spread, np.ones(len(facts))])

    def loss(weights: Array) -> tuple[float, Array]:
        total = scaled @ weights
        probability = 1 / (1 + np.exp(-total))
        value = np.logaddexp(0, np.where(right, -total, total)).mean()
        slope = scaled.T @ (probability - right) / len(right)
        ridge = _SHRINKAGE / len(right) * weights * (np.arange(len(weights)) < len(names))
        return float(value + 0.5 * (ridge @ weights)), slope + ridge

    found = minimize(loss, np.zeros(len(names) + 1), jac=True, method="L-BFGS-B").x
    weights = found[:-1] / spread
    constant = float(found[-1] - weights @ middle)
    plain = dict(zip(names, map(float, weights), strict=True)) | {"": constant}
    return Reliability(plain, LEAST_CONFIDENCE)


@dataclass(frozen=True)
class ReliabilitySummary:
    """Measures of how well a confidence separates right decisions from wrong ones."""

    decisions: int
    right: float
    """The share of all decisions that are right."""
    calibration_error: float
    """The expected calibration error over ten bins."""
    wrong_answers: float
    """Of the decisions above the threshold, the share that is wrong."""
    refused: float
    """The share of the right decisions that are below the threshold."""
    bins: list[tuple[float, float, int]]
    """For each bin: the mean confidence, the share of right decisions and the number of
    decisions."""


def summarize(
    judged: list[Judged], confidences: list[float], threshold: float
) -> ReliabilitySummary:
    """Summarizes the decisions of one policy. Of the proposals in a scene, only the surest one
    counts (`ranked`).

    Args:
        judged: the proposals.
        confidences: the confidence of each proposal, from 0 to 1.
        threshold: the least confidence with which to act.
    """
    chosen = _chosen(judged, confidences, threshold)
    right = np.array([judged[k].verdict == "right" for k in chosen])
    confidence = np.array([confidences[k] for k in chosen])
    bins = []
    for low in np.arange(_BINS) / _BINS:
        inside = (confidence >= low) & (confidence < low + 1 / _BINS + (low > 0.89))
        if inside.any():
            bins.append(
                (float(confidence[inside].mean()), float(right[inside].mean()), int(inside.sum()))
            )
    error = sum(abs(mean - share) * count for mean, share, count in bins) / len(chosen)
    answered = confidence >= threshold
    return ReliabilitySummary(
        decisions=len(chosen),
        right=float(right.mean()),
        calibration_error=float(error),
        wrong_answers=float((~right[answered]).mean()) if answered.any() else 0.0,
        refused=float((~answered[right]).mean()) if right.any() else 0.0,
        bins=bins,
    )


def _chosen(judged: list[Judged], confidences: list[float], threshold: float) -> list[int]:
    """Returns the index of the proposal that is chosen in each scene, as on a real bench.

    Scenes in which the policy stops at once have none.
    """
    by_scene: dict[int, list[int]] = {}
    for k, item in enumerate(judged):
        if item.verdict != "stop":
            by_scene.setdefault(item.scene, []).append(k)
    return [ranked(found, confidences.__getitem__, threshold)[0] for found in by_scene.values()]
