"""The page of results, made from result files alone."""
