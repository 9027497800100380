"""Several devices: the same numbers as one, whatever the number of runs or chains. XLA makes two of the processor."""

import subprocess
import sys
from pathlib import Path

import pytest

BEGIN = """
import os
os.environ["XLA_FLAGS"] = "--xla_force_host_platform_device_count=2"
import jax
import jax.numpy as jnp
import numpy as np
assert len(jax.devices()) == 2
"""

PLAIN = """
from probcal.devices import over_devices

def halvings(x):
    return jax.lax.while_loop(lambda c: c[0] > 1, lambda c: (c[0] / 2, c[1] + 1), (x, 0))

for size in (1, 2, 3, 4):
    x = jnp.arange(1.0, 1.0 + size) ** 5
    last, count = jax.jit(lambda x: over_devices(jax.vmap(halvings), x))(x)
    np.testing.assert_array_equal(count, np.ceil(np.log2(x)))
    np.testing.assert_array_equal(last, x / 2.0 ** np.ceil(np.log2(x)))

spread = jax.jit(lambda x: over_devices(jax.vmap(halvings), x)).lower(jnp.ones(4)).compile()
assert "num_partitions=2" in spread.as_text()
"""

WHOLE = """
import sys
sys.path.insert(0, MODELS)
import radars
import probcal

given = {"grid": {"scenario": ["B"], "share": [0.3]}, "methods": ["map"], "runs": 3}
problem, _ = radars.setting(0, scenario="B", share=0.3)
chains = probcal.Collapsed(chains=3, warmup=20, draws=40, patience=1)
one = probcal.study(radars.setting, **given), probcal.fit(problem, chains, key=1)
jax.default_backend = lambda: "gpu"  # all runs, and all chains, in one kernel
both = probcal.study(radars.setting, **given), probcal.fit(problem, chains, key=1)
for name in ("error", "sd", "gamma"):
    np.testing.assert_allclose(both[0][name], one[0][name], atol=1e-10)
np.testing.assert_allclose(both[1]["posterior"]["bias"], one[1]["posterior"]["bias"], rtol=1e-6, atol=1e-9)
"""


def run(script):
    models = f"MODELS = {str(Path(__file__).parents[1] / 'models')!r}\n"
    done = subprocess.run([sys.executable, "-c", models + BEGIN + script], capture_output=True, text=True, timeout=600)
    assert done.returncode == 0, done.stderr[-3000:]


def test_a_batch_is_shared_out_and_put_together_again():
    run(PLAIN)


@pytest.mark.slow
def test_a_study_and_chains_on_two_devices_have_the_numbers_of_one():
    run(WHOLE)
