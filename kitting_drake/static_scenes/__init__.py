"""Static scenes to learn from, rendered without physics."""
