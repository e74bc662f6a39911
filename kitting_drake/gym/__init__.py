"""The cell as Gymnasium environments; importing this registers them: see docs/gym.md.

Gymnasium imports it for `gymnasium.make("kitting_drake.gym:kitting_drake/KittingUnseen-v0")`. It
looks for no entry points of installed packages any more, from its version 1.0 on.
"""

import gymnasium

from kitting_drake.common import paths

SCENARIOS = {
    "KittingSeen": ("paper/kitting_seen.yaml", "KittingSeenToolset"),
    "KittingUnseen": ("paper/kitting_unseen.yaml", "KittingUnseenToolsets"),
    "AlignBoxCorner": ("ravens.yaml", "AlignBoxCorner"),
    "BlockInsertion": ("ravens.yaml", "BlockInsertion"),
    "PlaceRedInGreen": ("ravens.yaml", "PlaceRedInGreen"),
    "StackBlockPyramid": ("ravens.yaml", "StackBlockPyramid"),
    "PalletizingBoxes": ("ravens.yaml", "PalletizingBoxes"),
}
"""The file and the scenario in it of each environment but `Scenario`, which is told them."""


def _register_environments() -> None:
    """Registers `kitting_drake/NAME-v0` for each of `SCENARIOS` and for `Scenario`."""
    for name in ("Scenario", *SCENARIOS):
        file, scenario = SCENARIOS.get(name, (None, None))
        gymnasium.register(
            f"kitting_drake/{name}-v0",
            # Drake is slow to load: it is, once an environment is made.
            entry_point="kitting_drake.gym.environment:KittingEnvironment",
            # By its path: a file of that name in the working directory is another.
            kwargs={}
            if file is None
            else {"scenario": str(paths.SCENARIOS / file), "scenario_name": scenario},
        )


_register_environments()
