"""A user's script: a recording with jittered stamps and rotation matrices, from its files to a report."""

import sys
from pathlib import Path

import numpy as np

import probcal
from probcal import EA, Channel, ConstantVelocity, Network, Node, Problem, Truth, sensor
from probcal.geometry import attitude, bearing, norm
from probcal.report import write_report

folder = Path(sys.argv[1])


@sensor(range=Channel("m", std=0.5), azimuth=Channel("rad", std=0.005, wrap=True))
def scanner(target, pose):
    line = target.position - pose.position
    return dict(range=norm(line), azimuth=bearing(line) - pose.heading)


masts = np.load(folder / "masts.npz")  # places (N, 2), rotations (N, 2, 2)
turned = attitude(masts["rotations"])["heading"]
given = zip(masts["places"], turned, strict=True)
nodes = [Node(f"mast_{k}", place, heading, scale={"heading": 0.1}) for k, (place, heading) in enumerate(given)]
problem = Problem(Network([scanner.on(n) for n in nodes]), ConstantVelocity(0.5), folder / "rows.csv", epoch=0.5)
print(probcal.observability(problem).attrs["status"])

tree = probcal.assess(problem, probcal.fit(problem, EA()))
times = problem.measurements.time
halves = [problem.select(times < np.median(times)), problem.select(times >= np.median(times))]
moved = probcal.changes(*(probcal.fit(half, EA()) for half in halves), names=("first half", "second half"))
print(moved["finding"].to_dataset()["sentence"].values[0])

probcal.add_scores(tree, Truth(folder / "truth.csv"), align="rigid")
print(f"{tree.attrs['status']}, {tree.attrs['position_rmse_after_rigid']:.2f} m from the truth")
tree.probcal.tracks().to_csv(folder / "tracks.csv", index=False)
write_report(tree, folder / "report.html")
