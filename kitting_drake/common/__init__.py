"""Code that all other packages share: files, processes, errors, paths and command lines."""
