"""Makes docs/film.webp: a kit filled by the learned policy, with the maps behind each decision.

Run it from the root of the repository: `.venv/bin/python docs/examples/make_film.py [FILE.webp]`.
"""

import io
import sys
from pathlib import Path

import numpy as np
from PIL import Image
from pydrake.geometry import ColorRenderCamera

from kitting_drake.common.paths import SCENARIOS
from kitting_drake.common.rendering import add_film_renderer, look_at, picture_camera
from kitting_drake.evaluation.decision_figure import draw_maps
from kitting_drake.scenario import load_scenario
from kitting_drake.station import build_station, with_policy
from systems.pick_place_parameters import Mode

SEED = 0
WIDTH, HEIGHT = 720, 400
STRIP = 202  # Pixels under the picture, for the maps.
PERIOD = 1 / 16  # Simulated time between two frames, in s; also their time in the film.
HOLD = 32  # Frames for which the picture stands still at a decision.
LAST = 40  # Times that the last frame is repeated.
X_WC = look_at([1.68, -0.62, 1.10], [0.45, -0.01, 0.08])


class Film:
    """Renders the station, puts the maps under the picture, and keeps the frames."""

    def __init__(self, station):
        self._station = station
        self._camera = ColorRenderCamera(
            picture_camera(add_film_renderer(station.scene_graph), width=WIDTH, height=HEIGHT)
        )
        self._maps = None
        self._frames = []

    def decided(self, observation, decision):
        """Shows the maps of a decision under all further frames; `with_policy` calls it."""
        png = draw_maps(observation, decision, width=WIDTH)
        self._maps = Image.open(io.BytesIO(png)).convert("RGB")

    @property
    def shown(self):
        """The maps under the next frame; None before the first decision."""
        return self._maps

    def take(self, context, count=1):
        """Renders one frame and adds it `count` times."""
        scene_graph = self._station.scene_graph
        own = scene_graph.GetMyContextFromRoot(context)
        query = scene_graph.get_query_output_port().Eval(own)
        image = query.RenderColorImage(self._camera, scene_graph.world_frame_id(), X_WC)
        frame = Image.new("RGB", (WIDTH, HEIGHT + STRIP), "white")
        frame.paste(Image.fromarray(np.array(image.data[:, :, :3])))
        if self._maps is not None:
            frame.paste(self._maps, (0, HEIGHT))
        self._frames += [frame] * count

    def save(self, path):
        """Writes the frames as an animation that repeats."""
        first, *others = self._frames
        first.save(
            path,
            save_all=True,
            append_images=others,
            duration=round(1000 * PERIOD),
            loop=0,
            quality=70,
            method=4,
        )
        print(f"{path}: {len(self._frames) * PERIOD:.0f} s, {path.stat().st_size / 1e6:.2f} MB")


def main(path=Path("docs/film.webp"), seconds=60.0):
    scenario = load_scenario(SCENARIOS / "kitting_seen.yaml")
    station = build_station(scenario, SEED, SCENARIOS)
    film = Film(station)
    simulator = station.make_simulator(with_policy(station, film.decided))
    context = simulator.get_context()
    simulator.Initialize()
    while context.get_time() < seconds and station.mode(context) != Mode.DONE:
        before = film.shown
        simulator.AdvanceTo(context.get_time() + PERIOD)
        if film.shown is not None:
            film.take(context, 1 if film.shown is before else HOLD)
    film.take(context, LAST)
    film.save(path)


if __name__ == "__main__":
    main(*map(Path, sys.argv[1:]))
