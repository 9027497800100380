"""Poses of sensors told from detections without names: separable likelihoods, and beliefs that spread over pairs."""
