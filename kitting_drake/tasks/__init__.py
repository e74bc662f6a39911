"""Tasks: what stands on the table, what is to be brought about, and when it is success."""

from kitting_drake.tasks.kitting.config import ArrangedKitting, Kitting, ToolsetKitting

Task = Kitting | ToolsetKitting | ArrangedKitting
"""The variants of a scenario's `task:`; the first is the default."""

PAPER_TASKS = {task.title: task for task in (Kitting(), ToolsetKitting(split="test"))}
"""The tasks of the paper (section V-B.1) by their titles; nothing in them is changed."""
