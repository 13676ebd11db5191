"""The thread that writes the recording. It passes results on after they are on disk."""

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

FLUSH_S = 2.0  # s between two flushes; a power cut loses at most this much. Takes 11 % more disk than one long chunk
LOOK_S = 10.0  # s between two checks whether recordings are due to be deleted
CAPACITY = 256  # events that may wait for a slow disk; half a minute of two devices and ticks
# s that events still waiting at the end of a run have to be written. systemd kills the agent after 10 s, and the files
# must be closed before that.
CLOSE_S = 4.0
# s more for the call to the disk that is under way, for the store and for closing the file. After that the disk counts
# as not responding.
HANG_S = 4.0

_log = logging.getLogger(__name__)

Deliver = Callable[[int, Sequence[Result], bool, Sequence[Memory]], None]


Entry = tuple[int, Event, Sequence[Output], Sequence[Memory]]


class RecordingThread:
    """Takes events with their results from the main loop, in order, and records them in a thread of its own.

    `deliver(event_sequence, results, recorded, memories)` is called in this thread after the results are on disk;
    `recorded` is false where they could not be written. It must not raise. An exception that it raises nevertheless
    ends the thread and is raised again by the next `put` or `close`.
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
        self._whole = True
        self._error: BaseException | None = None
        self._thread = threading.Thread(target=self._run, name="recording", daemon=True)
        self._thread.start()

    @property
    def wants_rotation(self) -> bool:
        """Whether the next event should be a RunStart (a new file); false while a RunStart waits to be recorded."""
        return self._starts_sent == self._starts_done and self._recorder.wants_rotation

    def take_pruning(self) -> Pruned | None:
        """The Pruned event to record next, where recordings are due to be deleted; None while one waits."""
        return None if self._pruning_sent else self._recorder.pruning

    @property
    def waiting(self) -> int:
        """Number of events that wait for the disk; at CAPACITY, `put` blocks."""
        return self._queue.qsize()

    @property
    def whole(self) -> bool:
        """Whether the last event is in a recording, which has no fault. Asked after `close`."""
        return self._whole and not self._recorder.fault

    def put(
        self, event_sequence: int, event: Event, outputs: Sequence[Output], memories: Sequence[Memory] = ()
    ) -> None:
        """Hand over an event, its outputs and its states; blocks while CAPACITY events wait.

        Raises what ended the thread, where it has ended.
        """
        if isinstance(event, RunStart):
            self._starts_sent += 1
        elif isinstance(event, Pruned):
            self._pruning_sent = True
        self._hand_over((event_sequence, event, recorded_ones(outputs), memories))

    def close(self) -> bool:
        """Record the waiting events, for `close_s` seconds at most, and finish the file. After this call no `put`.

        Results of events that could not be recorded in that time are delivered with `recorded` false.
        Returns whether the thread has ended. Where the disk does not respond the thread goes on, and may still use
        what `deliver` uses.
        """
        end = self._give_up_at = time.monotonic() + self._close_s
        if self._thread.is_alive():
            with suppress(queue.Full):  # the thread is behind; it ends when it reaches `_give_up_at`
                self._queue.put(None, timeout=self._close_s)
        self._thread.join(max(0.0, end - time.monotonic()) + HANG_S)
        self._raise()
        if self._thread.is_alive():
            _log.error(
                "the disk does not respond: the recording is left unfinished, and %d events are not recorded; the next "
                "start repairs the file",
                self.waiting,
            )
        return not self._thread.is_alive()

    def _hand_over(self, entry: Entry) -> None:
        while True:
            self._raise()
            try:
                return self._queue.put(entry, timeout=1.0)
            except queue.Full:
                continue  # `_raise` then sees whether the thread has failed

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
            recorded = self._whole = self._recorder.record(event_sequence, event, outputs)
            results = [item for item in outputs if isinstance(item, Result)]
            self._starts_done += isinstance(event, RunStart)
            if isinstance(event, Pruned):
                self._pruning_sent = False
            if results:
                self._deliver(event_sequence, results, recorded, memories)

    def _give_up(self, entry: Entry) -> None:
        """Deliver the results of `entry` and of all waiting events in one call, since each call waits for the disk."""
        self._whole, waiting = False, [entry]
        with suppress(queue.Empty):
            while (following := self._queue.get_nowait()) is not None:
                waiting.append(following)
        results = [item for _, _, outputs, _ in waiting for item in outputs if isinstance(item, Result)]
        _log.warning(
            "the disk is too slow to record the last events: events %d to %d are not in the recording; "
            "their %d results are kept in the store only",
            entry[0], waiting[-1][0], len(results),
        )  # fmt: skip
        if results:
            memories = [memory for _, _, _, memories in waiting for memory in memories]
            self._deliver(waiting[-1][0], results, False, memories)
