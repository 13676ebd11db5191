"""Runs tasks in processes of this machine, or on Dask; a few more at a time than there are workers."""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import AbstractContextManager
from itertools import islice
from multiprocessing.connection import wait as wait_for_end
from types import TracebackType
from typing import Any

from agent.fleet.task import RecordingTask, run_task

IN_FLIGHT = 2  # tasks given out for each worker: the second one waits there, so that no worker is idle
CONNECT_S = 10.0  # s to reach a Dask scheduler
Done = tuple[RecordingTask, bytes | str]
"""A task with its result, or the sentence why it has none."""
_TASKS = multiprocessing.get_context("spawn")


class SchedulerError(Exception):
    """The Dask scheduler cannot be used. The message says why."""


class LocalWorkers(AbstractContextManager["LocalWorkers"]):
    """`count` processes. They end with this process, also where it is killed."""

    def __init__(self, count: int) -> None:
        self._count = count
        self._pool = self._new_pool(count)

    def run(self, tasks: Iterable[RecordingTask]) -> Iterator[Done]:
        """Each task with its result, as they come. A task that ends its process is tried once more, alone."""
        waiting, open_tasks = iter(tasks), dict[Future[bytes], RecordingTask]()
        while True:
            lost: list[RecordingTask] = []
            for task in islice(waiting, IN_FLIGHT * self._count - len(open_tasks)):
                try:
                    open_tasks[self._pool.submit(run_task, task)] = task
                except BrokenProcessPool:  # a process has ended since the last look
                    lost.append(task)
                    break
            if not open_tasks and not lost:
                return
            for future in wait(open_tasks, return_when=FIRST_COMPLETED).done if open_tasks else ():
                task = open_tasks.pop(future)
                if isinstance(future.exception(), BrokenProcessPool):
                    lost.append(task)
                else:
                    yield task, outcome(future.result)
            if lost:
                yield from self._alone([*lost, *open_tasks.values()])
                open_tasks.clear()

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if kind is not None:
            for process in multiprocessing.active_children():
                process.terminate()
        self._pool.shutdown(cancel_futures=True)

    def _alone(self, tasks: Iterable[RecordingTask]) -> Iterator[Done]:
        """Each task in a new process of its own, so that only the one that ends its process is lost."""
        self._pool.shutdown(cancel_futures=True)
        for task in tasks:
            with self._new_pool(1) as pool:
                yield task, outcome(pool.submit(run_task, task).result)
        self._pool = self._new_pool(self._count)

    @staticmethod
    def _new_pool(count: int) -> ProcessPoolExecutor:
        return ProcessPoolExecutor(count, mp_context=_TASKS, initializer=begin)


class DaskWorkers(AbstractContextManager["DaskWorkers"]):
    """The workers of the Dask scheduler at `address`. They need fieldcal, and see the recordings at the same paths.

    Raises SchedulerError.
    """

    def __init__(self, address: str) -> None:
        try:
            from distributed import Client
        except ImportError:
            raise SchedulerError("--scheduler needs Dask; install it with: fieldcal extras --install fleet") from None
        try:
            self._client: Any = Client(address, timeout=CONNECT_S, set_as_default=False)
        except (OSError, ValueError, TimeoutError) as error:
            raise SchedulerError(f"{address}: no Dask scheduler answers there: {error}") from None

    def run(self, tasks: Iterable[RecordingTask]) -> Iterator[Done]:
        """Each task with its result, as they come. Dask gives a task of a lost worker to another one, three times."""
        from distributed import as_completed

        waiting, open_tasks = iter(tasks), dict[Any, RecordingTask]()
        completed = as_completed(loop=self._client.loop)
        while True:
            room = IN_FLIGHT * max(1, sum(self._client.nthreads().values())) - len(open_tasks)
            for task in islice(waiting, max(room, 0)):
                future = self._client.submit(run_task, task, pure=False)
                open_tasks[future] = task
                completed.add(future)
            if not open_tasks:
                return
            future = next(completed)
            task = open_tasks.pop(future)
            yield task, outcome(future.result)

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._client.close()


def outcome(result: Callable[[], bytes]) -> bytes | str:
    """What a task gave; the sentence why it gave nothing."""
    try:
        return result()
    except BrokenProcessPool:
        return "its worker process ended: it needs more memory than there is, or a library crashed on it"
    except Exception as error:  # of any library on a hostile file
        return f"a fault of the program: {type(error).__name__}: {str(error)[:1000]}"


def begin() -> None:
    """In a new process: the parent handles Ctrl-C, and the process does not outlive the parent."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    parent = multiprocessing.parent_process()
    if parent is not None:
        threading.Thread(target=_end_with, args=(parent.sentinel,), name="parent", daemon=True).start()


def _end_with(sentinel: int) -> None:
    wait_for_end([sentinel])
    os._exit(1)
