"""The training-free policy and the refinement of places, on rendered observations."""

import dataclasses
import math

import numpy as np
import pytest
from pydrake.math import RollPitchYaw

from kitting_drake.common.paths import GENERALIST, SCENARIOS
from kitting_drake.common.rendering import can_render
from kitting_drake.policies.data.images import rotation_matrix
from kitting_drake.policies.learned_policy import LearnedPolicy
from kitting_drake.policies.matching.assignment import match
from kitting_drake.policies.matching.refinement import refine_grasp, refine_place
from kitting_drake.policies.matching.regions.segmentation import segment
from kitting_drake.policies.matching.shape_matching import ShapeMatchingPolicy
from kitting_drake.policies.networks.factored import Networks
from kitting_drake.policies.networks.weights import load_networks
from kitting_drake.policies.stages import make_stages
from kitting_drake.scenario.loader import load_scenario
from systems.pick_place_parameters import PickPlaceParameters
from systems.signals import Observation, PlanarPose, fill_unseen
from tests.kitting_drake.policies.matching.regions.visibility_test import kit_and_bar
from tests.kitting_drake.rig import build_rig

pytestmark = pytest.mark.skipif(not can_render(), reason="images cannot be rendered here")
PLANNER = PickPlaceParameters()
FITTING = make_stages(PLANNER, insertion=True)


@pytest.fixture(
    scope="module",
    params=[pytest.param(None, marks=pytest.mark.slow), "colour:severe,depth_noise,depth_holes"],
)
def seen(request):
    """An observation of four tools beside their kit, and the true scene."""
    scenario = load_scenario(
        SCENARIOS / "paper/kitting_seen.yaml", None, "{policy: !Oracle {}}", request.param
    )
    rig = build_rig(scenario, seed=4, base=SCENARIOS)
    context = rig.diagram.CreateDefaultContext()
    return rig.port("observation", context), rig.scene


def true_places(scene):
    """For each object the (x, y, yaw) of its current pose and of its goal."""
    result = []
    for index, item in enumerate(scene.objects):
        goal = next(g for g in scene.goals if index in g.objects)
        poses = [item.X_WB, goal.poses[0]]
        result.append(
            [(*X.translation()[:2], RollPitchYaw(X.rotation()).yaw_angle()) for X in poses]
        )
    return result


def errors_of(action, scene) -> tuple[float, float]:
    """The errors of an action's place, in m and rad, for the object nearest to its pick."""
    pick, place = (np.array([p.x, p.y]) for p in (action.pick, action.place))
    lies, belongs = min(true_places(scene), key=lambda o: math.dist(o[0][:2], pick))
    rotation = belongs[2] - lies[2]
    want = np.array(belongs[:2]) + rotation_matrix(rotation) @ (pick - lies[:2])
    turned = action.place.theta - action.pick.theta
    return math.dist(want, place), abs(math.remainder(turned - rotation, math.tau))


def test_segments_kit_tools_and_recesses(seen):
    observation, scene = seen
    found = segment(observation)
    assert len(found.objects) == 4
    assert len(found.recesses) >= 4
    X = scene.fixtures[0].X_WF.translation()
    middle = np.argwhere(found.fixture).mean(axis=0)
    assert np.linalg.norm(observation.grid.to_world(middle) - X[:2]) < 0.004


def test_places_a_tool_into_its_recess(seen):
    observation, scene = seen
    action = ShapeMatchingPolicy(PLANNER)(observation)
    assert not action.stop
    distance, angle = errors_of(action, scene)
    assert distance < 0.003
    assert angle < math.radians(2)


def test_the_proposals_place_one_tool_each(seen):
    """Both policies propose the action that they would take, then actions for the other tools."""
    observation, scene = seen
    matching = [item.action for item in ShapeMatchingPolicy(PLANNER).proposals(observation)]
    assert matching[0] == ShapeMatchingPolicy(PLANNER)(observation)
    # Few orientations are faster.
    learned = LearnedPolicy(load_networks(GENERALIST), orientations=36, stages=FITTING)
    proposed = [action for action, _ in learned.proposals(observation)]
    assert proposed[0] == learned(observation)
    for actions in (matching, proposed):
        placing = [action for action in actions if not action.stop]
        tools = {nearest_tool(action, scene) for action in placing}
        assert len(placing) == len(tools) == 4
        for action in placing:
            distance, angle = errors_of(action, scene)
            assert distance < 0.003 and angle < math.radians(3)


@pytest.mark.parametrize("degrees", [0, 45])
def test_no_object_is_proposed_twice(degrees: float):
    """Pixels near an object belong to it, also beside its corners."""
    seen = kit_and_bar(None)
    image = seen.image.copy()
    image[3, :, 200:] = 0
    rows, cols = np.indices(seen.grid.shape)
    c, s = math.cos(math.radians(degrees)), math.sin(math.radians(degrees))
    along, across = (cols - 244) * c + (rows - 81) * s, (rows - 81) * c - (cols - 244) * s
    image[3, (abs(along) < 25) & (abs(across) < 3.5)] = 0.015
    seen = dataclasses.replace(seen, image=image, edge_height=None)
    # Few orientations are faster.
    policy = LearnedPolicy(load_networks(GENERALIST), orientations=36, stages=FITTING)
    ((action, decision),) = policy.proposals(seen)
    assert not action.stop and decision is not None
    # After a failed grasp the object is proposed once more, elsewhere.
    ((again, _),) = policy.proposals(seen, [action.pick])
    assert math.dist((again.pick.x, again.pick.y), (action.pick.x, action.pick.y)) > 0.0099


def nearest_tool(action, scene) -> int:
    lies = [o[0][:2] for o in true_places(scene)]
    return int(np.argmin([math.dist(xy, (action.pick.x, action.pick.y)) for xy in lies]))


def test_avoids_failed_grasps(seen):
    observation, _ = seen
    tried = []
    for _ in range(2):
        action = ShapeMatchingPolicy(PLANNER)(observation, tried)
        assert not action.stop
        for pick in tried:
            assert math.dist((pick.x, pick.y), (action.pick.x, action.pick.y)) > 0.0099
        tried.append(action.pick)


def test_takes_out_a_protruding_object_only_when_nothing_else_fits(seen):
    observation, _ = seen
    segmentation = segment(observation)
    policy = ShapeMatchingPolicy(PLANNER, recover=True)
    # Something protrudes 40 mm above the fixture, where there is no recess.
    top = float(np.median(observation.height[segmentation.fixture]))
    rows, cols = np.nonzero(segmentation.fixture)
    image = observation.image.copy()
    image[3, rows.min() + 3 : rows.min() + 7, cols.min() + 4 : cols.min() + 30] = top + 0.04
    blocked = dataclasses.replace(observation, image=image, edge_height=None)
    (standing,) = segment(blocked).protruding
    action = policy(blocked)
    assert not standing.mask[pixel_of(blocked, action)]
    for region in segment(blocked).objects:
        image[:, np.pad(region.mask, 2)[2:-2, 2:-2]] = image[:, :5, :5].mean(axis=(1, 2))[:, None]
    action = policy(dataclasses.replace(blocked, image=image, edge_height=None))
    assert not action.stop
    assert standing.mask[pixel_of(blocked, action)]


def pixel_of(observation: Observation, action) -> tuple[int, int]:
    row, col = np.rint(observation.grid.to_pixel((action.pick.x, action.pick.y))).astype(int)
    return row, col


def test_stops_when_nothing_is_left(seen):
    observation, _ = seen
    image = observation.image.copy()
    for region in segment(observation).objects:
        image[:, np.pad(region.mask, 2)[2:-2, 2:-2]] = image[:, :5, :5].mean(axis=(1, 2))[:, None]
    cleared = dataclasses.replace(observation, image=image, edge_height=None)
    assert ShapeMatchingPolicy(PLANNER)(cleared).stop
    assert ShapeMatchingPolicy(PLANNER)(Observation()).stop


def blind_networks() -> Networks:
    """Networks that always predict the pick at a corner of the image, where no object is."""
    networks = load_networks(GENERALIST)
    predict = networks.predict_pick

    def blind(*arguments):
        found = predict(*arguments)
        position = found.position.clone()
        position[0, 0] = 1e3
        return dataclasses.replace(found, position=position, log_odds=-99.0)

    networks.predict_pick = blind
    return networks


def test_an_object_that_fits_is_picked_even_if_the_networks_miss_it(seen):
    observation, _ = seen
    networks = blind_networks()
    action = LearnedPolicy(networks, orientations=36, stages=FITTING)(observation)
    assert not action.stop
    segmentation = segment(observation)
    fitting = [
        segmentation.objects[pair.item]
        for pair in match(segmentation, segmentation.unfilled_recesses, observation.grid.resolution)
    ]
    assert any(item.mask[pixel_of(observation, action)] for item in fitting)
    assert LearnedPolicy(networks, orientations=36)(observation).stop


@pytest.mark.slow
@pytest.mark.parametrize("seen", [None], indirect=True)
def test_nothing_is_left_after_grasps_failed_everywhere(seen):
    observation, _ = seen
    grid = observation.grid
    everywhere = [
        PlanarPose(*grid.to_world(pixel), 0.0)
        for region in segment(observation).objects
        for pixel in np.argwhere(region.mask)[::3]
    ]
    policy = LearnedPolicy(blind_networks(), orientations=36, stages=FITTING)
    assert policy(observation, everywhere).stop


@pytest.mark.parametrize("turn", [0.0, math.pi])
def test_a_nearly_right_or_reversed_place_is_corrected(seen, turn: float):
    observation, scene = seen
    grid, segmentation = observation.grid, segment(observation)
    # With noise, part of the second object's recess is lost. So for the half turn, test only the
    # first object.
    for lies, belongs in true_places(scene)[: 1 if turn and not observation.valid.all() else 2]:
        pick, place = grid.to_pixel(lies[:2]), grid.to_pixel(belongs[:2])
        rotation = belongs[2] - lies[2]
        off = place + (1.1, -0.7)
        if turn:
            # The predicted place is reversed about the recess's middle.
            recess = min(
                segmentation.recesses,
                key=lambda item: np.linalg.norm(item.pixels - place, axis=1).min(),
            )
            off = 2 * recess.pixels.mean(axis=0) - off
        start = pick, rotation + turn + 0.05, off, grid.resolution
        found = refine_place(segmentation, *start, segmentation.unfilled_recesses)
        assert found is not None
        assert np.linalg.norm(found.place - place) * grid.resolution < 0.003
        assert abs(math.remainder(found.rotation - rotation, math.tau)) < math.radians(2)


def test_a_place_moves_to_a_recess_that_fits_far_better():
    """A precision screwdriver is thin enough to lie in a hammer's recess."""
    scenario = load_scenario(SCENARIOS / "paper/kitting_unseen.yaml", None, "{policy: !Oracle {}}")
    rig = build_rig(scenario, seed=1216, base=SCENARIOS)
    context = rig.diagram.CreateDefaultContext()
    observation = rig.port("observation", context)
    grid, segmentation = observation.grid, segment(observation)
    names = [item.name for item in rig.scene.objects]
    places = true_places(rig.scene)
    lies, belongs = places[names.index("precision_screwdriver")]
    pick, place = grid.to_pixel(lies[:2]), grid.to_pixel(belongs[:2])
    rotation = belongs[2] - lies[2]
    hammer = grid.to_pixel(places[names.index("cross_peen_hammer")][1][:2])
    recess = min(
        segmentation.recesses,
        key=lambda item: np.linalg.norm(item.pixels - hammer, axis=1).min(),
    )
    wrong = recess.pixels.mean(axis=0)
    found = refine_place(
        segmentation, pick, rotation, wrong, grid.resolution, segmentation.unfilled_recesses
    )
    assert found is not None
    assert np.linalg.norm(found.place - place) * grid.resolution < 0.003
    assert abs(math.remainder(found.rotation - rotation, math.tau)) < math.radians(2)


def test_a_grasp_without_room_moves_to_one_with_room(seen):
    observation, scene = seen
    grid, segmentation = observation.grid, segment(observation)

    def refined(pick, theta: float, failed=None):
        return refine_grasp(segmentation, pick, theta, grid.resolution, PLANNER, failed)

    for index, (lies, _) in enumerate(true_places(scene)[:1]):
        grasp = scene.objects[index].grasps[0]
        pick = grid.to_pixel(rotation_matrix(lies[2]) @ (grasp.x, grasp.y) + lies[:2])
        theta = lies[2] + grasp.theta
        near = refined(pick, theta)
        if near is not None:
            assert np.linalg.norm(near.pick - pick) * grid.resolution < 0.04
        # Jaws that close along the handle would hold nothing, so such a grasp is turned.
        along = refined(pick, theta + math.pi / 2)
        assert along is not None
        assert abs(math.remainder(along.theta - theta, math.pi)) < math.radians(40)
        # Failed grasps are avoided. If grasps failed everywhere, none is returned.
        other = refined(pick, theta + math.pi / 2, along.pick[None])
        if other is not None:
            assert np.linalg.norm(other.pick - along.pick) * grid.resolution > 0.0099
        everywhere = np.argwhere(np.ones(grid.shape))[::2]
        assert refined(pick, theta + math.pi / 2, everywhere) is None
    segmentation = segment(Observation())
    assert refined(np.array([80.0, 160.0]), 0.0) is None


def test_a_place_far_from_any_recess_is_not_refined(seen):
    observation, scene = seen
    grid = observation.grid
    lies = true_places(scene)[0][0]
    pick = grid.to_pixel(lies[:2])
    segmentation = segment(observation)
    far = segmentation.fixture
    away = np.argwhere(~far)[np.linalg.norm(np.argwhere(~far) - pick, axis=1).argmax()]
    start = pick, 0.3, away.astype(float), grid.resolution
    assert refine_place(segmentation, *start, segmentation.unfilled_recesses) is None


def test_unseen_pixels_take_the_lowest_neighbouring_height():
    height = np.full((20, 20), 0.05, np.float32)
    height[:, 10:] = 0.0
    valid = np.ones(height.shape, bool)
    valid[5:8, 8:11] = False
    broken = np.where(valid, height, 0.9).astype(np.float32)
    filled = fill_unseen(broken, valid)
    np.testing.assert_array_equal(filled[valid], broken[valid])
    assert filled[6, 10] == filled[6, 9] == 0.0
    assert set(np.unique(filled)) == {np.float32(0.0), np.float32(0.05)}


@pytest.fixture(scope="module", params=[7402, 7417])
def kitted(request) -> Observation:
    """A kit with all of its tools, and four boxes on the table."""
    scenario = load_scenario(
        SCENARIOS / "paper/kitting_unseen.yaml",
        "KittingUnseenToolsetsTraining",
        "{policy: !Oracle {}}",
        "distractors",
    )
    rig = build_rig(scenario, seed=request.param, base=SCENARIOS)
    context = rig.diagram.CreateDefaultContext()
    plant_context = rig.plant.GetMyMutableContextFromRoot(context)
    for goal in rig.scene.goals:
        body = rig.plant.get_body(rig.objects[goal.objects[0]].body)
        rig.plant.SetFreeBodyPose(plant_context, body, goal.poses[0])
    return rig.port("observation", context)


@pytest.mark.slow
def test_boxes_do_not_match_the_visible_parts_of_filled_recesses(kitted: Observation):
    """A visible part is narrow and about as long as a box's side, so a box might seem to fit."""
    segmentation = segment(kitted)
    assert segmentation.recesses
    assert len(segmentation.objects) == 4
    policy = LearnedPolicy(
        load_networks(GENERALIST),
        orientations=36,
        stages=make_stages(PLANNER, insertion=True, recover=True),
    )
    assert policy(kitted).stop


def test_tools_match_recesses_and_a_box_does_not(seen):
    observation, _ = seen
    segmentation = segment(observation)
    resolution = observation.grid.resolution
    assert len(match(segmentation, segmentation.unfilled_recesses, resolution)) == 4
    # The box's base is the largest square that fits into a recess.
    box = np.zeros(segmentation.fixture.shape, bool)
    box[4:18, 4:18] = True
    recesses = dataclasses.replace(
        segmentation, objects=(dataclasses.replace(segmentation.objects[0], mask=box),)
    )
    assert match(recesses, recesses.unfilled_recesses, resolution) == []
