"""Filters of a stream: biases and the states of its targets epoch by epoch, numerics on a `Model` alone."""
