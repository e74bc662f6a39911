"""MuJoCo models of tools and kits agree with their SDFormat models."""

import xml.etree.ElementTree as ElementTree
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from manifold3d import Manifold
from scipy.spatial.transform import Rotation

from kitting_drake.common.errors import UserError
from kitting_drake.hkd import dataset
from kitting_drake.hkd.kits.kit import Kit, make_kit
from kitting_drake.hkd.kits.parameters import KitParameters
from kitting_drake.hkd.mjcf import block_prisms, kit_mjcf, tool_mjcf
from kitting_drake.hkd.tools.scaling import scaled_tool
from kitting_drake.hkd.tools.tool import Tool, load_tool
from kitting_drake.hkd.tools.toolsets import toolsets

TOOLS = ("claw_hammer", "combination_wrench")


@pytest.fixture(scope="module")
def kit() -> Kit:
    return make_kit([load_tool(name) for name in TOOLS], KitParameters())


def compiled(text: str, folder: Path) -> Any:
    mujoco = pytest.importorskip("mujoco")
    spec = mujoco.MjSpec.from_string(text)
    spec.meshdir = str(folder)
    return spec.compile()


@pytest.mark.parametrize("length", [None, 0.16])
def test_mass_inertia_and_friction_are_those_of_the_sdformat(length: float | None):
    tool: Tool = load_tool("claw_hammer")
    tool = tool if length is None else scaled_tool(tool, length)
    model = compiled(tool_mjcf(tool.sdf), tool.directory)
    assert model.body_mass[1] == pytest.approx(tool.mass, rel=1e-3)
    link = ElementTree.parse(tool.sdf).getroot().find("model/link/inertial")
    centre = [float(item) for item in link.findtext("pose").split()[:3]]
    np.testing.assert_allclose(model.body_ipos[1], centre, atol=1e-9)
    rows = (("ixx", "ixy", "ixz"), ("ixy", "iyy", "iyz"), ("ixz", "iyz", "izz"))
    inertia = [[float(link.findtext(f"inertia/{key}")) for key in row] for row in rows]
    axes = Rotation.from_quat(model.body_iquat[1], scalar_first=True).as_matrix()
    found = axes @ np.diag(model.body_inertia[1]) @ axes.T
    np.testing.assert_allclose(found, inertia, atol=1e-3 * np.max(inertia))
    assert model.nq == 7
    collides = model.geom_contype > 0
    assert 1 < collides.sum() < len(collides)
    assert np.allclose(model.geom_friction[collides, 0], 0.5)


def test_the_prisms_fill_the_block(kit: Kit):
    mesh = trimesh.load_mesh(kit.sdf.parent / "kit.obj")
    solid = Manifold()
    for prism in block_prisms(mesh.vertices, mesh.faces):
        solid += Manifold.hull_points(prism)
    # Steps replace the bevels; they add about as much volume as they remove.
    assert solid.volume() == pytest.approx(mesh.volume, rel=1e-4)
    model = compiled(kit_mjcf(kit.sdf), kit.sdf.parent)
    assert model.nq == 0
    assert np.allclose(model.geom_friction[model.geom_contype > 0, 0], 0.3)


def test_a_seated_tool_stays_in_its_cavity(kit: Kit):
    mujoco = pytest.importorskip("mujoco")
    tool, goal = kit.tools[1], kit.goal(1)
    world = mujoco.MjSpec()
    for prefix, text, folder, place in (
        ("kit_", kit_mjcf(kit.sdf), kit.sdf.parent, [0, 0, 0]),
        ("tool_", tool_mjcf(tool.sdf), tool.directory, [goal.x, goal.y, goal.z + 0.001]),
    ):
        spec = mujoco.MjSpec.from_string(text)
        spec.meshdir = str(folder)
        world.attach(spec, prefix=prefix, frame=world.worldbody.add_frame(pos=place))
    model = world.compile()
    data = mujoco.MjData(model)
    for _ in range(500):
        mujoco.mj_step(model, data)
    assert np.abs(data.qpos[:3] - [goal.x, goal.y, goal.z]).max() < 1e-3
    assert np.abs(data.qvel).max() < 0.02


@pytest.mark.slow
def test_the_dataset_has_mjcf_on_request(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(dataset, "toolsets", lambda split: toolsets(split)[:1])
    manifest = dataset.build_dataset(tmp_path / "hkd", lambda done, total: None, mjcf=True)
    for entry in (manifest["tools"][0], manifest["kits"][0]):
        path = tmp_path / "hkd" / entry["mjcf"]
        assert entry["mjcf"] in entry["sha256"]
        compiled(path.read_text(), path.parent)


def test_an_invalid_model_is_rejected(tmp_path: Path):
    path = tmp_path / "broken.sdf"
    for text, tools, kits in (
        ("", "no element found", "no element found"),
        ("<sdf/>", "model", "model/link"),
        ("<sdf><model><link/></model></sdf>", "name", "kit.obj"),
        ("<sdf><model name='x'><link name='y'/></model></sdf>", "inertial", "kit.obj"),
    ):
        path.write_text(text)
        with pytest.raises(UserError, match=f"tool: .*{tools}"):
            tool_mjcf(path)
        with pytest.raises(UserError, match=f"kit: .*{kits}"):
            kit_mjcf(path)
