"""`python -m kitting_drake.draw_scenes`: draws static scenes of random tools for training."""

import argparse
import contextlib
import hashlib
import itertools
import os
import threading
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path

from rich.console import Console

from kitting_drake.common.command_line import count_type, run_command, seed_type
from kitting_drake.common.errors import UserError
from kitting_drake.common.files import alone_in, claim_folder, require_folder
from kitting_drake.common.paths import MODELS
from kitting_drake.common.processes import (
    LocalWorkers,
    ProcessCrashed,
    counting_bar,
    side_by_side,
)
from kitting_drake.common.provenance import source_digest, versions
from kitting_drake.common.rendering import require_rendering
from kitting_drake.policies.data.static_scenes import (
    StaticScene,
    StaticScenes,
    read_static_scenes,
    write_static_scenes,
)
from kitting_drake.static_scenes.drawing import draw_batch
from systems.signals import PixelGrid

_DRAWN_BY = (
    "kitting_drake.common.rendering",
    "kitting_drake.hkd",
    "kitting_drake.tasks",
    "kitting_drake.scenario",
    "kitting_drake.static_scenes",
    "kitting_drake.policies.data.static_scenes",
    "systems",
)
"""The packages and modules that determine the drawn scenes."""
_CATALOGUE = MODELS / "tools" / "catalogue.yaml"
"""The designs of tools that are varied at random."""
_DRAWN = ".drawn"
"""The suffix of the file that counts the scenes of an unfinished batch."""
_POLL = 0.5
"""The time between two readings of the `_DRAWN` files, in s."""
_MOST_BATCHES = 10_000
"""The largest number of batches of a seed."""


def main() -> int:
    """Parses the command line and draws; returns the exit code."""
    arguments = _parse()
    console = Console(quiet=arguments.quiet)
    require_rendering()
    folder = require_folder(arguments.output)
    with alone_in(folder):
        drawn_by = _drawn_by()
        identity = {"seed": arguments.seed, **drawn_by}
        claim_folder(folder, "settings.json", identity, of="set of scenes")
        path = folder / "scenes.h5"
        parts = _Parts(folder / "parts", arguments.seed, drawn_by)
        with LocalWorkers(arguments.workers or os.cpu_count() or 1) as workers:
            parts.draw(arguments.scenes, workers, console)
        scenes = parts.assemble(arguments.scenes, path)
    finals = sum(not len(scene.actions) for scene in scenes)
    console.print(
        f"{path} holds {len(scenes)} scenes; in {finals} of them nothing is left to do",
        highlight=False,
        markup=False,
    )
    return 0


def _drawn_by() -> dict[str, str]:
    """Returns the versions, sources and designs that determine the scenes of a seed."""
    catalogue = hashlib.sha256(_CATALOGUE.read_bytes()).hexdigest()[:16]
    return {**versions(), "code": source_digest(*_DRAWN_BY), "catalogue": catalogue}


class _Parts:
    """The files of the batches of scenes. They are kept, so that later runs can add batches."""

    def __init__(self, folder: Path, seed: int, drawn_by: dict[str, str]) -> None:
        """Reads the files of earlier runs.

        Args:
            folder: the folder of the files.
            seed: the seed of all draws.
            drawn_by: the versions, sources and designs that determine the scenes.

        Raises:
            UserError: a file was drawn with another seed or other versions, or is damaged.
        """
        self._folder, self._seed, self._drawn_by = require_folder(folder), seed, drawn_by
        self._counts = {}
        for path in folder.glob(f"*{_DRAWN}"):
            # Remove the counts that a killed process left behind.
            path.unlink()
        for path in folder.glob("batch_*.h5"):
            number = path.stem.removeprefix("batch_")
            if not number.isdecimal() or path != self.path(int(number)):
                raise UserError(f"{path} has an unexpected name: delete it")
            self._counts[int(number)] = len(self._read(int(number)).scenes)

    def _read(self, batch: int) -> StaticScenes:
        path = self.path(batch)
        try:
            found = read_static_scenes(path)
        except UserError as error:
            raise UserError(f"{error}: delete it to draw it again") from error
        mine = (self._seed_of(batch), self._drawn_by, PixelGrid())
        if (found.first_seed, found.versions, found.grid) != mine:
            raise UserError(
                f"{path} was drawn with another seed or another version of the code or its "
                "packages: delete it to draw it again"
            )
        return found

    def _seed_of(self, batch: int) -> int:
        return _MOST_BATCHES * self._seed + batch

    def path(self, batch: int) -> Path:
        return self._folder / f"batch_{batch:06d}.h5"

    def draw(self, count: int, workers: LocalWorkers, console: Console) -> None:
        """Draws batches until the first `count` scenes are complete."""
        begun = set(self._counts)

        def next_batch() -> int | None:
            if self._gapless() >= count:
                return None
            batch = next(i for i in range(_MOST_BATCHES) if i not in begun)
            # Once enough scenes exist, begin only batches that are missing between existing ones.
            if sum(self._counts.values()) >= count and batch > max(self._counts):
                return None
            begun.add(batch)
            return batch

        def draw(batch: int) -> tuple[int, int | ProcessCrashed]:
            seed = self._seed_of(batch)
            return batch, workers.run(_draw_part, self.path(batch), seed, self._drawn_by)

        with counting_bar(console, "scenes") as progress:
            task = progress.add_task("", total=count, completed=min(count, self._gapless()))
            with _every(_POLL, lambda: progress.update(task, completed=min(count, self._drawn()))):
                outcomes = side_by_side(draw, next_batch, workers=workers)
                self._count(outcomes)

    def _count(self, outcomes: Iterable[tuple[int, int | ProcessCrashed]]) -> None:
        """Stores the number of scenes of each batch as the batch ends."""
        for batch, outcome in outcomes:
            if isinstance(outcome, ProcessCrashed):
                raise UserError(
                    f"the process of batch {batch} ended without a result "
                    f"(exit code {outcome.exit_code}): run the same command to resume"
                )
            self._counts[batch] = outcome

    def _drawn(self) -> int:
        """The number of scenes drawn so far, including those of unfinished batches."""
        unfinished = 0
        for path in self._folder.glob(f"*{_DRAWN}"):
            # Ignore errors: the process that writes the file may have just removed or truncated it.
            with contextlib.suppress(OSError, ValueError):
                unfinished += int(path.read_text())
        return sum(self._counts.values()) + unfinished

    def _gapless(self) -> int:
        """Returns the number of scenes in the batches before the first missing batch."""
        batches = itertools.takewhile(self._counts.__contains__, itertools.count())
        return sum(self._counts[batch] for batch in batches)

    def assemble(self, count: int, path: Path) -> tuple[StaticScene, ...]:
        """Writes the first `count` scenes to one file; returns them."""
        batches = [self._read(batch).scenes for batch in sorted(self._counts)]
        # Leave out the ends of empty batches, for which no toolset fitted into a kit.
        ends = sorted({*itertools.accumulate(len(scenes) for scenes in batches)} - {0})
        everything = tuple(itertools.chain.from_iterable(batches))
        content = StaticScenes(PixelGrid(), everything, self._seed, self._drawn_by, tuple(ends))
        content = content.part(0, count)
        write_static_scenes(path, content)
        return content.scenes


def _draw_part(path: Path, seed: int, drawn_by: dict[str, str]) -> int:
    scenes: list[StaticScene] = []
    counter = path.with_suffix(_DRAWN)
    try:
        for scene in draw_batch(seed):
            scenes.append(scene)
            counter.write_text(str(len(scenes)))
    finally:
        counter.unlink(missing_ok=True)
    write_static_scenes(path, StaticScenes(PixelGrid(), tuple(scenes), seed, drawn_by))
    return len(scenes)


@contextlib.contextmanager
def _every(seconds: float, call: Callable[[], object]) -> Iterator[None]:
    """Calls a function periodically in a thread."""
    ended = threading.Event()

    def repeat() -> None:
        while not ended.wait(seconds):
            call()

    thread = threading.Thread(target=repeat, daemon=True)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join()


def _parse() -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        prog="python -m kitting_drake.draw_scenes",
        description="Draw static scenes of random tools and kits, to train a generalist. Run the "
        "same command again to resume.",
    )
    parser.add_argument("--scenes", type=count_type, default=3000, help="number of scenes (3000)")
    parser.add_argument("--seed", type=seed_type, default=0, help="seed of all draws (0)")
    parser.add_argument(
        "--workers", type=count_type, help=f"number of parallel processes ({os.cpu_count()})"
    )
    parser.add_argument("--output", type=Path, required=True, metavar="DIR")
    parser.add_argument("--quiet", action="store_true", help="print nothing but errors")
    return parser.parse_args()


if __name__ == "__main__":
    run_command(main)
