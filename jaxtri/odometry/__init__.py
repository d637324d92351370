"""From tracks or frames to a trajectory: the recursive tracker, its driver on the host, and a run over video."""
