"""`track`: tracks of other data with a calibration applied."""

import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from probcal.cli.files import write_csv
from probcal.cli.models import load_fit, load_problem, load_truth, on_network
from probcal.cli.progress import shown
from probcal.files import Outputs
from probcal.inference import track
from probcal.inference.progress import Monitor
from probcal.results.read import tracks
from probcal.results.scores import scores
from probcal.status import INVALID
from probcal.wings import of_wing


def run(model: Path, data: Path | None, given: Mapping[str, Any], network: Path | None, calibration: Path,
    outputs: Outputs, *, smoother: str, particles: int, seed: int,
) -> int:  # fmt: skip
    """Tracks of other data with a calibration applied: time, target, each state component with its sd."""
    known = load_fit(calibration, network)
    module, problem = load_problem(model, data, (), given)
    problem = on_network(problem, network)
    truth = load_truth(module, model, data, problem, given)
    with shown() as progress:
        Monitor(progress).enter("tracks", "track")
        tree = track(
            problem,
            known,
            smoother=of_wing("Particles")(particles) if smoother == "particles" else None,
            key=seed,
        )
    frame = tracks(tree)
    out = outputs.folder / outputs.names[0]
    with outputs.writing():
        write_csv(frame, out)
    found = scores(tree, truth) if truth is not None else {}
    if "position_rmse_after" in found:
        print(f"position RMSE before {found['position_rmse_before']:.3f} m, after {found['position_rmse_after']:.3f} m")
    print(f"written: {out} ({len(frame)} epochs)")
    if tree.attrs.get("message"):
        print(tree.attrs["message"], file=sys.stderr)
    return 1 if tree.attrs.get("status") in INVALID else 0
