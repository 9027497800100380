"""Components with one value an axis that a sensor type declares, and sensors on three nodes, against NumPy formulas."""

import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd
import pytest

from probcal import (
    Bias,
    Channel,
    ConstantVelocity,
    InputError,
    Motion,
    Network,
    Node,
    Problem,
    RandomWalk,
    Target,
    White,
    fit,
    priors,
    sensor,
    simulate,
    write_nodes,
)
from probcal.inference import MAP
from probcal.model.model import At

CV = Target(ConstantVelocity(0.5), {"position": (20.0, 5.0), "velocity": (1.0, 1.0)})
WIND = RandomWalk("wind", "m/s", 0.1, (2.0, 3.0), per_axis=True)
SPIN = White("spin", "1/s", 1.0, per_axis=True)


@sensor(travel=Channel("s", std=0.01), vectors=("wind",))
def sodar(target, pose, *, delay=Bias("s", 0.1)):
    """Sound that travels from a node to the target with the wind, at 340 m/s in still air."""
    line = target.position - pose.position
    distance = jnp.sqrt(line @ line)
    return {"travel": distance / (340.0 + target.wind @ line / distance) + delay}


@sensor(power=Channel("dB", std=0.5), vectors=("boresight",))
def dish(target, pose):
    """Gain by the angle from a stated boresight, a vector of the node that may be off."""
    line = target.position - pose.position
    return {"power": 10.0 * (line @ pose.boresight) / jnp.sqrt(line @ line)}


@sensor(difference=Channel("m", std=0.3), bend=Channel("m", std=0.3))
def trio(target, first, second, third, *, offset=Bias("m", 1.0)):
    """Distances to three nodes: the second less the first, and the third less the mean of both."""
    a, b, c = (jnp.sqrt(jnp.sum((target.position - pose.position) ** 2)) for pose in (first, second, third))
    return {"difference": b - a + offset + second.clock, "bend": c - 0.5 * (a + b)}


def problem_of(placed, motion, d):
    """One row of each sensor."""
    rows = [{"time": 0.0, "sensor": s.name} | {n: 1.0 for n, _ in s.type.expand(d)} for s in placed]
    return Problem(Network(placed), motion, pd.DataFrame(rows))


def difference(function, x):
    """Central differences (outputs, inputs)."""
    steps = 1e-5 * np.eye(len(x))
    return np.stack([(function(x + h) - function(x - h)) / 2e-5 for h in steps], -1)


@jax.jit
def evaluated(model, at):
    return model.predict(at), model.linearise(at, expected=True)


def compared(problem, x, z, formula):
    """Prediction and Jacobians of the one row at a state (n,) and biases z, against a formula of both."""
    with jax.enable_x64(True):
        (found,), (lin,) = evaluated(problem.model, At((np.array(x)[None],), np.array(z), np.zeros(0)))
    np.testing.assert_allclose(np.asarray(found)[0], formula(x, z), rtol=1e-12)
    block, rows = problem.model.blocks[0], problem.model.rows[0]
    by_state, by_bias = difference(lambda s: formula(s, z), x), difference(lambda b: formula(x, b), z)
    np.testing.assert_allclose(np.asarray(lin.state)[0], by_state[:, list(block.used)], atol=1e-8)
    unread = [i for i in range(len(x)) if i not in block.used]
    assert np.abs(by_state[:, unread]).max(initial=0.0) < 1e-9
    summed = np.zeros((len(by_bias), len(z) + 1))
    for column, m in enumerate(np.asarray(rows.bias)[0]):
        summed[:, m] += np.asarray(lin.bias)[0, :, column]
    np.testing.assert_allclose(summed[:, : len(z)], by_bias, atol=1e-8)
    assert np.abs(by_bias).max() > 1e-3


@pytest.mark.parametrize("d", [2, 3])
def test_a_declared_vector_of_the_target_is_read_whole(d):
    place = np.array([3.0, -4.0, 1.0])[:d]
    motion = Target(CV.motion + SPIN + WIND, CV.start)
    problem = problem_of([sodar.on(Node("n", place, scale=2.0))], motion, d)
    assert problem.epochs[0].components[-d:] == tuple(f"wind_{axis}" for axis in "xyz"[:d])
    assert problem.labels == (*(f"n.position_{axis}" for axis in "xyz"[:d]), "n.delay")

    def formula(x, z):
        line = x[:d] - place - 2.0 * z[:d]
        distance = np.linalg.norm(line)
        return np.array([distance / (340.0 + x[-d:] @ line / distance) + 0.1 * z[d]])

    random = np.random.default_rng(d)
    compared(problem, 20.0 * random.standard_normal(4 * d), random.standard_normal(d + 1), formula)


@pytest.mark.parametrize("d", [2, 3])
def test_a_declared_vector_of_a_node_has_a_bias_an_axis(d):
    place, ahead = np.array([3.0, -4.0, 1.0])[:d], np.array([0.6, 0.8, 0.3])[:d]
    placed = [dish.on(Node("n", place, boresight=ahead, survey={"boresight": 0.1}))]
    problem = problem_of(placed, CV, d)
    assert problem.labels == tuple(f"n.boresight_{axis}" for axis in "xyz"[:d])

    def formula(x, z):
        line = x[:d] - place
        return np.array([10.0 * line @ (ahead + 0.1 * z) / np.linalg.norm(line)])

    random = np.random.default_rng(d)
    compared(problem, 20.0 * random.standard_normal(2 * d), random.standard_normal(d), formula)


@pytest.mark.parametrize("d", [2, 3])
def test_a_sensor_uses_three_nodes(d):
    places = np.array([[0.0, 0.0, 1.0], [10.0, 2.0, -1.0], [-3.0, 8.0, 4.0]])[:, :d]
    spread = {"a": {"position": 0.5}, "b": {"clock": 3.0}, "c": {"position": 0.5}}
    nodes = [Node(name, place, scale=spread[name]) for name, place in zip(spread, places, strict=True)]
    problem = problem_of([trio.on(*nodes)], CV, d)
    assert problem.network.sensors[0].name == "a-b-c"
    assert problem.labels == tuple(
        [f"a.position_{x}" for x in "xyz"[:d]] + ["b.clock"] + [f"c.position_{x}" for x in "xyz"[:d]] + ["a-b-c.offset"]
    )

    def formula(x, z):
        moved = places.copy()
        moved[0] += 0.5 * z[:d]
        moved[2] += 0.5 * z[d + 1 : 2 * d + 1]
        a, b, c = np.linalg.norm(x[:d] - moved, axis=1)
        return np.array([b - a + z[-1] + 3.0 * z[d], c - 0.5 * (a + b)])

    random = np.random.default_rng(d)
    compared(problem, 20.0 * random.standard_normal(2 * d), random.standard_normal(2 * d + 2), formula)


@pytest.mark.ci
def test_a_network_of_three_node_sensors_is_simulated_and_fitted():
    """Six sensors on five nodes with a declared wind beside: errors over sds are of the size of one.

    Of 9 squared scores below one on average under the prior, the mean passes 3 in fewer than 1e-4 of seeds.
    """
    places = [(0, 0), (60, 0), (60, 60), (0, 60), (30, -10)]
    nodes = [Node(f"n{k}", p, scale=1.0 if k > 2 else None) for k, p in enumerate(places)]
    sets = [(0, 1, 2), (1, 2, 3), (2, 3, 4), (0, 2, 4), (0, 3, 1), (1, 4, 2)]
    network = Network([trio.on(*(nodes[k] for k in own)) for own in sets] + [sodar.on(nodes[0], name="s")])
    motion = Target(CV.motion + WIND, CV.start)
    run = simulate(network, motion, np.arange(20.0), key=3)
    problem = Problem(network, motion, run.table)
    found = fit(problem, MAP(), prior=priors.Gaussian())["calibration"].to_dataset()
    true = np.array([run.truth.biases[label] for label in problem.labels])
    assert np.mean(((found["mean"].values - true) / found["sd"].values) ** 2) < 3.0


class Vane(Motion):
    """A target that rests, in a wind of one number or of two."""

    def __init__(self, wind):
        self.wind = wind

    def view(self, state):
        return {"position": state, "wind": self.wind * jnp.ones_like(state) if self.wind > 1 else state[0]}

    def initial(self, key):
        return jax.random.normal(key, (2,))

    def sample(self, key, state, dt, levels):
        return state


@sensor(speed=Channel("m/s", std=1.0))
def cup(target, pose):
    """Reads the wind as one number, since it does not declare it."""
    return {"speed": target.wind + target.position[0]}


AT = Node("n", (0.0, 0.0))
SCALAR = RandomWalk("wind", "m/s", 0.1, (2.0, 3.0))
REFUSED = [
    (lambda: problem_of([sodar.on(AT)], CV.motion + SCALAR, 2),
     "sensor sodar reads target.wind as a vector; declare it with per_axis=True"),
    (lambda: problem_of([sodar.on(AT)], Vane(1), 2), "sensor sodar reads target.wind as a vector; declare it"),
    (lambda: problem_of([cup.on(AT)], CV.motion + WIND, 2),
     'sensor cup reads target.wind as a number, but the motion has one value an axis; declare it, as in @sensor'),
    (lambda: problem_of([cup.on(AT)], Vane(2), 2), "reads target.wind as a number, but the motion has one"),
    (lambda: problem_of([sodar.on(AT)], CV, 2), 'add it, as in motion + White("wind", unit, std, per_axis=True)'),
    (lambda: problem_of([dish.on(AT)], CV, 2), 'state it, as in Node(..., boresight=(0.0, 0.0))'),
    (lambda: problem_of([dish.on(Node("n", (0, 0), boresight=1.0))], CV, 2),
     'sensor dish reads pose.boresight as a vector, but node "n" states one number; state one an axis, 2 of them'),
    (lambda: problem_of([tower.on(Node("n", (0, 0), mast=(1.0, 2.0)))], CV, 2),
     'sensor tower reads pose.mast, of which node "n" states one an axis, as a single number; declare it'),
    (lambda: Node("n", (0, 0), mast=(1.0, 2.0, 3.0)), "must be a finite number, got (1.0, 2.0, 3.0), or 2 of them"),
    (lambda: Node("n", (0, 0), mast=(1.0, np.inf)), "or 2 of them, one an axis"),
    (lambda: Node("n", (0, 0), clock=(1.0, 2.0)), "clock must be a finite number, got (1.0, 2.0)"),
    (lambda: sensor(range=Channel("m"), vectors="wind"), "sensor vectors='wind': give the names of components, as in"),
    (lambda: sensor(range=Channel("m"))(lambda target: {"range": 1.0}), "with one pose for each node, found (target)"),
    (lambda: trio.on(AT, AT), "trio uses 3 node(s), 2 given"),
]  # fmt: skip


@sensor(height=Channel("m", std=1.0))
def tower(target, pose):
    return {"height": target.position[1] - pose.mast}


@pytest.mark.parametrize(("ask", "text"), REFUSED, ids=[text[:40] for _, text in REFUSED])
def test_a_vector_where_a_number_is_meant_says_what_to_do(ask, text):
    with pytest.raises(InputError) as caught:
        ask()
    assert text in str(caught.value)


def test_what_is_not_declared_stays_a_number_and_files_hold_no_vector(tmp_path):
    assert problem_of([cup.on(AT)], CV.motion + SCALAR, 2).model.blocks[0].used == (0, 1, 4)
    assert problem_of([cup.on(AT)], Vane(1), 2).model.blocks[0].used == (0, 1, 2)
    with pytest.raises(InputError, match='node "n" states boresight as a vector, which a file of nodes does not hold'):
        write_nodes(tmp_path / "n.csv", [Node("n", (0, 0), boresight=(1.0, 0.0))])
