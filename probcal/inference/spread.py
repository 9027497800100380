"""Batches of work, given back as they are finished: on threads of this process, or on a dask cluster.

On a cluster each batch is a task, and large work is one too, whose value any worker can be asked for again and which
the batches take, so that the death of a worker costs what it was busy with. Only this process hears of results: what is
kept is kept by one writer.
"""

from __future__ import annotations

import logging
import os
import signal
import socket
import time
from collections.abc import Callable, Generator, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from contextlib import ExitStack, contextmanager
from functools import lru_cache
from importlib.metadata import version
from importlib.util import find_spec
from threading import Lock
from typing import TYPE_CHECKING, Any, NamedTuple
from uuid import uuid4

import jax

from probcal.errors import FitError, InputError
from probcal.kernels import keep_kernels
from probcal.lazy import Later

if TYPE_CHECKING:
    import cloudpickle
    import dask
    import distributed
else:
    cloudpickle, dask, distributed = Later("cloudpickle"), Later("dask"), Later("distributed")

LOCAL = "local"  # a scheduler and workers of this machine, for as long as the call lasts
TIMEOUT = 10.0  # s in which a scheduler must answer
SENT = 500  # batches that are handed over at a time
SMALL = 10_000  # bytes of work that go with every batch
KERNELS = (  # settings of jax, by which workers keep compiled kernels in the folder of this process
    "jax_compilation_cache_dir", "jax_compilation_cache_max_size", "jax_persistent_cache_min_compile_time_secs",
    "jax_persistent_cache_min_entry_size_bytes",
)  # fmt: skip
PACKAGES = ("probcal", "jax", "jaxlib", "numpy")  # of one version everywhere, so that numbers are the same
KEPT = (
    "what was finished is kept where there is a store (--out, store=...): go on with --resume (resume=True) when the"
    " cluster is there again"
)


def spread[B, R](
    work: Callable[[B], R], batches: Sequence[B], *, scheduler: Any = None, threads: int | None = None
) -> Generator[tuple[int, R]]:
    """Yield the number and the result of each batch as it is finished; close the iterator to drop what is not.

    Without a `scheduler` on threads of this process, the first batch alone since it compiles. `scheduler` is "local",
    the address of a running one, or a `distributed.Client`.
    Raises what `work` raises, `InputError` where there is no such cluster or its workers cannot do the work, and
    `FitError` where it is lost on the way.
    """
    check_scheduler(scheduler)
    if not batches:
        return
    yield from _on_threads(work, batches, threads) if scheduler is None else _on_cluster(work, batches, scheduler)


def check_scheduler(scheduler: Any) -> None:
    """Raise `InputError` for a scheduler that cannot be one, and where dask is missing."""
    if scheduler is None:
        return
    if find_spec("distributed") is None:
        raise InputError('a scheduler needs dask: pip install "probcal[cluster]"')
    if not isinstance(scheduler, str | distributed.Client):
        raise InputError(
            f'scheduler is {scheduler!r}; give "local", the address of a dask scheduler such as "tcp://host:8786", or'
            " a distributed.Client"
        )


def _on_threads[B, R](work: Callable[[B], R], batches: Sequence[B], threads: int | None) -> Generator[tuple[int, R]]:
    yield 0, work(batches[0])
    pool = ThreadPoolExecutor(threads or os.cpu_count())
    try:
        waiting = {pool.submit(work, batch): k for k, batch in enumerate(batches[1:], 1)}
        for finished in as_completed(waiting):
            yield waiting[finished], finished.result()
    finally:
        pool.shutdown(cancel_futures=True)


def _on_cluster[B, R](work: Callable[[B], R], batches: Sequence[B], scheduler: Any) -> Generator[tuple[int, R]]:
    with _client(scheduler, len(batches)) as client:
        name, packed = uuid4().hex, cloudpickle.dumps(work)
        # dask runs a task where what it takes lies: so small work travels with each batch, and large work by a key of
        # another first word, by which dask tells that the many batches are not tied to it
        own = [] if len(packed) <= SMALL else [client.submit(_given, packed, key=f"work-{name}", pure=False)]
        sent = client.map(
            _task, batches, key=[f"batch-{name}-{k}" for k in range(len(batches))], packed=own[0] if own else packed,
            here=_here(), pure=False, batch_size=SENT,
        )  # fmt: skip
        waiting = {future.key: (k, future) for k, future in enumerate(sent)}
        try:
            finished = distributed.as_completed(sent, loop=client.loop)
            del sent
            for future in finished:
                yield waiting.pop(future.key)[0], _result(future, client)
                future.release()
            if waiting:  # as_completed ends where the scheduler is gone
                raise _lost(client)
        finally:
            if client.status == "running":
                client.cancel([*(future for _, future in waiting.values()), *own], force=True)


def _result(future: Any, client: Any) -> Any:
    """The result of a finished task; what its work raised is raised."""
    try:
        return future.result()
    except distributed.KilledWorker as error:
        raise FitError(
            f"one batch ended {error.allowed_failures + 1} workers, one after the other (too little memory? their logs"
            f" say): {KEPT}"
        ) from None
    except (distributed.client.FutureCancelledError, distributed.comm.CommClosedError):
        raise _lost(client) from None


def _lost(client: Any) -> FitError:
    return FitError(f"the dask scheduler {client.scheduler.address if client.scheduler else ''} went away: {KEPT}")


@contextmanager
def _client(scheduler: Any, batches: int) -> Iterator[Any]:
    """A client of a scheduler, and where it is local the scheduler and its workers too."""
    if not isinstance(scheduler, str):
        yield scheduler
        return
    with ExitStack() as stack:
        if scheduler == LOCAL:
            stack.enter_context(_same_environment())
            at = stack.enter_context(_local_cluster(batches))
        else:
            at = scheduler
            _check_answer(scheduler)
        yield stack.enter_context(distributed.Client(at, timeout=TIMEOUT, set_as_default=False))


@contextmanager
def _same_environment() -> Iterator[None]:
    """Leave this process the environment that it had: dask changes it where it begins workers."""
    before = dict(os.environ)
    try:
        yield
    finally:
        for name in set(os.environ) - set(before):
            del os.environ[name]
        os.environ.update(before)


def _local_cluster(batches: int) -> Any:
    """A scheduler and a worker for each processor that this process may use."""
    from dask.system import CPU_COUNT

    count, ours = min(CPU_COUNT, batches), "distributed.nanny.pre-spawn-environ"
    # with MALLOC_TRIM_THRESHOLD_, which dask sets, glibc asks for memory anew at every kernel; by NPROC XLA counts its
    # threads: kernels of studies are small, and to share one out among processors costs more than it gains
    environ = {name: value for name, value in dask.config.get(ours).items() if name != "MALLOC_TRIM_THRESHOLD_"}
    settings = {ours: environ | {"NPROC": CPU_COUNT // count}, "distributed.worker.profile.enabled": False}
    try:
        with dask.config.set(settings):
            return distributed.LocalCluster(
                n_workers=count, threads_per_worker=1, memory_limit=None,
                silence_logs=logging.CRITICAL, dashboard_address=None,
                scheduler_kwargs={"dashboard_address": "127.0.0.1:0"}, preload=__name__,
            )  # fmt: skip
    except Exception as error:  # of the first worker that did not start
        raise InputError(
            f"the workers of this machine did not start ({error}); a script that asks for them does so below"
            ' if __name__ == "__main__":'
        ) from None


def dask_setup(worker: Any) -> None:
    """Prepares a local dask worker: leaves Ctrl-C to the client, and waits for no thread of XLA."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    jax.config.update("jax_cpu_enable_async_dispatch", False)


def _check_answer(address: str) -> None:
    """Raise `InputError` where nobody listens at an address: a client that fails there hangs where it ends."""
    last = time.monotonic() + TIMEOUT
    while True:
        try:
            host, port = distributed.comm.get_address_host_port(address)
            with socket.create_connection((host, port), timeout=TIMEOUT):
                return
        except (OSError, ValueError) as error:
            if isinstance(error, ValueError) or time.monotonic() > last:
                raise InputError(
                    f"no dask scheduler answers at {address} ({error}): start one (dask scheduler), or give local"
                ) from None
        time.sleep(0.5)


class _Here(NamedTuple):
    """The versions and settings that workers must have in common with this process."""

    versions: dict[str, str]
    kernels: dict[str, Any]  # settings of jax


def _here() -> _Here:
    keep_kernels()
    return _Here({name: version(name) for name in PACKAGES}, {name: getattr(jax.config, name) for name in KERNELS})


def _given(packed: bytes) -> bytes:
    """The work, as it was sent."""
    return packed


def _task(batch: Any, packed: bytes, here: _Here) -> Any:
    """Do a batch in a worker."""
    for name, wanted in here.versions.items():
        if (found := version(name)) != wanted:
            raise InputError(f"a worker has {name} {found}, this process {wanted}: install the same there")
    folder = here.kernels[KERNELS[0]]
    if folder and not jax.config.jax_compilation_cache_dir and os.path.isdir(folder):
        for name, value in here.kernels.items():
            jax.config.update(name, value)
    with _ALONE:
        return _unpacked(packed)(batch)


class _Alone:
    """While a thread is inside, dask means threads: else xarray locks the files that it writes through the cluster."""

    def __init__(self) -> None:
        self._lock, self._inside, self._set = Lock(), 0, ExitStack()

    def __enter__(self) -> None:
        with self._lock:
            if not self._inside:
                self._set.enter_context(dask.config.set(scheduler="threads"))
            self._inside += 1

    def __exit__(self, *_: object) -> None:
        with self._lock:
            self._inside -= 1
            if not self._inside:
                self._set.close()


_ALONE = _Alone()


@lru_cache(maxsize=4)
def _unpacked(packed: bytes) -> Callable[[Any], Any]:
    """The work; once in a worker, so that what it compiles serves all its batches."""
    try:
        with jax.enable_x64(True):  # else its arrays would be cut to 32 bits
            return cloudpickle.loads(packed)
    except ImportError as error:
        raise InputError(f"a worker cannot import what the work needs ({error}): install it there") from None
