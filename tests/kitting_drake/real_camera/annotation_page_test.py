"""The annotation page's server answers requests like those of a browser."""

import http.client
import io
import json
import shutil
import socket
import struct
import threading
import time
import urllib.error
import urllib.request
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from kitting_drake.common.errors import UserError
from kitting_drake.policies.data.demonstrations import read_demonstrations
from kitting_drake.policies.data.learning import Learning
from kitting_drake.real_camera.annotation_page import AnnotationServer
from kitting_drake.real_camera.outside_demonstrations import (
    convert,
    find_demonstrations,
    read_observation,
)
from systems.signals import PlanarPose
from tests.kitting_drake.demonstrate_test import BENCH, POSES, write_step


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("steps")
    for number, shade in (("1", 30), ("2", 90)):
        write_step(folder / "demo" / f"step{number}", shade, None)
    return folder


@pytest.fixture
def folder(written: Path, tmp_path: Path) -> Path:
    """A demonstration of two steps without actions."""
    return Path(shutil.copytree(written, tmp_path / "bench"))


@pytest.fixture
def server(folder: Path) -> Iterator[AnnotationServer]:
    with AnnotationServer(find_demonstrations(folder)[0], BENCH) as server:
        thread = threading.Thread(target=server.serve_forever, args=(0.01,))
        thread.start()
        yield server
        server.shutdown()
        thread.join()


def get(server: AnnotationServer, path: str) -> bytes:
    with urllib.request.urlopen(server.url + path, timeout=60) as answer:
        return answer.read()


def post(
    server: AnnotationServer, path: str, content: Any, kind: str = "application/json"
) -> tuple[int, Any]:
    """Posts content to the server; returns the response's status and JSON."""
    data = content if isinstance(content, bytes) else json.dumps(content).encode()
    request = urllib.request.Request(server.url + path, data, {"Content-Type": kind})
    try:
        with urllib.request.urlopen(request, timeout=60) as answer:
            return answer.status, json.load(answer)
    except urllib.error.HTTPError as error:
        return error.code, json.load(error)


def test_a_demonstration_can_be_annotated_and_corrected(server: AnnotationServer, folder: Path):
    page = get(server, "").decode()
    assert page.startswith("<!doctype html>")
    assert "http" not in page, "the page loads nothing from elsewhere"
    told = json.loads(get(server, "steps"))
    assert [step["name"] for step in told["steps"]] == ["demo/step1", "demo/step2"]
    assert not any("action" in step for step in told["steps"])
    first = {"stop": False, **POSES, "object": "red"}
    assert post(server, "steps/0", {**first, "place": POSES["pick"]})[0] == 200
    assert post(server, "steps/0", first)[0] == 200
    status, told = post(server, "steps/1", {"stop": True})
    assert status == 200
    assert told["steps"][0]["action"]["object"] == "red"
    assert told["steps"][1]["action"]["stop"] is True
    written = json.loads((folder / "demo" / "step1" / "action.json").read_text())
    assert "category" not in written
    assert set(written["pick"]) == {"x", "y", "yaw"}
    path = folder.parent / "mine.h5"
    convert(folder, BENCH, Learning(), path)
    (demonstration,) = read_demonstrations(path).demonstrations
    (step,) = demonstration.steps
    assert step.place == PlanarPose(*(POSES["place"][key] for key in ("x", "y", "yaw")))
    assert demonstration.final is not None


def test_images_have_one_pixel_per_grid_pixel(server: AnnotationServer, folder: Path):
    seen = read_observation(folder / "demo" / "step2", BENCH)
    for name in ("color", "height"):
        image = np.asarray(Image.open(io.BytesIO(get(server, f"steps/1/{name}.png"))))
        assert image.shape == (*BENCH.grid.shape, 3)
        if name == "color":
            expected = np.rint(255 * seen.rgb.transpose(1, 2, 0))
            np.testing.assert_array_equal(image[seen.valid], expected[seen.valid])
        else:
            row, col = np.rint(BENCH.grid.to_pixel((0.45, -0.2))).astype(int)
            assert image[row, col].min() > 200, "the block is white"


@pytest.mark.parametrize(
    ("path", "content", "status", "message"),
    [
        ("steps/0", b"{", 400, "not JSON"),
        ("steps/0", {"pick": POSES["pick"]}, 400, "demo/step1: place must have x, y and yaw"),
        ("steps/0", {**POSES, "pick": {"x": 9, "y": 0, "yaw": 0}}, 400, "outside the workspace"),
        ("steps/0", {"stop": True}, 400, "steps come after it"),
        ("steps/0", b" " * 200_000, 400, "at most 100000 bytes"),
        ("steps/2", POSES, 404, "there is no /steps/2"),
        ("steps/../x", POSES, 404, "there is no"),
    ],
)
def test_invalid_actions_are_rejected(
    server: AnnotationServer, folder: Path, path: str, content: Any, status: int, message: str
):
    found, answer = post(server, path, content)
    assert found == status
    assert message in answer["error"]
    assert not list(folder.rglob("action.json"))


def test_other_origins_are_rejected(server: AnnotationServer, folder: Path):
    """A web page of another site can make a browser send plain text to this server. The site's host
    name can also be made to point to this server."""
    assert post(server, "steps/0", POSES, "text/plain")[0] == 403
    connection = http.client.HTTPConnection(*server.server_address)
    connection.request("GET", "/steps", headers={"Host": "elsewhere.example:80"})
    assert connection.getresponse().status == 403
    # A browser omits the port from `Host` if it is 80.
    connection = http.client.HTTPConnection(*server.server_address)
    connection.request("GET", "/steps", headers={"Host": "localhost"})
    assert connection.getresponse().status == 200
    connection.close()
    assert not list(folder.rglob("action.json"))


def test_a_closed_connection_is_not_an_error(
    server: AnnotationServer, capfd: pytest.CaptureFixture[str]
):
    """A person may go to the next step before the images have loaded."""
    get(server, "steps/0/color.png")
    for _ in range(5):
        connection = socket.create_connection(server.server_address)
        connection.sendall(b"GET /steps/0/color.png HTTP/1.1\r\nHost: localhost:1\r\n\r\n")
        # Let `close` reset the connection while the server responds.
        connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
        connection.close()
    get(server, "steps")
    time.sleep(0.5)
    assert capfd.readouterr().err == ""


def test_an_invalid_step_is_reported_and_can_be_corrected(server: AnnotationServer, folder: Path):
    step = folder / "demo" / "step1"
    (step / "action.json").write_text("{")
    assert "not JSON" in json.loads(get(server, "steps"))["steps"][0]["error"]
    assert "error" not in post(server, "steps/0", POSES)[1]["steps"][0]
    (folder / "demo" / "step2" / "front_depth.npy").unlink()
    with pytest.raises(urllib.error.HTTPError) as raised:
        get(server, "steps/1/color.png")
    assert "demo/step2: camera front" in json.load(raised.value)["error"]


def test_a_server_that_cannot_start_raises_a_user_error(server: AnnotationServer, folder: Path):
    steps = find_demonstrations(folder)[0]
    with pytest.raises(UserError, match="port "):
        AnnotationServer(steps, BENCH, server.server_address[1])
    (folder / "demo" / "step1" / "front_color.png").unlink()
    with pytest.raises(UserError, match="step demo/step1: camera front"):
        AnnotationServer(steps, BENCH)
