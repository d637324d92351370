"""Cameras, poses, and the relations of two and three views: functions of arrays. No filters, no images, no files."""
