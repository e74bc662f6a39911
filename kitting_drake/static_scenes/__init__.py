"""Static training scenes, rendered without physics."""
