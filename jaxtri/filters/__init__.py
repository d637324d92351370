"""Filters over any model on a manifold. Nothing here knows of cameras, images or files."""
