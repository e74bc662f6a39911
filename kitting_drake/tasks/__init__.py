"""Tasks, with their scenes, goals and success predicates."""

from kitting_drake.tasks.kitting.arranged import ArrangedKitting
from kitting_drake.tasks.kitting.kitting import Kitting, ToolsetKitting
from kitting_drake.tasks.python_task import PythonTask
from kitting_drake.tasks.ravens.align_box_corner import AlignBoxCorner
from kitting_drake.tasks.ravens.assembling_kits import AssemblingKits
from kitting_drake.tasks.ravens.block_insertion import BlockInsertion
from kitting_drake.tasks.ravens.palletizing_boxes import PalletizingBoxes
from kitting_drake.tasks.ravens.place_red_in_green import PlaceRedInGreen
from kitting_drake.tasks.ravens.stack_block_pyramid import StackBlockPyramid

Task = (
    Kitting
    | ToolsetKitting
    | ArrangedKitting
    | AlignBoxCorner
    | BlockInsertion
    | PlaceRedInGreen
    | StackBlockPyramid
    | PalletizingBoxes
    | AssemblingKits
    | PythonTask
)
"""The types of tasks in a scenario; the first is the default."""

PAPER_TASKS = {task.title: task for task in (Kitting(), ToolsetKitting(split="test"))}
"""The paper's tasks (section V-B.1) by title, with default parameters."""

RAVENS_TASKS = (
    BlockInsertion(),
    PlaceRedInGreen(),
    PalletizingBoxes(),
    AlignBoxCorner(),
    StackBlockPyramid(),
)
"""The Ravens tasks (section V-B.2) in the order of table I, with default parameters."""
