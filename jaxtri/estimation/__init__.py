"""Estimates from all measurements at once: two views, noises by gradient, the Cramer-Rao bound. No images, no files."""
