"""The page of results, generated from result files."""
