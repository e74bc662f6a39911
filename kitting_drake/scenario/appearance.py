"""The appearance of a scenario: colours, sheen and lights.

Drake's YAML loader needs evaluated annotations, hence no `from __future__ import annotations`.
"""

import dataclasses as dc

from systems.bounds import bounded


@dc.dataclass
class Fixed:
    """A fixed colour for a surface."""

    # Red, green and blue, 0 to 1.
    rgb: list[float] = bounded([0.5, 0.5, 0.5], 0.0, 1.0)


@dc.dataclass
class Drawn:
    """A random colour that the episode's seed determines."""

    # Whether all surfaces that match the pattern get the same colour. If not, each gets its own.
    shared: bool = False

    # Largest deviation of each channel from the model's own colour, 0 to 1. null allows any colour.
    spread: float | None = bounded(None, 0.0, 1.0)


Paint = Fixed | Drawn


@dc.dataclass
class Light:
    """A directional light."""

    # Direction of the light's rays in the world.
    direction: list[float] = bounded([0.0, 0.0, -1.0], -1.0, 1.0)

    # Brightness. At 1 a surface that faces the light shows its full colour.
    intensity: float = bounded(1.0, 0.0, 10.0)

    # Red, green and blue, 0 to 1.
    rgb: list[float] = bounded([1.0, 1.0, 1.0], 0.0, 1.0)


@dc.dataclass
class Appearance:
    """Colours, sheen and lights of a scene. By default, models have their own colours and a light
    is at each camera."""

    # Colours by pattern. Surfaces are named table/PART, fixtures/NAME/PART or objects/NAME/PART,
    # where PART is a visual of the SDFormat model. In a pattern, * matches any text. For example,
    # "fixtures/kit/*" paints the kit, whose parts are block and cavities. If several patterns match
    # a surface, the last one wins.
    paints: dict[str, Paint] = dc.field(default_factory=dict)

    # Sheen by pattern (see `paints`). Sheen is the fraction, 0 to 1, of a surface's pixels for
    # which the cameras measure no depth.
    sheen: dict[str, float] = dc.field(default_factory=dict)

    # The lights. If there are none, a light is at each camera.
    lights: list[Light] = dc.field(default_factory=list)

    # If given, one to three random lights replace the lights above. Their intensities add up to
    # 1.3 times a random factor between 1 - value and 1 + value.
    drawn_lights: float | None = bounded(None, 0.0, 1.0)

    def validate(self) -> None:
        """Checks the constraints that types and ranges cannot express.

        Raises:
            ValueError: a field violates a constraint. The message begins with the field's path,
                such as `appearance.lights`.
        """
        for pattern, share in self.sheen.items():
            if not 0.0 <= share <= 1.0:
                raise ValueError(f"appearance.sheen.{pattern} must be from 0 to 1, not {share:g}")
        for index, light in enumerate(self.lights):
            if not any(light.direction):
                raise ValueError(f"appearance.lights[{index}].direction must not be zero")
