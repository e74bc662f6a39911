"""Writes the whole dataset with a manifest, for other simulators (`hkd build`)."""

import hashlib
import os
import shutil
import tempfile
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any

import kitting_drake
from kitting_drake.common.errors import UserError
from kitting_drake.common.files import write_json
from kitting_drake.hkd.kits.kit import Kit, make_kit
from kitting_drake.hkd.kits.parameters import KitParameters
from kitting_drake.hkd.mjcf import kit_mjcf, tool_mjcf
from kitting_drake.hkd.tools.tool import Tool, load_tool
from kitting_drake.hkd.tools.toolsets import PAPER_SPLITS, TOOLSETS_SEED, tool_pools, toolsets


def build_dataset(
    folder: Path, progress: Callable[[int, int], None], *, mjcf: bool = False
) -> dict[str, Any]:
    """Writes the paper's tools and kits as SDFormat models with their meshes, and `manifest.json`.

    The folder appears atomically. Tools are in `tools/NAME/`, kits in `kits/SPLIT_000/`. Models
    refer to their meshes by relative paths, so each model's folder can be moved.

    Args:
        folder: the folder to write; it must be empty or not exist.
        progress: a function called with the number of kits written and the number of all kits.
        mjcf: whether to write MuJoCo's `NAME.xml` and `kit.xml` beside each SDFormat model.

    Returns:
        The manifest.

    Raises:
        UserError: `folder` is a file, is not empty or cannot be written.
    """
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise UserError(f"{folder} is not an empty folder: delete it, or give another --output")
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=folder.parent, prefix=".building-") as scratch:
            root = Path(scratch) / "dataset"
            manifest = _write_dataset(root, progress, mjcf=mjcf)
            if folder.exists():
                folder.rmdir()
            os.rename(root, folder)
    except OSError as error:
        raise UserError(f"cannot write the dataset to {folder}: {error.strerror}") from error
    return manifest


def _write_dataset(
    root: Path, progress: Callable[[int, int], None], *, mjcf: bool
) -> dict[str, Any]:
    parameters = KitParameters()
    tools: dict[str, Tool] = {}
    for split in PAPER_SPLITS:
        for pool in tool_pools(split).values():
            tools |= {name: load_tool(name) for name in pool}
    for name, tool in tools.items():
        shutil.copytree(tool.directory, root / "tools" / name)
        if mjcf:
            (root / "tools" / name / f"{name}.xml").write_text(tool_mjcf(tool.sdf))
    chosen = [
        (split, index, names)
        for split in PAPER_SPLITS
        for index, names in enumerate(toolsets(split))
    ]
    kits = []
    for done, (split, index, names) in enumerate(chosen):
        kit = make_kit([tools[name] for name in names], parameters)
        name = f"{split}_{index:03d}"
        shutil.copytree(kit.sdf.parent, root / "kits" / name)
        if mjcf:
            (root / "kits" / name / "kit.xml").write_text(kit_mjcf(kit.sdf))
        kits.append(_kit_entry(name, split, kit, root))
        progress(done + 1, len(chosen))
    manifest = {
        "dataset": "Hand-tool Kitting Dataset",
        "made_by": f"kitting_drake {kitting_drake.__version__}",
        "units": "metres, kilograms, radians",
        "toolsets_seed": TOOLSETS_SEED,
        "kit_parameters": asdict(parameters),
        "tools": [_tool_entry(tool, root) for tool in tools.values()],
        "kits": kits,
    }
    write_json(root / "manifest.json", manifest)
    return manifest


def _tool_entry(tool: Tool, root: Path) -> dict[str, Any]:
    folder = root / "tools" / tool.name
    return {
        "name": tool.name,
        "category": tool.category,
        "split": tool.split,
        "length": tool.length,
        "width": tool.width,
        "height": tool.height,
        "mass": tool.mass,
        "grasp": asdict(tool.grasp),
        **_models(folder / tool.sdf.name, root),
        "sha256": _checksums(folder, root),
    }


def _kit_entry(name: str, split: str, kit: Kit, root: Path) -> dict[str, Any]:
    folder = root / "kits" / name
    return {
        "name": name,
        "split": split,
        **_models(folder / kit.sdf.name, root),
        "size": list(kit.size),
        # The pose of each seated tool's frame T in the kit's frame K; yaw is about the kit's z.
        "tools": [
            {"name": tool.name, "position": [pose.x, pose.y, pose.z], "yaw": pose.yaw}
            for tool, pose in zip(kit.tools, kit.layout.poses, strict=True)
        ],
        "sha256": _checksums(folder, root),
    }


def _models(sdf: Path, root: Path) -> dict[str, str]:
    """Returns the path of a model in each format that was written, relative to `root`."""
    paths = {"sdf": sdf, "mjcf": sdf.with_suffix(".xml")}
    return {key: path.relative_to(root).as_posix() for key, path in paths.items() if path.exists()}


def _checksums(folder: Path, root: Path) -> dict[str, str]:
    return {
        path.relative_to(root).as_posix(): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted(folder.iterdir())
    }
