"""The files and pictures of a run, and in words what runs and sources hold. Nothing is computed that they do not."""
