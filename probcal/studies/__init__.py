"""Many fits: studies over simulated runs, and simulation-based calibration of a method."""
