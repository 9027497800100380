"""Angles a full turn off, or too noisy to be wrapped."""

import numpy as np

from probcal.analysis.check import Case, Checked, check
from probcal.analysis.findings import Finding

NEAR_TURN = 1.0  # rad of a full turn within which a residual tells of a missing wrap
WIDE = np.pi / 3  # noise std in rad above which a wrapped angle is ambiguous
FAR = 2 * np.pi / 3  # rad beyond which a wrapped residual may belong to the next turn
SHARE = 0.01  # of a channel's data beyond which its residuals are


@check(causes=["misfit", "other"])
def check_wrapping(case: Case) -> Checked:
    """Findings on angles: residuals a turn off without `wrap`, or too wide with it."""
    fit, found, left = case.fit, list[Finding](), case.tree["residual"].to_dataset()
    innovation, std = left["after"].values, left["std"].values
    for kind in fit.problem.network.types:
        for name, channel in kind.expand(fit.problem.network.dimension):
            ours = [s.name for s in fit.problem.network.sensors if s.type == kind]
            mine = (fit.data["channel"] == name).to_numpy() & fit.data["sensor"].isin(ours).to_numpy()
            turn = {"rad": 1.0, "deg": np.pi / 180}.get(channel.unit)
            if turn is None or not mine.any():
                continue
            residual, spread = np.abs(innovation[mine]) * turn, std[mine] * turn
            subject, off = f"{kind.name}.{name}", np.abs(residual - 2 * np.pi) < NEAR_TURN
            if channel.period is None and off.any():
                text = f"{off.sum()} of {len(off)} residuals lie a full turn off: declare wrap=True"
            elif channel.period is not None and np.median(spread) > WIDE:
                text = f"its noise std of {np.median(spread):.2f} rad is too wide for an angle: wrapping is ambiguous"
            elif channel.period is not None and (residual > FAR).mean() > SHARE:
                text = f"{(residual > FAR).sum()} of {len(off)} residuals lie beyond 120 deg: wrapping is ambiguous"
            else:
                continue
            found.append(Finding("wrapping", subject, f"{subject}: {text}"))
    return Checked(findings=found)
