"""The appearance of a scenario: colours, sheen and lights.

Drake's YAML loader needs evaluated annotations, hence no `from __future__ import annotations`.
"""

import dataclasses as dc

from systems.bounds import bounded


@dc.dataclass
class Fixed:
    """A given colour."""

    # Red, green and blue, 0 to 1.
    rgb: list[float] = bounded([0.5, 0.5, 0.5], 0.0, 1.0)


@dc.dataclass
class Drawn:
    """A colour drawn from the seed."""

    # True: all surfaces that match the pattern get the same colour. False: each gets its own.
    shared: bool = False

    # Largest deviation of each channel from the model's own colour. null: any colour.
    spread: float | None = bounded(None, 0.0, 1.0)


Paint = Fixed | Drawn


@dc.dataclass
class Light:
    """A directional light."""

    # Direction of its rays in the world.
    direction: list[float] = bounded([0.0, 0.0, -1.0], -1.0, 1.0)

    # Brightness; a light of 1 lights a surface fully.
    intensity: float = bounded(1.0, 0.0, 10.0)

    # Red, green and blue, 0 to 1.
    rgb: list[float] = bounded([1.0, 1.0, 1.0], 0.0, 1.0)


@dc.dataclass
class Appearance:
    """Colours, sheen and lights. By default the models' own colours, lit from each camera."""

    # Paints by pattern. A pattern matches surfaces named table/PART, fixtures/NAME/PART or
    # objects/NAME/PART; PART is a visual of the SDFormat model, and * matches any text. For
    # example, "fixtures/kit/*" paints the kit: its parts are block and cavities. If several
    # patterns match a surface, the last one wins.
    paints: dict[str, Paint] = dc.field(default_factory=dict)

    # The share, 0 to 1, of a surface's pixels that have no depth. The keys are patterns as above.
    sheen: dict[str, float] = dc.field(default_factory=dict)

    # If empty, a light at each camera.
    lights: list[Light] = dc.field(default_factory=list)

    # If given, one to three lights drawn from the seed replace these. Their total brightness is
    # between 1 - value and 1 + value times normal.
    drawn_lights: float | None = bounded(None, 0.0, 1.0)

    def validate(self) -> None:
        """Checks the constraints that types and ranges cannot express.

        Raises:
            ValueError: a field violates one. The message begins with its path, `appearance.x`.
        """
        for pattern, share in self.sheen.items():
            if not 0.0 <= share <= 1.0:
                raise ValueError(f"appearance.sheen.{pattern} must be from 0 to 1, not {share:g}")
        for index, light in enumerate(self.lights):
            if not any(light.direction):
                raise ValueError(f"appearance.lights[{index}].direction must not be zero")
