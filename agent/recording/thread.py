"""The one thread that owns the recording, and hands results on once the disk has them."""

from __future__ import annotations

import logging
import math
import queue
import threading
import time
from collections.abc import Callable, Sequence
from contextlib import suppress

from agent.core.events import Event, Output, Pruned, Result, RunStart
from agent.core.memory import Memory
from agent.recording.messages import recorded_ones
from agent.recording.writer import Recorder

FLUSH_S = 2.0  # s; a power cut costs at most this much of the recording, for 11 % more disk than one long chunk
LOOK_S = 10.0  # s; how often it is asked whether recordings are due to be deleted
CAPACITY = 256  # events; half a minute of two devices and ticks, while a slow card takes its time
# s; what waits for the disk when a run ends has this long. systemd kills after 10, and files are to be closed first.
CLOSE_S = 4.0
HANG_S = 4.0  # s; then for the one call it is in, the store and the end of the file; beyond, the disk does not answer

_log = logging.getLogger(__name__)

Deliver = Callable[[int, Sequence[Result], bool, Sequence[Memory]], None]


Entry = tuple[int, Event, Sequence[Output], Sequence[Memory]]


class RecordingThread:
    """Takes events with their results from the main loop, in order, and records them.

    `deliver(event_sequence, results, recorded, memories)` is called in this thread after the results are on disk (or,
    with `recorded` false, could not be); it must not raise. What is raised nevertheless comes out of the next `put`.
    """

    def __init__(
        self, recorder: Recorder, deliver: Deliver, *, flush_s: float = FLUSH_S, close_s: float = CLOSE_S
    ) -> None:
        self._recorder = recorder
        self._deliver = deliver
        self._flush_s = flush_s
        self._close_s = close_s
        self._give_up_at = math.inf
        self._queue: queue.Queue[Entry | None] = queue.Queue(CAPACITY)
        self._starts_sent = self._starts_done = 0
        self._pruning_sent = False
        self._error: BaseException | None = None
        self._thread = threading.Thread(target=self._run, name="recording", daemon=True)
        self._thread.start()

    @property
    def wants_rotation(self) -> bool:
        """Whether the next event should be a RunStart; false while one is on its way."""
        return self._starts_sent == self._starts_done and self._recorder.wants_rotation

    def take_pruning(self) -> Pruned | None:
        """The next event, where recordings are due to be deleted; None while one is on its way."""
        return None if self._pruning_sent else self._recorder.pruning

    @property
    def waiting(self) -> int:
        """Events that wait for the disk; `put` waits from CAPACITY on."""
        return self._queue.qsize()

    def put(
        self, event_sequence: int, event: Event, outputs: Sequence[Output], memories: Sequence[Memory] = ()
    ) -> None:
        """Hand over an event and what came of it; waits while the disk is far behind."""
        if isinstance(event, RunStart):
            self._starts_sent += 1
        elif isinstance(event, Pruned):
            self._pruning_sent = True
        self._hand_over((event_sequence, event, recorded_ones(outputs), memories))

    def close(self) -> bool:
        """Record what is waiting, for `close_s` at most, and finish the file; nothing may be put any more.

        The results of what was not recorded are delivered as such. Returns whether the thread has ended: where the disk
        does not answer it is left behind, and may still hold what `deliver` uses.
        """
        end = self._give_up_at = time.monotonic() + self._close_s
        if self._thread.is_alive():
            with suppress(queue.Full):  # then it does not wait for this word
                self._queue.put(None, timeout=self._close_s)
        self._thread.join(max(0.0, end - time.monotonic()) + HANG_S)
        self._raise()
        if self._thread.is_alive():
            _log.error("the disk does not answer: the recording is left unfinished, %d events wait", self.waiting)
        return not self._thread.is_alive()

    def _hand_over(self, entry: Entry) -> None:
        while True:
            self._raise()
            try:
                return self._queue.put(entry, timeout=1.0)
            except queue.Full:
                continue  # look again whether the thread still lives

    def _raise(self) -> None:
        if self._error is not None:
            raise self._error

    def _run(self) -> None:
        try:
            self._loop()
        except BaseException as error:
            self._error = error
        finally:
            self._recorder.close()

    def _loop(self) -> None:
        flush_at = time.monotonic() + self._flush_s
        look_at = time.monotonic()
        while True:
            if time.monotonic() >= look_at:
                self._recorder.look_for_pruning()
                look_at = time.monotonic() + LOOK_S
            if time.monotonic() >= flush_at:
                self._recorder.sync()
                flush_at = time.monotonic() + self._flush_s
            try:
                entry = self._queue.get(timeout=max(0.0, flush_at - time.monotonic()))
            except queue.Empty:
                continue
            if entry is None:
                return
            if time.monotonic() >= self._give_up_at:
                self._give_up(entry)
                return
            event_sequence, event, outputs, memories = entry
            recorded = self._recorder.record(event_sequence, event, outputs)
            results = [item for item in outputs if isinstance(item, Result)]
            self._starts_done += isinstance(event, RunStart)
            if isinstance(event, Pruned):
                self._pruning_sent = False
            if results:
                self._deliver(event_sequence, results, recorded, memories)

    def _give_up(self, entry: Entry) -> None:
        """The results that wait, from `entry` on, at once: each alone would wait for the disk."""
        waiting = [entry]
        with suppress(queue.Empty):
            while (following := self._queue.get_nowait()) is not None:
                waiting.append(following)
        results = [item for _, _, outputs, _ in waiting for item in outputs if isinstance(item, Result)]
        _log.warning(
            "the disk is too slow to record what waited: events %d to %d are not recorded, %d results are kept without",
            entry[0], waiting[-1][0], len(results),
        )  # fmt: skip
        if results:
            memories = [memory for _, _, _, memories in waiting for memory in memories]
            self._deliver(waiting[-1][0], results, False, memories)
