"""The files and pictures of a run. Nothing here is computed that a run does not hold."""
