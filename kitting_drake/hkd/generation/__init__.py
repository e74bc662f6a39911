"""Tools made from their catalogue entries, or drawn at random."""
