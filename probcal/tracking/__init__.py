"""Detections without names: which belong together, and to what."""
