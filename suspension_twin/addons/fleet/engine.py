# SPDX-License-Identifier: Apache-2.0
"""A fleet's work over Dask: open tasks are sent out, and each result is written as soon as it comes.

The ledger is the only state. Workers that are killed, a scheduler that is started again and a command that is
interrupted cost the tasks that were running, and nothing else.
"""

from __future__ import annotations

import math
import os
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from functools import partial
from itertools import islice
from typing import TYPE_CHECKING, TypeVar

from suspension_twin.addons.fleet.manifest import Item
from suspension_twin.addons.fleet.results import Ledger
from suspension_twin.addons.fleet.storage import transient
from suspension_twin.addons.fleet.work import Options, Record, Task, plan_task, work
from suspension_twin.errors import InputError, SuspensionTwinError, WorkError
from suspension_twin.files import explained

if TYPE_CHECKING:
    from distributed import Client, Future as Remote

__all__ = ["Cluster", "FleetOutcome", "FleetPlan", "connected", "plan_fleet", "run_fleet"]

Done = TypeVar("Done")

#: Tasks a worker has at hand beside the one that it does, so that it never waits for the next.
_AHEAD = 2
#: Trials of a task whose failure may pass by itself, and s before the second one, doubled each time.
_TRIALS, _PAUSE = 3, 1.0
#: Workers that may die over one task before it is given up. Where each worker is killed once a minute and a task takes
#: 6 s, six deaths in a row are one task in a million.
_DEATHS = 5
#: Threads that fetch and write results, and results that may wait for them. Each file of a result is on the disk before
#: it counts, which takes tens of milliseconds on a busy one: in turn, that is what a large fleet waits for first.
_KEEPERS, _UNKEPT = 8, 64
#: s between two looks at how many workers there are.
_LOOK = 1.0
#: s that a lost scheduler is waited for.
_PATIENCE = 300.0
#: Bytes that a worker needs for numba's code, NumPy and a drive of an hour.
_LEAST_MEMORY = 1 << 30
#: Of a worker's process. One thread: it has one core, and a fleet has more drives than cores. And the thresholds of
#: glibc's malloc at the values that it comes to by itself (mallopt(3): 32 MiB, and twice that). Dask sets one of them
#: to 64 KiB, which fixes the other at 128 KiB: every array beyond goes back to the system and costs its page faults
#: anew, 230 000 instead of 200 for a drive of 30 s, which then takes 1.5 s of processor time instead of 0.9.
_ENVIRONMENT = {
    **dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS"), "1"),
    "MALLOC_MMAP_THRESHOLD_": str(32 << 20),
    "MALLOC_TRIM_THRESHOLD_": str(64 << 20),
}
#: Dask watches itself: ticks of every event loop each 20 ms, samples of what workers do each 10 ms, of the system each
#: 500 ms. With as many workers as cores all of it is taken from the work: measured on two cores (Dask 2026.8), 2.7 % of
#: a core in each worker and 3.3 % in the scheduler's process, and 0.2 % and 0.6 % with these settings.
_QUIET = {
    "distributed.worker.profile.enabled": False,
    "distributed.admin.tick.interval": "1s",
    "distributed.admin.system-monitor.interval": "10s",
    "distributed.scheduler.active-memory-manager.start": False,
}


@dataclass(frozen=True)
class FleetPlan:
    """The work on a manifest.

    Parameters
    ----------
    items : tuple of Item
        Rows of the manifest.
    tasks : tuple of Task or str
        For every item its task, or a line that says why there is none.
    done : dict
        Records that are there already, by key.
    """

    items: tuple[Item, ...]
    tasks: tuple[Task | str, ...]
    done: dict[str, Record]

    @property
    def planned(self) -> list[Task]:
        """Tasks of the items that can be used."""
        return [t for t in self.tasks if not isinstance(t, str)]

    @property
    def open(self) -> tuple[Task, ...]:
        """Tasks to do, each key once."""
        return tuple({t.key: t for t in self.planned if t.key not in self.done}.values())


@dataclass
class FleetOutcome:
    """Results of a plan.

    Parameters
    ----------
    records : dict
        By key.
    lost : dict
        Lines by key of the tasks that did not end and are worth another run.
    computed : int
        Tasks done in this run, which took ``seconds``.
    """

    records: dict[str, Record]
    lost: dict[str, str] = field(default_factory=dict)
    computed: int = 0
    seconds: float = 0.0


@dataclass(frozen=True)
class Cluster:
    """Workers of Dask: a ``client`` of their scheduler, and a ``text`` that describes them."""

    client: Client
    text: str


def plan_fleet(
    items: Sequence[Item], options: Options, ledger: Ledger, on_progress: Callable[[int], None] | None = None
) -> FleetPlan:
    """Identify every item's inputs and look up the records that are there.

    Parameters
    ----------
    items : sequence of Item
        Rows of the manifest.
    options : Options
        Of the calibrations or diagnoses.
    ledger : Ledger
        Results of earlier runs.
    on_progress : callable, optional
        Called with the number of items planned so far.

    Returns
    -------
    FleetPlan
        An item whose files cannot be used has a line instead of a task.

    Raises
    ------
    WorkError
        A store is out of reach.

    Examples
    --------
    >>> plan_fleet(items, Options("calibrate"), Ledger(Path("results"))).open  # doctest: +SKIP
    ()
    """
    tasks: list[Task | str] = []
    done: dict[str, Record] = {}
    for number, item in enumerate(items, 1):
        try:
            task = _tried(partial(plan_task, item, options))
        except Exception as error:
            if not isinstance(error, SuspensionTwinError) and transient(error):
                raise WorkError(f"{item.title}: its files are out of reach: {error}") from error
            tasks.append(explained(error)[1])
        else:
            tasks.append(task)
            record = done.get(task.key) or ledger.load(task.key)
            if record is not None:
                done[task.key] = record
        if on_progress is not None:
            on_progress(number)
    return FleetPlan(tuple(items), tuple(tasks), done)


def _tried(action: Callable[[], Done]) -> Done:
    """The result of an action, tried again where a failure may pass by itself."""
    for trial in range(_TRIALS - 1):
        try:
            return action()
        except Exception as error:
            if isinstance(error, SuspensionTwinError) or not transient(error):
                raise
            time.sleep(_PAUSE * 2**trial)
    return action()


def _attempt(task: Task) -> Record:
    """:func:`work`, tried again where the failure may pass by itself; in a worker."""
    try:
        return _tried(partial(work, task))
    except Exception as error:
        return _lost(task, f"after {_TRIALS} trials: {explained(error)[1]}")


def _lost(task: Task, message: str) -> Record:
    return {"key": task.key, "status": "lost", "message": message}


@contextmanager
def connected(
    scheduler: str = "", workers: int = 0, memory: float = 0.0, inside: bool = False
) -> Iterator[Cluster]:
    """A Dask cluster: that of a scheduler, or one on this machine for as long as the block lasts.

    Parameters
    ----------
    scheduler : str
        Address such as ``tcp://host:8786``; empty for a cluster on this machine.
    workers : int
        Processes on this machine, 0 for one a core.
    memory : float
        Bytes that a worker may hold before it is started again, 0 for its share of the free memory.
    inside : bool
        Workers as threads of this process: for tests and for looking into one.

    Yields
    ------
    Cluster
        Client and description.

    Raises
    ------
    InputError
        The extra ``fleet`` is not installed, or no scheduler answers.

    Examples
    --------
    >>> with connected(workers=2) as cluster:  # doctest: +SKIP
    ...     cluster.text
    '2 workers on this machine, at most 4.0 GiB each'
    """
    try:
        import dask
        import distributed
        import psutil
    except ImportError:
        raise InputError("fleet", 'needs Dask: pip install "suspension-twin[fleet]"') from None
    if scheduler:
        try:
            with dask.config.set(_QUIET):
                client = distributed.Client(scheduler, timeout=20, set_as_default=False)
        except (OSError, ValueError) as error:
            raise InputError("--scheduler", scheduler, f"no scheduler answers: {error}") from None
        try:
            found = client.scheduler_info(n_workers=-1)["workers"]
            limits = sorted({w["memory_limit"] for w in found.values() if w["memory_limit"]})
            text = f"{len(found)} workers of {scheduler}"
            yield Cluster(client, text + (f", at most {_size(limits[-1])} each" if limits else ""))
        finally:
            with suppress(Exception):
                client.close(timeout=5)
        return
    count = workers or len(os.sched_getaffinity(0))
    limit = memory or max(0.8 * psutil.virtual_memory().available / count, _LEAST_MEMORY)
    settings = {
        **_QUIET,
        "distributed.scheduler.allowed-failures": _DEATHS,
        "distributed.scheduler.work-stealing": False,
        "distributed.worker.memory.spill": False,
        "distributed.worker.memory.target": False,
        "distributed.nanny.pre-spawn-environ": _ENVIRONMENT,
        "distributed.logging": {"distributed": "critical"},
    }
    with (
        dask.config.set(settings),
        distributed.LocalCluster(
            n_workers=count,
            threads_per_worker=1,
            processes=not inside,
            memory_limit=int(limit),
            dashboard_address=None,
            scheduler_kwargs={"dashboard_address": "127.0.0.1:0"},  # else a second fleet finds the port taken
            silence_logs=50,
        ) as cluster,
        distributed.Client(cluster, set_as_default=False) as client,
    ):
        yield Cluster(
            client, f"{count} worker{'s' * (count > 1)} on this machine, at most {_size(limit)} each"
        )


def _size(count: float) -> str:
    return f"{count / (1 << 30):.1f} GiB"


def run_fleet(
    plan: FleetPlan,
    ledger: Ledger,
    cluster: Cluster,
    on_record: Callable[[Task, Record, int], None] | None = None,
) -> FleetOutcome:
    """Do the open tasks of a plan.

    Parameters
    ----------
    plan : FleetPlan
        From :func:`plan_fleet`.
    ledger : Ledger
        Receives each record as soon as it comes.
    cluster : Cluster
        Where to work.
    on_record : callable, optional
        Called with task, record and the number of tasks still open.

    Returns
    -------
    FleetOutcome
        All records, those of earlier runs too.

    Raises
    ------
    WorkError
        The scheduler is gone and does not come back. Results so far are kept.

    Examples
    --------
    >>> outcome = run_fleet(plan, ledger, cluster)  # doctest: +SKIP
    """
    began = time.monotonic()
    outcome = FleetOutcome(dict(plan.done))
    left = {t.key: t for t in plan.open}
    gone_since, before = math.inf, len(left)
    ledger.begin()
    while left:
        try:
            _drain(left, ledger, cluster.client, outcome, on_record)
        except _Gone as error:
            now = time.monotonic()
            gone_since = min(gone_since, now) if len(left) == before else now
            before = len(left)
            if now - gone_since > _PATIENCE:
                raise WorkError(f"the scheduler is gone: {error}; the same command goes on") from None
            time.sleep(1.0)
    outcome.seconds = time.monotonic() - began
    return outcome


class _Gone(Exception):
    """The scheduler cannot be reached, or has lost its tasks."""


def _drain(
    left: dict[str, Task],
    ledger: Ledger,
    client: Client,
    outcome: FleetOutcome,
    on_record: Callable[[Task, Record, int], None] | None,
) -> None:
    """Send open tasks and take in results; few are under way at any time, so that the scheduler stays small."""
    from concurrent.futures import FIRST_COMPLETED, CancelledError, Future, ThreadPoolExecutor, wait

    from distributed import KilledWorker, as_completed
    from distributed.comm.core import CommClosedError

    waiting = iter(list(left.values()))
    under_way: dict[str, Task] = {}
    keepers = ThreadPoolExecutor(_KEEPERS)
    keeping: dict[Future[Record], Task] = {}

    def send(count: int) -> list[Remote[Record]]:
        futures = []
        for task in islice(waiting, count):
            # Of no use to anybody afterwards; a key of its own each time, so that no old failure is handed out.
            key = f"{task.options.action}-{task.key}-{time.monotonic_ns()}"
            under_way[key] = task
            futures.append(client.submit(_attempt, task, key=key, pure=False))
        return futures

    def keep(task: Task, future: Remote[Record]) -> Record:
        """Fetch a result and write it; in a thread."""
        try:
            record: Record = future.result(timeout=60)
        except KilledWorker:
            return _lost(task, "one worker after the other died over it: killed, or out of memory")
        future.release()
        return record if record["status"] == "lost" else ledger.save(record)

    def take_in(kept: Iterable[Future[Record]]) -> None:
        for each in kept:
            task, record = keeping.pop(each), each.result()
            if record["status"] == "lost":
                outcome.lost[task.key] = record["message"]
            else:
                outcome.records[task.key] = record
                outcome.computed += 1
            left.pop(task.key)
            if on_record is not None:
                on_record(task, record, len(left))

    def threads() -> int:
        return max(sum(int(n) for n in client.nthreads().values()), 1)

    try:
        here, looked = threads(), time.monotonic()
        with client.as_current():
            coming = as_completed(send(here * (1 + _AHEAD)))
        for future in coming:
            task = under_way.pop(future.key)
            if future.status == "cancelled":
                raise _Gone("work was cancelled")
            keeping[keepers.submit(keep, task, future)] = task
            full = len(keeping) > _UNKEPT
            take_in(wait(keeping, None if full else 0.0, FIRST_COMPLETED).done)
            # As many as the workers that are there now can use: they come and go.
            if time.monotonic() - looked > _LOOK:
                here, looked = threads(), time.monotonic()
            for new in send(max(here * (1 + _AHEAD) - len(under_way), 0)):
                coming.add(new)
        take_in(wait(keeping).done)
    except (CommClosedError, CancelledError, TimeoutError, OSError, RuntimeError) as error:
        if isinstance(error, OSError) and error.filename is not None:
            raise
        raise _Gone(str(error) or type(error).__name__) from error
    finally:
        keepers.shutdown()  # results that have come are kept, whatever ended the rest
        take_in([each for each in keeping if each.exception() is None])
