"""Writes the table that compares the size of every network with that of the original network.

The parameters are counted on the networks themselves.
"""

from __future__ import annotations

from functools import cache

from kitting_drake.reproduction.page.markdown import markdown_table
from kitting_drake.reproduction.page.runs import LEARNED, METHODS

ORIENTATIONS = 36
"""The N at which networks are counted. Only the Equivariant Transporter depends on it."""
PRESETS = ("small", "matched", "paper")
COLUMNS = ("alpha", "beta", "phi", "psi")
ORIGINAL = {"alpha": 4_537_185, "beta": 835_888, "phi": 4_537_185, "psi": 4_537_185}
"""The numbers of parameters of the authors' SO(2) networks."""

_TEXT = f"""\
#### Parameters of every network

The table has the trainable parameters at N = {ORIENTATIONS}, and the *ratio* to those of the
original method. The only picking network of the Transporter, f_pick, is under alpha.

The presets `small` and `matched` differ in the baselines only. In both, our networks are 25 times
smaller than the paper's. In `matched`, the Transporter is also 25 times smaller than its original,
and the pick-angle network (beta) of the Equivariant Transporter has about as many parameters as
ours.

The paper's method was counted in its authors' code. The Equivariant Transporter's paper gives
4.54 M for alpha, and phi and psi are the same U-net; the authors' pick-angle network has 0.90 M.
For the Transporter, our preset `paper` stands for it, with its widths and 43 layers.
"""


_ORIGINAL_TEXTS = {
    "so2": [*(f"{ORIGINAL[name]:,}" for name in COLUMNS), f"{sum(ORIGINAL.values()):,}"],
    "equivariant_transporter": ["4.54 M", "0.90 M", "4.54 M", "4.54 M", "14.5 M"],
}
"""The numbers of parameters of the original networks, singly and together, as text."""


@cache
def count_parameters(method: str, preset: str) -> dict[str, int]:
    """Counts the parameters of each network.

    Args:
        method: a key of `METHODS`.
        preset: the size of the networks.

    Returns:
        The counts by the names in `COLUMNS`. For the Transporter, `alpha` has the count of f_pick,
        and there is no `beta`.
    """
    # Import torch lazily.
    from kitting_drake.policies.networks.architecture import NetworkConfig
    from kitting_drake.policies.networks.methods import make_networks

    networks = make_networks(NetworkConfig(method, preset, ORIENTATIONS))
    counts = {
        name: sum(weight.numel() for weight in network.parameters())
        for name, network in networks.named_children()
    }
    return {name.replace("f_pick", "alpha"): count for name, count in counts.items()}


def original_parameters(method: str) -> int:
    """Returns the total number of parameters of a method's original networks."""
    counts = ORIGINAL if method == "so2" else count_parameters(method, "paper")
    return sum(counts.values())


def parameters_section() -> str:
    """Writes the table of parameters, with an explanation, in Markdown."""
    rows = []
    for method in LEARNED:
        by_counts: dict[tuple[int | None, ...], list[str]] = {}
        for preset in PRESETS:
            found = count_parameters(method, preset)
            by_counts.setdefault(tuple(found.get(name) for name in COLUMNS), []).append(preset)
        for counts, presets in by_counts.items():
            total = sum(count for count in counts if count is not None)
            texts = ["-" if count is None else f"{count:,}" for count in counts]
            share = f"1 / {original_parameters(method) / total:.1f}"
            rows.append([METHODS[method], ", ".join(presets), *texts, f"{total:,}", share])
        if method in _ORIGINAL_TEXTS:
            rows.append([METHODS[method], "*original*", *_ORIGINAL_TEXTS[method], ""])
    headings = ["method", "preset", *COLUMNS, "all", "ratio to *original*"]
    return f"{_TEXT}\n{markdown_table(headings, rows, left_columns=2)}"
