"""Where the mean of a normalised error must lie, by its own distribution."""

from scipy.stats import chi2


def nees_interval(d: int, runs: float, level: float = 0.999) -> tuple[float, float]:
    """Two-sided interval of the mean of `runs` independent NEES, or NIS, of d dimensions: chi2(runs d) / runs.

    Frames of one run are correlated: give the number of runs, or of frames over the time in which their correlation
    is lost.
    """
    low, high = chi2.ppf([(1 - level) / 2, (1 + level) / 2], runs * d) / runs
    return float(low), float(high)
