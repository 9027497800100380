"""Does full Bayes mix? r_hat, effective draws, seconds and who sampled, on every model and recording.

uv run python benchmarks/mixing.py --case plaza --case bearings
uv run python benchmarks/mixing.py --method nuts

`Collapsed()` as it is (the joint sampler takes over where its collapse does not fit), from the automatic start. A line
a case: largest r_hat and least ESS over the biases, steps from one draw to the next, shares of the leaps on the frame
and of the proposals along orbits that were taken, seconds of the whole fit with compiling. Recordings that lie beside
the project are left out where they do not.
"""

import argparse
import sys
import time
from pathlib import Path

from probcal import InputError
from probcal.inference.fit import calibrate
from probcal.inference.methods import METHODS

sys.path.insert(0, str(Path(__file__).parents[1] / "models"))
import large_network
import microphones
import networks
import plaza
import plaza_free
import radars
import receivers
import robots
import sflab
import tdoa_flight
import thesis

DATA = Path(__file__).parents[2] / "shared" / "data"


def network(name, **given):
    """A network of `models/networks.py`, run 0."""
    return lambda: (networks.setting(0, name, **given)[0], None)


def shipped(module):
    """A model with its own data, and the prior that it states."""
    return lambda: (module.problem(), getattr(module, "PRIOR", None))


def recorded(module, *parts, **given):
    """A model with a recording that lies beside the project."""
    return lambda: (module.problem(DATA.joinpath(*parts), **given), None)


CASES = {"plaza": shipped(plaza), "plaza free": shipped(plaza_free)}
CASES |= {name: (lambda name=name: (radars.setting(0, scenario=name, share=0.3)[0], None)) for name in ("C1", "C2")}
CASES |= {name: network(name) for name in networks.NAMES}
CASES |= {"corners, student": network("corners", tails="student")}
CASES |= {"large": lambda: (large_network.problem(side=12, targets=2, epochs=100), None)}
CASES |= {"thesis": shipped(thesis), "microphones": shipped(microphones)}
CASES |= {
    "sflab": recorded(sflab, "sflab_mic_toa", "dataset_1_exp2.mat"),
    "flight": recorded(tdoa_flight, "uwb_tdoa"),
    "robots": recorded(robots, "mrclam", "MRCLAM_Dataset6"),
    "receivers": recorded(receivers, "mlat_locards", "set_1.csv"),
}


def line(name, method, key=0):
    """The line of a case."""
    try:
        problem, prior = CASES[name]()
    except (InputError, FileNotFoundError) as error:
        return f"| {name} | left out: {error} |"
    began = time.perf_counter()
    tree, answer = calibrate(
        problem, method, prior=prior if prior is not None and method.takes(prior) else None, key=key
    )
    seconds = time.perf_counter() - began
    group = tree["calibration"].to_dataset()
    stats = tree["sample_stats"].to_dataset()
    leaps = stats["leapt" if "leapt" in stats else "acceptance_rate"] if "swung" in stats or "leapt" in stats else None
    taken = " | ".join("" if one is None else f"{float(one.mean()):.2f}" for one in (leaps, stats.get("roamed")))
    size = f"{problem.model.biases} biases, {len(problem.measurements.time)} rows"
    return (
        f"| {name} | {size} | {answer.method.name} | {tree.attrs['status']} | {float(group['r_hat'].max()):.3f} |"
        f" {float(group['ess'].min()):.0f} | {tree.attrs['thin']:.0f} | {taken} | {seconds:.0f} |"
    )


def main():
    """Print the table."""
    ask = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    ask.add_argument("--case", action="append", choices=list(CASES))
    ask.add_argument("--method", default="collapsed", choices=[n for n, (m, _) in METHODS.items() if not m.climbs])
    ask.add_argument("--key", type=int, default=0)
    given = ask.parse_args()
    head = ("case", "size", "who sampled", "status", "r_hat", "least ess", "steps", "leaps", "orbits", "s")
    print(f"| {' | '.join(head)} |", "|---" * len(head) + "|", sep="\n", flush=True)
    for name in given.case or CASES:
        print(line(name, METHODS[given.method][0], given.key), flush=True)


if __name__ == "__main__":
    main()
