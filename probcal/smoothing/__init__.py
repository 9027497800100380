"""Smoothing: the epoch recursion, the damped joint mode, the automatic start and the information of the biases."""
