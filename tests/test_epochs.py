"""The model epoch by epoch: filters written with public names only, against the smoother and the dense reference.

These are what a new kind of inference attaches to: `Model.epochs`, `step`, `log_step`, `predict_at`,
`log_likelihood_at`, `linearise_at`, and `Problem.later` for rows that came after a kernel was compiled.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import reference
import worlds
from scipy import stats

from probcal import InputError, Problem


@jax.jit
def filtered(model, epochs, start, z, levels):
    """Kalman filter over epochs from (means, covariances) of all targets: the last ones, and the log evidence."""

    def one(carry, epoch):
        means, spreads = carry
        after = []
        for r, (x, P) in enumerate(zip(means, spreads, strict=True)):
            move, k = epoch.move[r], epoch.target[r]
            scale = jnp.concatenate([jnp.exp(levels), jnp.ones(1)])[move.level]
            root = move.L * scale[None, :]
            after.append(
                (x.at[k].set(move.F @ x[k] + move.drift), P.at[k].set(move.F @ P[k] @ move.F.T + root @ root.T))
            )
        means, spreads = (tuple(part) for part in zip(*after, strict=True))
        lins = model.linearise_at(epoch, means, z, levels)
        evidence = sum(jnp.sum(part) for part in model.log_likelihood_at(epoch, means, z, levels))
        updated = list(zip(means, spreads, strict=True))
        for r, (x, P) in enumerate(zip(means, spreads, strict=True)):
            k, n = epoch.target[r], x.shape[1]
            J, b = jnp.zeros((n, n)), jnp.zeros(n)
            for own, lin in zip(model.recursion, lins, strict=True):
                if own == r:
                    J = J + jnp.einsum("pcu,pc,pcv->uv", lin.state, lin.weight, lin.state)
                    b = b + jnp.einsum("pcu,pc->u", lin.state, lin.score)
            inverse = jnp.linalg.inv(jnp.eye(n) + P[k] @ J)
            evidence = evidence + 0.5 * b @ inverse @ P[k] @ b - 0.5 * jnp.linalg.slogdet(jnp.eye(n) + P[k] @ J)[1]
            updated[r] = (x.at[k].add(inverse @ P[k] @ b), P.at[k].set(inverse @ P[k]))
        return tuple(tuple(part) for part in zip(*updated, strict=True)), evidence

    last, evidence = jax.lax.scan(one, start, epochs)
    return last, jnp.sum(evidence)


def rest(model):
    """Means and covariances of all targets before any has begun."""
    sizes = [(count, part.drift.shape[1]) for count, part in zip(model.targets, model.recursions, strict=True)]
    return tuple(np.zeros(s) for s in sizes), tuple(np.zeros((*s, s[1])) for s in sizes)


def last_of(naive, held):
    """Mean and sd of the last state of each target, as the dense reference smooths it."""
    starts = np.cumsum([0, *(len(chain.names) * len(chain.times) for chain in naive.chains)])
    return {
        chain.target: tuple(part[b - len(chain.names) : b] for part in held.states)
        for chain, b in zip(naive.chains, starts[1:], strict=True)
    }


@pytest.mark.parametrize("name", worlds.LINEAR)
def test_a_filter_over_the_epochs_ends_where_the_smoother_ends(name):
    """Two motions, asynchronous epochs, static targets, missing rows: means, sds and the evidence, biases held."""
    problem, naive = worlds.linear(name)
    held = reference.dense(naive, None, hold=np.zeros(len(naive.labels)))
    with jax.enable_x64(True):
        model = problem.model
        zeros = np.zeros(model.biases), np.zeros(len(problem.levels))
        found = filtered(model, model.epochs(), rest(model), *zeros)
        (means, spreads), evidence = jax.tree.map(np.asarray, found)
    assert float(evidence) == pytest.approx(held.evidence, rel=1e-10)
    expected = last_of(naive, held)
    for epochs, x, P in zip(problem.epochs, means, spreads, strict=True):
        for k, target in enumerate(dict.fromkeys(epochs.target)):
            np.testing.assert_allclose(x[k], expected[target][0], atol=1e-9)
            np.testing.assert_allclose(np.sqrt(np.diag(P[k])), expected[target][1], atol=1e-9)


def test_epochs_come_in_time_order_and_hold_every_row_once():
    problem, _ = worlds.linear("mixed")
    with jax.enable_x64(True):
        epochs = jax.tree.map(np.asarray, problem.model.epochs())
    assert (np.diff(epochs.time) >= 0).all()
    assert epochs.first.sum() == sum(problem.model.targets)
    for seen, data in zip(epochs.rows, problem.model.rows, strict=True):
        assert seen.mask.sum() == np.sum(np.asarray(data.mask))
        assert (seen.y * seen.mask).sum() == pytest.approx(np.sum(np.asarray(data.y) * np.asarray(data.mask)))
    with pytest.raises(InputError, match=r"an epoch has \d+ rows of sensor \w+, but its size is 0; give more"):
        problem.model.epochs(sizes=(0,) * len(problem.model.blocks))


@pytest.mark.ci
def test_rows_that_came_later_take_the_same_kernel(kept_kernels):
    """A filter compiled for the first rows goes on, epoch by epoch, with those of a table that came after."""
    network, motion, table, fixed = worlds.mixed()
    early = table["time"] < 2.0
    first, whole = Problem(network, motion, table[early], fix=fixed), worlds.linear("mixed")[0]
    rows = table[~early]
    with jax.enable_x64(True):
        model = first.model
        zeros = jnp.zeros(model.biases), jnp.zeros(len(first.levels))
        sizes = tuple(2 * size for size in model.sizes)
        state, evidence = filtered(model, model.epochs(sizes), rest(model), *zeros)
        total, compiled = float(evidence), []
        for time in sorted(rows["time"].unique()):
            behind = Problem(network, motion, table[table["time"] < time], fix=fixed)
            epochs = behind.later(rows[rows["time"] == time], sizes)
            for k in range(len(epochs.time)):
                state, evidence = filtered(
                    model, jax.tree.map(lambda leaf, k=k: leaf[k : k + 1], epochs), state, *zeros
                )
                total += float(evidence)
                compiled.append(filtered._cache_size())
        (means, spreads), expected = filtered(whole.model, whole.model.epochs(), rest(whole.model), *zeros)
    assert len(set(compiled)) == 1, "one kernel takes every epoch that comes"
    assert total == pytest.approx(float(expected), rel=1e-10)
    for x, y in zip((*state[0], *state[1]), (*means, *spreads), strict=True):
        np.testing.assert_allclose(x, y, atol=1e-9)


def test_later_rows_that_are_none_are_refused():
    network, motion, table, fixed = worlds.mixed()
    problem = Problem(network, motion, table, fix=fixed)
    with pytest.raises(InputError, match="is not after the last epoch of its target, at 4"):
        problem.later(table[table["target"] == "walker"].tail(1))
    with pytest.raises(InputError, match='target "plane" is new'):
        problem.later(table.tail(1).assign(target="plane", time=9.0))


@pytest.mark.slow
def test_the_density_of_a_step_is_that_of_its_draws():
    """`log_step` against the moments of the motion; a motion without density is refused."""
    problem = worlds.linear("plane")[0]
    with jax.enable_x64(True):
        model, levels = problem.model, jnp.zeros(0)
        epochs = model.epochs()
        x = model.initial()
        for k in (0, 1, 4):
            epoch = jax.tree.map(lambda leaf, k=k: leaf[k], epochs)
            after = model.step(jax.random.key(k), x, epoch, levels)
            found = float(model.log_step(x, after, epoch, levels))
            move, mine = epoch.move[0], int(epoch.target[0])
            mean = np.asarray(move.F @ x[0][mine] + move.drift)
            expected = stats.multivariate_normal(mean, np.asarray(move.L @ move.L.T)).logpdf(np.asarray(after[0][mine]))
            assert found == pytest.approx(float(expected), rel=1e-9)
            others = [n for n in range(model.targets[0]) if n != mine]
            np.testing.assert_array_equal(after[0][np.array(others)], x[0][np.array(others)])
            x = after
        singular = worlds.linear("space")[0].model
        with pytest.raises(InputError, match="the motion has no density"):
            singular.log_step(x, x, epoch, levels)


@pytest.mark.slow
def test_steps_have_the_moments_of_the_motion():
    """Mean and covariance of 4000 drawn steps; false alarms 1e-6 by normal limits."""
    problem = worlds.linear("mixed")[0]
    with jax.enable_x64(True):
        model, levels = problem.model, jnp.zeros(0)
        epochs = model.epochs()
        chosen = next(k for k in range(len(epochs.time)) if not epochs.first[k] and epochs.dt[k] > 0)
        epoch = jax.tree.map(lambda leaf: leaf[chosen], epochs)
        x = tuple(
            jnp.ones((count, part.drift.shape[1])) for count, part in zip(model.targets, model.recursions, strict=True)
        )
        draws = jax.vmap(lambda key: model.step(key, x, epoch, levels))(jax.random.split(jax.random.key(1), 4000))
        r = int(epoch.recursion)
        own = np.asarray(draws[r][:, int(epoch.target[r])])
        move = epoch.move[r]
        mean, covariance = np.asarray(move.F @ x[r][int(epoch.target[r])] + move.drift), np.asarray(move.L @ move.L.T)
    sd = np.sqrt(np.diag(covariance))
    assert (np.abs(own.mean(0) - mean) < 5.5 * sd / np.sqrt(4000) + 1e-12).all()
    products = np.outer(sd, sd) + 1e-12
    assert (np.abs(np.cov(own.T) - covariance) < 5.5 * np.sqrt(2 / 4000) * products).all()


def systematic(key, log_weights, particles, n):
    """Systematic resampling as cuthbert calls it; its own leaves double precision in a callback to the host."""
    places = (jax.random.uniform(key) + jnp.arange(n)) / n
    chosen = jnp.searchsorted(jnp.cumsum(jax.nn.softmax(log_weights)), places).clip(0, n - 1)
    return chosen.astype(int), jnp.zeros(n), jax.tree.map(lambda leaf: leaf[chosen], particles)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["plane", "mixed"])
def test_the_particle_filter_of_cuthbert_takes_a_model(name):
    """Its three callables are methods of `Model`: evidence and last means are those of the Kalman filter.

    Two targets of one motion, and three of two motions at asynchronous epochs. Of 30 runs the mean of the evidence
    ratio, which is unbiased, lies within 5 standard errors of 1, and so do the means: false alarms below 1e-4.
    """
    cuthbert = pytest.importorskip("cuthbert", reason="cuthbert is not installed: uv sync --group test")
    from cuthbert.smc import particle_filter

    problem = worlds.linear(name)[0]
    with jax.enable_x64(True):
        model = problem.model  # with data that its targets may well have given, for particles to find them
        model = model.with_values(model.sample(worlds.resting(problem), jax.random.key(5)))
        z, levels, epochs = jnp.zeros(model.biases), jnp.zeros(len(problem.levels)), model.epochs()
        filter_ = particle_filter.build_filter(
            init_sample=lambda key: model.initial(),
            propagate_sample=lambda key, x, epoch: model.step(key, x, epoch, levels),
            log_potential=lambda before, x, epoch: sum(
                jnp.sum(part) for part in model.log_likelihood_at(epoch, x, z, levels)
            ),
            n_filter_particles=4000,
            resampling_fn=systematic,
        )

        @jax.jit
        def run(key):
            keys = jax.random.split(key)
            states = cuthbert.filter(filter_, epochs, filter_.init_prepare(key=keys[0]), key=keys[1])
            weights = jax.nn.softmax(states.log_weights[-1])
            means = tuple(jnp.einsum("p,ptn->tn", weights, x[-1]) for x in states.particles)
            return states.log_normalizing_constant[-1], means

        found, means = jax.lax.map(run, jax.random.split(jax.random.key(0), 30))
        (exact, spreads), evidence = filtered(model, epochs, rest(model), z, levels)
    ratio = np.exp(np.asarray(found) - float(evidence))
    assert abs(ratio.mean() - 1) < 5 * ratio.std(ddof=1) / np.sqrt(len(ratio))
    assert ratio.std() < 1, "the particles are enough for the comparison to mean something"
    for mine, x, P in zip(means, exact, spreads, strict=True):
        error = np.asarray(mine).mean(0) - np.asarray(x)
        spread = np.asarray(mine).std(0, ddof=1) / np.sqrt(len(ratio))
        assert (np.abs(error) < 5 * spread + 0.02 * np.sqrt(np.diagonal(np.asarray(P), axis1=1, axis2=2))).all()


@pytest.mark.ci
@pytest.mark.parametrize("name", ["mixed", "space"])
def test_an_epoch_predicts_what_whole_trajectories_predict(name):
    """Row by row, two-node sensors and missing rows too: the sorted predictions of both ways are one list."""
    problem = worlds.linear(name)[0]
    with jax.enable_x64(True):
        model, point = problem.model, worlds.resting(problem)
        point = point._replace(states=tuple(x + np.arange(x.size).reshape(x.shape) for x in point.states))
        epochs, z = model.epochs(), jnp.linspace(-1.0, 1.0, model.biases)
        x, found = model.initial(), [[] for _ in model.blocks]
        place = [0] * len(model.recursions)
        order = [np.argsort(np.asarray(p.time), kind="stable") for p in model.recursions]
        for k in range(len(epochs.time)):
            epoch = jax.tree.map(lambda leaf, k=k: leaf[k], epochs)
            r = int(epoch.recursion)
            now = point.states[r][order[r][place[r]]]
            place[r] += 1
            x = tuple(part.at[epoch.target[r]].set(now) if s == r else part for s, part in enumerate(x))
            for own, seen, predicted in zip(found, epoch.rows, model.predict_at(epoch, x, z), strict=True):
                own.append(np.asarray(predicted)[np.asarray(seen.mask) > 0])
        whole = model.predict(point._replace(z=z))
    for mine, all_, mask in zip(found, whole, model.measured, strict=True):
        np.testing.assert_allclose(
            np.sort(np.concatenate(mine)), np.sort(np.asarray(all_)[np.asarray(mask) > 0]), atol=1e-12
        )
