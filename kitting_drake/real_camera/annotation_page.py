"""A local web page on which a person clicks pick, place and jaw direction on the observation o_t.

The server listens on 127.0.0.1 only. It answers these requests in HTML, JSON or PNG:

- `GET /`: the page, one file of HTML and JavaScript.
- `GET /steps`: the grid, the jaws, and the name and action of each step.
- `GET /steps/N/color.png` and `height.png`: o_t, with one image pixel per grid pixel.
- `POST /steps/N` with the content of an `action.json`: writes it to the folder of step N.

An error is answered with the status 400, 403 or 404, and with a sentence in `{"error": ...}`.
"""

from __future__ import annotations

import dataclasses
import io
import json
import re
import sys
import threading
from collections.abc import Sequence
from functools import lru_cache
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from kitting_drake.common.errors import UserError
from kitting_drake.real_camera.calibrations.calibration import Calibration, calibration_digest
from kitting_drake.real_camera.outside_demonstrations import (
    StepFolder,
    check_action,
    read_observation,
)
from kitting_drake.real_camera.step_actions import NAME, parse_action, read_action, write_action
from systems.hand_geometry import MAX_OPENING, PAD_LENGTH
from systems.signals import Observation

_PAGE = Path(__file__).with_name("annotation_page.html")
_HOST = "127.0.0.1"
_LONGEST = 100_000
"""The largest size of an action in JSON, in bytes."""
_LEAST_RANGE = 0.02
"""White stands for at least this height, in metres, to keep the noise of an empty table dark."""
_UNSEEN = np.array([60, 0, 90], np.uint8)
"""The colour (RGB) of pixels that no camera sees."""


class AnnotationServer(ThreadingHTTPServer):
    """The HTTP server of the annotation page; `serve_forever` runs it until it is shut down."""

    def __init__(self, steps: Sequence[StepFolder], calibration: Calibration, port: int = 0):
        """Opens the port.

        Args:
            steps: the steps to annotate, at least one.
            calibration: the cameras' calibration.
            port: the port on 127.0.0.1; 0 for any free port.

        Raises:
            UserError: the first step's frames are unusable, or the port is taken.
        """
        self.steps = tuple(steps)
        self.calibration = calibration
        self._lock = threading.Lock()
        self._read = lru_cache(maxsize=8)(lambda path: read_observation(path, calibration))
        # Read one observation now, so that a wrong calibration is reported before the page opens.
        self.observation(0)
        try:
            super().__init__((_HOST, port), _Handler)
        except OSError as error:
            raise UserError(
                f"port {port} cannot be used ({error.strerror}): give another one"
            ) from error

    @property
    def url(self) -> str:
        """The address of the page."""
        return f"http://{_HOST}:{self.server_address[1]}/"

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Reports errors, except those of connections that the browser closed."""
        if not isinstance(sys.exception(), ConnectionError):
            super().handle_error(request, client_address)

    def observation(self, index: int) -> Observation:
        """Returns the observation o_t of a step.

        Raises:
            UserError: the step's frames are unusable.
        """
        with self._lock:
            return self._read(self.steps[index].path)

    def describe(self) -> dict[str, Any]:
        """Returns the grid, the jaws and the steps as JSON for the page, in metres and radians."""
        grid = self.calibration.grid
        return {
            "grid": {
                key: getattr(grid, key) for key in ("x_min", "y_min", "resolution", "rows", "cols")
            },
            "jaws": {"opening": MAX_OPENING, "pad": PAD_LENGTH},
            "steps": [self._describe(step) for step in self.steps],
        }

    def _describe(self, step: StepFolder) -> dict[str, Any]:
        found: dict[str, Any] = {"name": step.name, "last": step.is_last}
        if not (step.path / NAME).exists():
            return found
        try:
            action = read_action(step.path, self.calibration.grid)
            check_action(step, action, self.calibration)
        except UserError as error:
            return {**found, "error": str(error)}
        return {**found, "action": action.as_dict()}

    def save(self, index: int, record: Any) -> None:
        """Writes the action of a step.

        Raises:
            UserError: the action is invalid. An existing file is then kept.
            MachineError: the file cannot be written. An existing file is then kept.
        """
        step = self.steps[index]
        action = dataclasses.replace(
            parse_action(record, self.calibration.grid, step.name),
            calibration=calibration_digest(self.calibration),
        )
        check_action(step, action, self.calibration)
        write_action(step.path, action)


class _Handler(BaseHTTPRequestHandler):
    server: AnnotationServer

    def do_GET(self) -> None:
        """Serves the page, the steps, or an image."""
        image = re.fullmatch(r"/steps/(\d+)/(color|height)\.png", self.path)
        if not self._is_local():
            self._fail(HTTPStatus.FORBIDDEN, "open the page as 127.0.0.1 or localhost")
        elif self.path == "/":
            self._send("text/html; charset=utf-8", _PAGE.read_bytes())
        elif self.path == "/steps":
            self._send_json(self.server.describe())
        elif image and int(image[1]) < len(self.server.steps):
            try:
                observation = self.server.observation(int(image[1]))
            except UserError as error:
                self._fail(HTTPStatus.BAD_REQUEST, str(error))
                return
            draw = draw_color if image[2] == "color" else draw_height
            self._send("image/png", draw(observation))
        else:
            self._fail(HTTPStatus.NOT_FOUND, f"there is no {self.path}")

    def do_POST(self) -> None:
        """Saves an action."""
        step = re.fullmatch(r"/steps/(\d+)", self.path)
        # Require JSON, because browsers let pages of other origins send it only with permission.
        if not self._is_local() or self.headers.get_content_type() != "application/json":
            self._fail(HTTPStatus.FORBIDDEN, "an action must be JSON sent by the page itself")
            return
        if not step or int(step[1]) >= len(self.server.steps):
            self._fail(HTTPStatus.NOT_FOUND, f"there is no {self.path}")
            return
        try:
            self.server.save(int(step[1]), self._body())
        except UserError as error:
            self._fail(HTTPStatus.BAD_REQUEST, str(error))
            return
        self._send_json(self.server.describe())

    def log_message(self, format: str, *args: Any) -> None:
        """Does nothing, because the page itself reports what happens."""

    def _is_local(self) -> bool:
        """Whether the request's Host header names this machine.

        Other names are refused, because a web page could give this machine another name and so
        reach this server (DNS rebinding).
        """
        name = self.headers.get("Host", "").split(":")[0]
        return name in (_HOST, "localhost")

    def _body(self) -> Any:
        length = self.headers.get("Content-Length", "")
        if not length.isdecimal() or int(length) > _LONGEST:
            raise UserError(f"an action must have a Content-Length of at most {_LONGEST} bytes")
        try:
            return json.loads(self.rfile.read(int(length)))
        except (ValueError, RecursionError) as error:
            raise UserError(f"the action is not JSON: {error}") from error

    def _send_json(self, value: Any, status: HTTPStatus = HTTPStatus.OK) -> None:
        self._send("application/json", json.dumps(value).encode(), status)

    def _fail(self, status: HTTPStatus, reason: str) -> None:
        # The request may not have been read, so the connection cannot be reused.
        self.close_connection = True
        self._send_json({"error": reason}, status)

    def _send(self, kind: str, content: bytes, status: HTTPStatus = HTTPStatus.OK) -> None:
        self.send_response(status)
        self.send_header("Content-Type", kind)
        self.send_header("Content-Length", str(len(content)))
        self.send_header("Cache-Control", "no-store")
        self.end_headers()
        self.wfile.write(content)


def draw_color(observation: Observation) -> bytes:
    """Draws the colours of o_t as a PNG of (rows, cols), with row 0 at the top."""
    rgb = np.rint(255 * observation.rgb.transpose(1, 2, 0)).astype(np.uint8)
    return _png(rgb, observation)


def draw_height(observation: Observation) -> bytes:
    """Draws the heights of o_t as a PNG of (rows, cols).

    Black is the table. White is the 99.5th percentile of the heights, but at least `_LEAST_RANGE`.
    """
    height = observation.height
    top = max(float(np.percentile(height, 99.5)), _LEAST_RANGE)
    grey = np.rint(255 * np.clip(height / top, 0, 1)).astype(np.uint8)
    return _png(np.repeat(grey[..., None], 3, axis=2), observation)


def _png(rgb: NDArray[np.uint8], observation: Observation) -> bytes:
    drawn = np.where(observation.valid[..., None], rgb, _UNSEEN)
    file = io.BytesIO()
    Image.fromarray(drawn).save(file, "PNG")
    return file.getvalue()
