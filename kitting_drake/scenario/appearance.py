"""The part of a scenario that says how things look: colours, sheen and lights.

Annotations are evaluated here: Drake's YAML loader reads the types of fields, not their texts.
"""

import dataclasses as dc

from systems.bounds import bounded


@dc.dataclass
class Fixed:
    """A colour."""

    # Red, green and blue.
    rgb: list[float] = bounded([0.5, 0.5, 0.5], 0.0, 1.0)


@dc.dataclass
class Drawn:
    """A colour drawn from the seed."""

    # One colour for all surfaces that are named; else each gets its own.
    shared: bool = False

    # How far each channel may be from the model's own colour; null: any colour.
    spread: float | None = bounded(None, 0.0, 1.0)


Paint = Fixed | Drawn


@dc.dataclass
class Light:
    """A light as far away as the sun."""

    # Where it shines to, in the world, and how bright it is; 1 lights a surface fully.
    direction: list[float] = bounded([0.0, 0.0, -1.0], -1.0, 1.0)
    intensity: float = bounded(1.0, 0.0, 10.0)
    rgb: list[float] = bounded([1.0, 1.0, 1.0], 0.0, 1.0)


@dc.dataclass
class Appearance:
    """How things look. By default as their models say, lit from each camera."""

    # Paint by surface: a pattern (* is anything) of table/PART, fixtures/NAME/PART and
    # objects/NAME/PART, with the names of visuals in the SDFormat models. Later ones win.
    paints: dict[str, Paint] = dc.field(default_factory=dict)

    # The share of a surface that gives a depth camera no depth, 0 to 1, by the same patterns.
    sheen: dict[str, float] = dc.field(default_factory=dict)

    # The lights; none: each camera lights what it sees.
    lights: list[Light] = dc.field(default_factory=list)

    # Draw the lights from the seed instead: one to three, by so much brighter or darker than full
    # light at most.
    drawn_lights: float | None = bounded(None, 0.0, 1.0)

    def validate(self) -> None:
        """Checks what neither types nor ranges say.

        Raises:
            ValueError: one sentence that begins with the path of a field, `appearance.x`.
        """
        for pattern, share in self.sheen.items():
            if not 0.0 <= share <= 1.0:
                raise ValueError(f"appearance.sheen.{pattern} must be from 0 to 1, not {share:g}")
        for index, light in enumerate(self.lights):
            if not any(light.direction):
                raise ValueError(f"appearance.lights[{index}].direction must not be zero")
