"""Dask clients with local workers, or with the workers of a scheduler (extra ``[distributed]``)."""

from __future__ import annotations

import os
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from noiseflow.installation import install_command
from noiseflow.threads import PASSIVE, waiting

_ONE_AT_A_TIME = threading.Lock()
_PATIENCE = 20  # s; a running scheduler answers within one


@contextmanager
def all_threads_of_worker() -> Iterator[int]:
    """Use all threads of this Dask worker for one task, because a second task would need its own memory. Yield their number."""
    import dask.distributed

    library: Any = dask.distributed  # it has no types
    with _ONE_AT_A_TIME:
        yield max(1, library.get_worker().state.nthreads)


def usable_cores() -> int:
    """Number of cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


@contextmanager
def client_of(workers: int | None, scheduler: str | None) -> Iterator[Any]:
    """Yield a ``dask.distributed.Client``, closed at the end; None if neither workers nor a scheduler are given.

    Args:
        workers: number of local processes, which share the cores of this machine.
        scheduler: address of a scheduler, ``tcp://HOST:PORT``.

    Raises:
        ModuleNotFoundError: dask.distributed is not installed.
        ConnectionError: no scheduler answers at this address.
    """
    if workers is None and scheduler is None:
        yield None
        return
    try:
        import dask.distributed
    except ModuleNotFoundError as error:
        raise ModuleNotFoundError(
            f"--workers and --scheduler need dask.distributed; install it with: {install_command('distributed')}"
        ) from error
    library: Any = dask.distributed  # it has no types
    if scheduler is not None:
        try:
            client = library.Client(scheduler, timeout=_PATIENCE, set_as_default=False)
        except (OSError, ValueError) as error:
            raise ConnectionError(
                f"no Dask scheduler answers at {scheduler}; start one there with: dask scheduler, or correct --scheduler"
            ) from error
        with client:
            yield client
        return
    options: dict[str, Any] = {"dashboard_address": None, "processes": True, "silence_logs": 50}
    if not waiting():
        options["env"] = PASSIVE
    threads = max(1, usable_cores() // (workers or 1))
    with (
        library.LocalCluster(n_workers=workers, threads_per_worker=threads, **options) as cluster,
        library.Client(cluster, set_as_default=False) as client,
    ):
        for number, worker in enumerate(
            client.scheduler_info(-1)["workers"]
        ):  # while this process makes the choices for all blocks
            library.fire_and_forget(client.submit(_import_what_blocks_need, number, workers=[worker]))
        yield client


def _import_what_blocks_need(number: int) -> None:
    del number
    import recon.joint.joint  # noqa: F401
