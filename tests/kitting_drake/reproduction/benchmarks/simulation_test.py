from pathlib import Path

import pytest
from rich.console import Console

from kitting_drake.reproduction.benchmarks import simulation
from kitting_drake.reproduction.benchmarks.simulation import PhaseStopwatch, simulation_tables
from kitting_drake.scenario import load_scenario
from kitting_drake.scenario.schema import Scenario
from tests.kitting_drake.rig import build_rig


def test_phases_sum_to_their_episodes():
    scenario = Scenario(cameras={}, time_limit=1.0)
    stopwatch = PhaseStopwatch()
    simulated = wall = 0.0
    for seed in range(2):
        rig = build_rig(scenario, seed=seed)
        stopwatch.start()
        result = rig.run(stopwatch.observe)
        simulated += result.sim_seconds
        wall += result.wall_seconds
    # The times of the phases add up to the time of the episode. The last, unfinished phase counts.
    assert list(stopwatch.phases)[:2] == ["observe", "approach"]
    assert sum(phase[0] for phase in stopwatch.phases.values()) == pytest.approx(simulated)
    assert sum(phase[1] for phase in stopwatch.phases.values()) == pytest.approx(wall, rel=0.5)
    assert all(phase[0] > 0 for phase in stopwatch.phases.values())


@pytest.mark.parametrize("path", [simulation._SCENARIO, simulation._LEARNED])
def test_the_measured_scenarios_find_their_files(path: Path):
    """Paths of weights and tools are relative to the scenario's file."""
    policy = load_scenario(path).policy
    assert policy.digest(path.parent) is None or policy.details(path.parent)


def test_terminal_tables():
    measured = {
        "policies": {
            "oracle": {
                "objects": 8,
                "wall_s_per_object": 1.234,
                "real_time_rate": 5.06,
                "objects_per_simulated_hour": 800.4,
            },
            "learned": {
                "objects": 0,
                "wall_s_per_object": None,
                "real_time_rate": 2.0,
                "objects_per_simulated_hour": 0.0,
            },
        },
        "phases": {"done": {"simulated_s": 0.0, "wall_s": 0.1, "wall_s_per_simulated_s": None}},
        "start_up_s": {"cache_empty": 3.0, "cache_filled": 2.0},
        "images_s": {"rgbd_image": 0.01, "heightmap": 0.02},
    }
    console = Console(width=100)
    with console.capture() as shown:
        console.print(*simulation_tables(measured))
    rows = {row[1]: row[1::2] for line in shown.get().splitlines() if (row := line.split())[1:]}
    assert rows["done"] == ["done", "0.0", "0.1", "-"]
    assert rows["oracle"] == ["oracle", "8", "1.23", "5.1", "800"]
    assert rows["learned"] == ["learned", "0", "-", "2.0", "0"]
