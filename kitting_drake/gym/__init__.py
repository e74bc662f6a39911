"""The cell as Gymnasium environments, registered on import; see docs/gym.md.

Gymnasium 1.0 and later do not load environments from the entry points of installed packages. So
import this module first, or name it in the call, which imports it:
`gymnasium.make("kitting_drake.gym:kitting_drake/KittingUnseen-v0")`.
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
    "AssemblingKits": ("assembling_kits.yaml", "Train"),
}
"""The file and the scenario of each environment, except for the environment `Scenario`, which takes
them as arguments."""
JOINTS = "KittingJoint"
"""The environment that takes joint targets. By default its scenario is that of `KittingUnseen`."""


def _register_environments() -> None:
    """Registers `kitting_drake/NAME-v0` for each key of `SCENARIOS`, "Scenario", and `JOINTS`."""
    usual, usual_name = SCENARIOS["KittingUnseen"]
    gymnasium.register(
        f"kitting_drake/{JOINTS}-v0",
        entry_point="kitting_drake.gym.joint_environment:JointEnvironment",
        kwargs={"scenario": str(paths.SCENARIOS / usual), "scenario_name": usual_name},
    )
    for name in ("Scenario", *SCENARIOS):
        file, scenario = SCENARIOS.get(name, (None, None))
        gymnasium.register(
            f"kitting_drake/{name}-v0",
            # The entry point is a string, so that Drake, which loads slowly, is imported only when
            # an environment is made.
            entry_point="kitting_drake.gym.environment:KittingEnvironment",
            # Use the full path, because the working directory may contain a file of the same name.
            kwargs={}
            if file is None
            else {"scenario": str(paths.SCENARIOS / file), "scenario_name": scenario},
        )


_register_environments()
