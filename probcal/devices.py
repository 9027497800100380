"""Batches laid over all devices of the machine: runs of a study, chains of a sampler."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax.sharding import PartitionSpec


def over_devices(batched: Callable[..., Any], *batches: Any) -> Any:
    """`batched(*batches)`, each device computing its share of the leading axis (B,) of every leaf, in and out.

    Devices do not wait for each other: a loop runs on each as long as its own share needs. Where B is no multiple of
    the number of devices the last entry is computed again, and dropped. With one device this is a plain call. What
    `batched` closes over is copied to every device.
    """
    count = jax.local_device_count()
    size = jax.tree.leaves(batches)[0].shape[0]
    if count == 1 or size == 1:
        return batched(*batches)
    missing = -size % count

    def padded(leaf: Any) -> jax.Array:
        return jnp.concatenate([leaf, jnp.repeat(leaf[-1:], missing, axis=0)]) if missing else jnp.asarray(leaf)

    mesh = jax.make_mesh((count,), ("batch",), axis_types=(jax.sharding.AxisType.Auto,), devices=jax.local_devices())
    each = PartitionSpec("batch")
    spread = jax.shard_map(batched, mesh=mesh, in_specs=each, out_specs=each, check_vma=False)
    return jax.tree.map(lambda leaf: leaf[:size], spread(*jax.tree.map(padded, batches)))
