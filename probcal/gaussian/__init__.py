"""One Gaussian at a point: the epoch recursion, the modes, the linearised problem and its solves, at any size."""
