"""The two filters that Yu et al. 2006 compare with."""
