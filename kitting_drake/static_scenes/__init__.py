"""Static training scenes: random tools and kits, rendered without running episodes."""
