"""Particle filters and smoothers of a `Model`: numerics alone, for every motion, sensor and prior.

Filter, adaptive resampling and exact backward sampling are those of cuthbert (extra `probcal[particles]`); marginal
smoothing, backward sampling of linear cost, smoothed sums and conditional filters are here.
"""
