"""The figure of `benchmark networks`: figure 6(c) of the paper, and related measurements."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

from kitting_drake.common.files import write_atomically
from kitting_drake.evaluation.quantities import count_text, seconds_text
from kitting_drake.reproduction.network_speed.speed_tables import (
    MEASURE_NAMES,
    METHOD_NAMES,
    RUNG_NAMES,
)

_METHODS = {"so2": "#009e73", "equivariant_transporter": "#e69f00", "transporter": "#56646f"}
"""Colour-blind safe colours; the first two are the paper's green and orange."""
_PARTS = {
    "pick_position": "#0072b2",
    "pick_angle": "#d55e00",
    "phi": "#56b4e9",
    "psi": "#a6d8f2",
    "search": "#bbbbbb",
}
_RUNGS = {
    "escnn_float32": "#c9c9c9",
    "escnn_bfloat16": "#9a9a9a",
    "ours_float32": "#7fcdb4",
    "ours_bfloat16": "#009e73",
}
_STYLE = {
    "font.size": 9.0,
    "axes.edgecolor": "0.5",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.titlelocation": "left",
    "axes.titlesize": 10.5,
    "axes.titleweight": "bold",
    "axes.axisbelow": True,
    "grid.color": "0.9",
    "legend.frameon": False,
}


def draw_networks(measured: dict[str, Any], path: Path) -> None:
    """Draws the figure of a benchmark.

    Args:
        measured: the result of `benchmark_networks`.
        path: a .png file.

    Raises:
        UserError: the file cannot be written.
    """
    # Import matplotlib lazily.
    import matplotlib
    from matplotlib.figure import Figure

    presets = list(dict.fromkeys(row["preset"] for row in measured["pick_angle"]))
    top = [f"angle {preset}" for preset in presets for _ in range(6 // len(presets))]
    machine = measured["machine"]
    place = machine["cpu"] if machine["device"] == "cpu" else machine["device"]
    threads = f"{machine['threads']} thread{'s' if machine['threads'] > 1 else ''}"
    image = io.BytesIO()
    with matplotlib.rc_context(_STYLE):
        figure = Figure(figsize=(14.0, 9.0), layout="constrained")
        figure.get_layout_engine().set(w_pad=0.12, h_pad=0.08)
        axes = figure.subplot_mosaic(
            [top, ["decision"] * 3 + ["folding"] * 3, ["levels"] * 3 + ["folding"] * 3],
            height_ratios=(1.0, 0.9, 0.75),
        )
        figure.suptitle(
            f"Cost of the networks: {place}, {threads}, "
            f"{measured['inference_type']} unless stated otherwise",
            x=0.01,
            horizontalalignment="left",
            fontsize=13,
        )
        for preset in presets:
            _draw_pick_angle(axes[f"angle {preset}"], measured, preset)
        _draw_decisions(axes["decision"], measured)
        _draw_folding(axes["folding"], measured)
        _draw_levels(axes["levels"], measured)
        figure.savefig(image, format="png", dpi=150)
    write_atomically(path, image.getvalue())


def _draw_pick_angle(axis: Any, measured: dict[str, Any], preset: str) -> None:
    """Draws parameters as bars and times as lines."""
    rows = [row for row in measured["pick_angle"] if row["preset"] == preset]
    counts = sorted({row["orientations"] for row in rows})
    places = {n: index for index, n in enumerate(counts)}
    # The Transporter has no separate angle model, so only its picking time is shown.
    barred = [method for method in _METHODS if method != "transporter"]
    width = 0.32
    for index, method in enumerate(barred):
        chosen = [row for row in rows if row["method"] == method]
        bars = axis.bar(
            [places[row["orientations"]] + (index - 0.5) * width for row in chosen],
            [row["parameters"] for row in chosen],
            width,
            color=_METHODS[method],
            alpha=0.35,
        )
        for bar, row in zip(bars, chosen, strict=True):
            axis.annotate(
                count_text(row["parameters"]),
                (bar.get_x() + 0.5 * width, 0.0),
                xytext=(0, 3),
                textcoords="offset points",
                horizontalalignment="center",
                fontsize=8,
            )
    most = max(row["parameters"] for row in rows if row["method"] in barred)
    axis.set_ylim(0.0, 1.6 * most)
    axis.yaxis.set_major_formatter(lambda count, _: count_text(count))
    axis.set_ylabel("parameters (bars)")
    axis.set_xticks(list(places.values()), [str(n) for n in counts])
    axis.set_xlabel("orientations N")
    axis.set_title(f"Pick angle: parameters and time, preset {preset}")

    _draw_times(axis.twinx(), rows, places)


def _draw_times(times: Any, rows: list[dict[str, Any]], places: dict[int, int]) -> None:
    """Draws a line for each method, labelled with its times."""
    from matplotlib.ticker import LogLocator

    times.spines["right"].set_visible(True)
    times.set_yscale("log")
    times.set_ylabel("time of an inference (lines)")
    for method, colour in _METHODS.items():
        chosen = [row for row in rows if row["method"] == method and row["seconds"]]
        name = METHOD_NAMES[method] + (": all its picking" if method == "transporter" else "")
        times.plot(
            [places[row["orientations"]] for row in chosen],
            [row["seconds"] for row in chosen],
            "o-",
            color=colour,
            markersize=5,
            linewidth=1.8,
            label=name,
        )
        for row in chosen:
            beside = [
                other["seconds"]
                for other in rows
                if other["seconds"] and other["orientations"] == row["orientations"]
            ]
            below = len(beside) > 1 and row["seconds"] == min(beside)
            times.annotate(
                seconds_text(row["seconds"]),
                (places[row["orientations"]], row["seconds"]),
                xytext=(0, -6 if below else 6),
                textcoords="offset points",
                horizontalalignment="center",
                verticalalignment="top" if below else "bottom",
                fontsize=8,
                color=colour,
            )
    low, high = times.get_ylim()
    times.set_ylim(low * (low / high) ** 0.3, high * (high / low) ** 0.3)
    # One tick per decade, or three if there are few decades.
    times.yaxis.set_major_locator(LogLocator(subs=(1.0,) if high > 100 * low else (1.0, 2.0, 5.0)))
    times.yaxis.set_major_formatter(lambda seconds, _: seconds_text(seconds))
    times.minorticks_off()
    times.legend(loc="upper left", ncols=3, fontsize=8, columnspacing=1.0, handlelength=1.5)


def _draw_decisions(axis: Any, measured: dict[str, Any]) -> None:
    """Draws a stacked bar of the parts for each method and N; very long bars are cut off."""
    rows = [row for row in measured["decision"] if row["seconds"]]
    if not rows:
        axis.text(0.5, 0.5, "every decision takes too long here", horizontalalignment="center")
        return
    others = [row["seconds"] for row in rows if row["method"] != "transporter"]
    # Leave room for the legend.
    limit = 1.5e3 * max(others or [row["seconds"] for row in rows])
    place, places, labels, groups = 0.0, [], [], {}
    for method in dict.fromkeys(row["method"] for row in rows):
        chosen = [row for row in rows if row["method"] == method]
        for row in chosen:
            bottom = 0.0
            for part, colour in _PARTS.items():
                taken = 1e3 * row["parts"][part]
                axis.bar(place, taken, 0.8, bottom=bottom, color=colour)
                bottom += taken
            cut = bottom > limit
            axis.text(
                place,
                0.985 * limit if cut else bottom + 0.01 * limit,
                f"{1e3 * row['seconds']:.0f}" + ("\n↑" if cut else ""),
                horizontalalignment="center",
                verticalalignment="top" if cut else "bottom",
                color="white" if cut else "black",
                fontsize=7.5,
            )
            places.append(place)
            labels.append(str(row["orientations"]))
            place += 1.0
        groups[method] = place - 0.5 * (len(chosen) + 1)
        place += 0.8
    axis.set_xticks(places, labels)
    for method, middle in groups.items():
        axis.annotate(
            METHOD_NAMES[method],
            (middle, 0.0),
            xycoords=axis.get_xaxis_transform(),
            xytext=(0, -20),
            textcoords="offset points",
            horizontalalignment="center",
            verticalalignment="top",
        )
    axis.set_ylim(0.0, limit)
    axis.set_ylabel("milliseconds")
    axis.grid(True, axis="y")
    axis.set_title(f"A whole decision at N orientations, preset {measured['preset']}")
    handles = [axis.bar(0, 0, color=colour) for colour in _PARTS.values()]
    names = [part.replace("_", " ") for part in _PARTS]
    axis.legend(handles, names, loc="upper left", ncols=3, fontsize=8, columnspacing=1.0)


def _draw_folding(axis: Any, measured: dict[str, Any]) -> None:
    """Draws the speed-ups over plain escnn as bars, grouped by measure."""
    folding = measured["folding"]
    rungs = list(folding["rungs"])
    height = 0.8 / len(rungs)
    for index, rung in enumerate(rungs):
        speed_up = folding["speed_up"][rung]
        places = [group + (index + 0.5) * height for group in range(len(MEASURE_NAMES))]
        values = [speed_up[measure] for measure in MEASURE_NAMES]
        axis.barh(places, values, 0.9 * height, color=_RUNGS[rung], label=RUNG_NAMES[rung])
        for row, value, measure in zip(places, values, MEASURE_NAMES, strict=True):
            taken = seconds_text(folding["rungs"][rung][measure]["seconds"])
            axis.annotate(f" {value:.2f}x  ({taken})", (value, row), verticalalignment="center")
    for group, name in enumerate(MEASURE_NAMES.values()):
        axis.text(0.0, group - 0.04, name, verticalalignment="bottom", fontweight="bold")
    most = max(max(row.values()) for row in folding["speed_up"].values())
    axis.set_xlim(0.0, 1.25 * most)
    axis.set_ylim(len(MEASURE_NAMES) - 0.1, -0.25)
    axis.set_yticks([])
    axis.axvline(1.0, color="0.5", linewidth=0.8, linestyle="--")
    axis.grid(True, axis="x")
    axis.set_xlabel("times faster than plain escnn in float32")
    axis.set_title(f"The same networks, plain escnn and folded, preset {measured['preset']}")
    axis.legend(loc="upper center", bbox_to_anchor=(0.5, -0.09), ncols=len(rungs), fontsize=8.5)


def _draw_levels(axis: Any, measured: dict[str, Any]) -> None:
    """Draws alpha's time by level as bars, labelled with the convolutions' share of the peak."""
    levels = measured["alpha_levels"]["levels"]
    names = [row["level"] for row in levels]
    convolution = [1e3 * row["convolution_s"] for row in levels]
    rest = [1e3 * row["rest_s"] for row in levels]
    axis.bar(names, convolution, 0.8, color=_PARTS["pick_position"], label="convolutions")
    axis.bar(names, rest, 0.8, bottom=convolution, color=_PARTS["search"], label="all else")
    for index, row in enumerate(levels):
        axis.annotate(
            f"{row['convolution_share']:.0%}",
            (index, 1e3 * row["seconds"]),
            xytext=(0, 2),
            textcoords="offset points",
            horizontalalignment="center",
            fontsize=8,
        )
    peak = measured["peak"][measured["inference_type"]]["best"]
    axis.set_ylim(0.0, 1.35e3 * max(row["seconds"] for row in levels))
    axis.tick_params(axis="x", labelsize=8)
    axis.set_ylabel("milliseconds")
    axis.grid(True, axis="y")
    axis.set_title(
        f"Alpha by level; above: convolutions' share of {count_text(peak)}FLOP/s, the peak"
    )
    axis.legend(loc="upper center", ncols=2, fontsize=8)
