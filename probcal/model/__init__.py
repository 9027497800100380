"""The waist: one model of a problem, a pytree that every algorithm reads and that knows no label."""
