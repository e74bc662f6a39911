import copy
import io
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image
from rich.console import Console

from kitting_drake.common.errors import UserError
from kitting_drake.evaluation.quantities import count_text, seconds_text
from kitting_drake.policies.data.demonstrations import Demonstration, Origin, write_demonstrations
from kitting_drake.policies.data.recorded import DemonstrationStep
from kitting_drake.policies.networks.device import preferred_type
from kitting_drake.reproduction.network_speed import benchmark_networks, timing
from kitting_drake.reproduction.network_speed.convolutions import Convolutions
from kitting_drake.reproduction.network_speed.plan import Plan, synthetic_scene
from kitting_drake.reproduction.network_speed.speed_figure import draw_networks
from kitting_drake.reproduction.network_speed.speed_tables import network_tables
from kitting_drake.reproduction.network_speed.timing import count_operations, time_each
from kitting_drake.reproduction.page.runs import METHODS as NAMES
from kitting_drake.reproduction.paper.efficiency import (
    EFFICIENCY,
    efficiency_section,
    read_efficiency,
)
from systems.signals import Observation, PickPlaceAction, PixelGrid, PlanarPose

GRID = PixelGrid(rows=32, cols=48)
METHODS = ("so2", "equivariant_transporter", "transporter")
MEASURES = {"training_step", "alpha_training_step", "decision", "alpha_inference"}


@pytest.fixture(scope="module")
def measured(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """The results of the smallest benchmark, on a demonstration with a small image."""
    torch.set_num_threads(1)
    path = tmp_path_factory.mktemp("benchmark") / "demonstrations.h5"
    x, y = GRID.to_world((16.0, 24.0))
    step = DemonstrationStep.of(
        Observation(np.random.default_rng(0).random((4, *GRID.shape), np.float32), GRID),
        PickPlaceAction(PlanarPose(x, y, 0.3), PlanarPose(x, y, 1.0)),
        name="hammer_0",
    )
    origin = Origin("mine", {}, GRID, 10, {})
    write_demonstrations(path, origin, [Demonstration(10, 1.0, (step,))])
    plan = Plan(
        preset="tiny",
        compared_preset=None,
        orientations=(26, 30),
        finer=32,
        repeats=1,
        peak_side=256,
        demonstrations=path,
    )
    return benchmark_networks(plan, Console(quiet=True))


@pytest.mark.slow
def test_describes_the_machine(measured: dict[str, Any]):
    machine = measured["machine"]
    assert set(machine) == {
        "cpu",
        "cores",
        "threads",
        "device",
        "torch",
        "python",
        "load_before",
    }
    assert machine["threads"] == torch.get_num_threads()
    assert measured["inference_type"] in ("bfloat16", "float32")
    assert measured["observation"].endswith("demonstrations.h5")
    assert json.loads(json.dumps(measured)) == measured


@pytest.mark.slow
@pytest.mark.parametrize("name", ["pick_angle", "decision"])
def test_there_is_a_row_for_each_method_and_n(name: str, measured: dict[str, Any]):
    cells = [(row["method"], row["orientations"]) for row in measured[name]]
    expected = [(method, n) for method in METHODS for n in (26, 30)]
    expected.insert(2, ("so2", 32))
    assert cells == expected
    for row in measured[name]:
        assert row["skipped"] is None
        assert 0 < row["fastest"] <= row["seconds"] <= row["slowest"]
        assert row["parameters"] > 0
        assert row["operations"] > 0


@pytest.mark.slow
def test_only_the_equivariant_transporter_grows_in_parameters(measured: dict[str, Any]):
    growth = {row["method"]: row for row in measured["pick_angle_growth"]}
    assert growth["so2"]["from"] == 26
    assert growth["so2"]["to"] == 30
    assert growth["so2"]["parameters"] == 1
    # In our angle network, only the discretization depends on N, and it costs little.
    assert growth["so2"]["operations"] == pytest.approx(1, abs=1e-3)
    assert growth["equivariant_transporter"]["parameters"] == pytest.approx(30 / 26, rel=0.05)
    assert growth["equivariant_transporter"]["operations"] == pytest.approx((30 / 26) ** 2, rel=0.1)
    assert growth["transporter"]["parameters"] == 1
    assert growth["transporter"]["operations"] == pytest.approx(30 / 26, rel=0.1)


@pytest.mark.slow
def test_a_decision_is_the_sum_of_its_parts(measured: dict[str, Any]):
    for row in measured["decision"]:
        parts = dict(row["parts"])
        assert set(parts) == {"pick_position", "pick_angle", "phi", "psi", "search"}
        assert sum(parts.values()) <= row["slowest"]
        # The Transporter predicts position and angle in one network, so the angle takes no time.
        joint = parts.pop("pick_angle") == 0
        assert joint == (row["method"] == "transporter")
        assert all(seconds > 0 for seconds in parts.values())


@pytest.mark.slow
def test_the_transporter_encodes_every_rotated_crop(measured: dict[str, Any]):
    few, many = (row for row in measured["decision"] if row["method"] == "transporter")
    angle = {
        row["orientations"]: row["operations"]
        for row in measured["pick_angle"]
        if row["method"] == "transporter"
    }
    # Apart from the picking network, a decision computes phi once and psi N times.
    placing = [row["operations"] - angle[row["orientations"]] for row in (few, many)]
    crop = (placing[1] - placing[0]) / (30 - 26)
    assert placing[0] - 26 * crop > 0
    assert placing[0] - 26 * crop == pytest.approx(placing[1] - 30 * crop)


@pytest.mark.slow
def test_folding_computes_the_same_function(measured: dict[str, Any]):
    folding = measured["folding"]
    types = ["float32"] + ["bfloat16"] * (preferred_type() == torch.bfloat16)
    rungs = [f"{kind}_{type_}" for kind in ("escnn", "ours") for type_ in types]
    assert list(folding["rungs"]) == list(folding["speed_up"]) == rungs
    for rung in rungs:
        assert set(folding["rungs"][rung]) == set(folding["speed_up"][rung]) == MEASURES
    shares = folding["convolution_share"]
    assert list(shares) == [rung for rung in rungs if rung.startswith("ours")]
    for share in shares.values():
        assert set(share) == {"training_step", "decision"}
        assert all(value > 0 for value in share.values())
    assert set(folding["speed_up"]["escnn_float32"].values()) == {1.0}
    assert folding["alpha_difference"]["ours_float32"] < 1e-4
    # Our fields have eight samples each, escnn's have seven coefficients.
    operations = folding["alpha_operations"]
    assert 1 < operations["ours"] / operations["escnn"] < (8 / 7) ** 2


@pytest.mark.slow
def test_shares_of_the_peak(measured: dict[str, Any]):
    rows = {(row["network"], row["type"], row["mode"]): row for row in measured["share_of_peak"]}
    for name in ("alpha", "beta", "phi", "psi"):
        infer, train = rows[name, "float32", "inference"], rows[name, "float32", "training"]
        # The backward pass costs twice the forward pass, except that the image needs no gradient.
        # Training also expands the kernels.
        assert 2.5 < train["operations"] / infer["operations"] < 5
        peak = measured["peak"]["float32"]["best"]
        assert infer["share"] == pytest.approx(infer["operations"] / infer["seconds"] / peak)


@pytest.mark.slow
def test_levels_include_all_layers(measured: dict[str, Any]):
    levels, layers = measured["alpha_levels"]["levels"], measured["alpha_levels"]["layers"]
    blocks = [f"down {i}" for i in range(1, 6)] + [f"up {i}" for i in range(1, 5)]
    assert [row["level"] for row in levels] == ["input", *blocks, "head"]
    # There are 21 layers, and some shortcuts that are convolutions.
    assert len(layers) == 21 + sum(row["layer"].endswith("shortcut") for row in layers)
    assert sum(row["operations"] for row in layers) == sum(row["operations"] for row in levels)
    for row in levels:
        assert row["seconds"] > 0
        assert row["convolution_s"] > 0


@pytest.mark.slow
def test_skipped_measurements_are_drawn_and_printed(measured: dict[str, Any], tmp_path: Path):
    measured = copy.deepcopy(measured)
    for row in measured["pick_angle"] + measured["decision"]:
        if row["method"] == "transporter":
            row |= {"seconds": None, "parts": None, "skipped": "not run: ~99 s"}
    draw_networks(measured, tmp_path / "networks.png")
    assert np.asarray(Image.open(tmp_path / "networks.png")).shape[1] > 1000
    console = Console(width=200, record=True, file=io.StringIO())
    for table in network_tables(measured):
        console.print(table)
    assert console.export_text().count("not run: ~99 s") == 4


@pytest.mark.slow
def test_the_page_of_results_shows_the_cost_of_angles(measured: dict[str, Any], tmp_path: Path):
    assert read_efficiency(tmp_path) is None
    path = tmp_path / EFFICIENCY
    path.write_text(json.dumps(measured))
    text = efficiency_section(read_efficiency(tmp_path))
    lines = [line.split("|")[1:-1] for line in text.splitlines() if line.startswith("| ")]
    table = {line[0].strip(): [cell.strip() for cell in line[1:]] for line in lines}
    assert table["method"] == ["preset", "N = 26", "N = 30", "growth"]
    rows = {row["method"]: row for row in measured["pick_angle_growth"]}
    for method in METHODS[:2]:
        cells = table[NAMES[method]]
        assert cells[0] == "tiny"
        assert all(cell.endswith(" ms") for cell in cells[1:3])
        assert cells[3].startswith(f"{rows[method]['parameters']:.2f}, ")
    assert NAMES["transporter"] not in table
    for damaged in ({"machine": 7}, measured | {"pick_angle": []}, []):
        path.write_text(json.dumps(damaged))
        with pytest.raises(UserError, match="was not written by benchmark networks"):
            read_efficiency(tmp_path)


def test_the_picks_of_the_synthetic_scene_are_on_tools():
    scene = synthetic_scene(PixelGrid())
    assert len(scene.targets) == 4
    for target in scene.targets:
        row, col = np.rint(target.pick).astype(int)
        assert target.image[3, row, col] == pytest.approx(0.02)
        row, col = np.rint(target.place).astype(int)
        assert target.image[3, row, col] == pytest.approx(0.03)


def test_counts_operations():
    matrix = torch.ones(3, 5)
    assert count_operations(lambda: matrix @ matrix.T) == 2 * 3 * 5 * 3


def test_records_all_but_depthwise_convolutions():
    image, kernel = torch.ones(1, 3, 9, 9), torch.ones(4, 3, 3, 3, requires_grad=True)
    filters = torch.ones(4, 1, 3, 3)

    def function() -> None:
        for _ in range(2):
            features = torch.nn.functional.conv2d(image, kernel)
            torch.nn.functional.conv2d(features, filters, groups=4).sum().backward()

    convolutions = Convolutions.of(function)
    found = {call[0].name(): count for call, count in convolutions.calls.items()}
    assert found == {"aten::convolution": 2, "aten::convolution_backward": 2}
    device = torch.device("cpu")
    functions = convolutions.alone(device)
    outputs = {call[0].name(): run() for call, run in functions.items()}
    assert outputs["aten::convolution"].shape == (1, 4, 7, 7)
    image_gradient, kernel_gradient, _ = outputs["aten::convolution_backward"]
    assert image_gradient is None
    assert kernel_gradient.shape == kernel.shape
    timings = time_each(functions, device, repeats=1, budget=1.0)
    total = sum(timing.seconds for timing in timings.values())
    assert convolutions.seconds(timings) == pytest.approx(2 * total)
    with torch.inference_mode():
        found = Convolutions.of(lambda: torch.nn.functional.conv2d(image, kernel))
    assert len(found.calls) == 1


def test_time_each_stops_when_the_budget_is_spent():
    ran = []
    timings = time_each(
        {name: lambda name=name: ran.append(name) for name in "ab"},
        torch.device("cpu"),
        repeats=5,
        budget=-1.0,
    )
    assert ran == ["a", "b"]
    assert timings["a"].runs == 1


def test_if_warming_up_spends_the_budget_the_last_run_counts(
    monkeypatch: pytest.MonkeyPatch,
):
    clock = iter([0.0, 3.0, 10.0, 11.0])  # The first run takes 3 s, the second 1 s.
    monkeypatch.setattr(timing, "read_clock", lambda _: next(clock))
    timings = time_each({"a": lambda: None}, torch.device("cpu"), repeats=5, budget=3.5)
    assert timings["a"] == timing.Timing.of([1.0])


@pytest.mark.parametrize(
    ("value", "text"), [(0.00123, "1.23 ms"), (1.234, "1.23 s"), (1234.0, "1234 s"), (None, "-")]
)
def test_seconds_text(value: float | None, text: str):
    assert seconds_text(value) == text


def test_count_text():
    assert [count_text(count) for count in (12, 4_540_000, 2.3e12)] == ["12", "4.54 M", "2.3 T"]


def test_an_unknown_preset_is_rejected():
    presets = "paper, small, matched, tiny"
    with pytest.raises(UserError, match=f"--preset must be one of {presets}, not 'huge'"):
        Plan(preset="huge")
