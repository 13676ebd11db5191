"""A device on a pseudo-terminal, which pyserial treats like a USB serial sensor; it can be unplugged."""

from __future__ import annotations

import contextlib
import errno
import os
import select
import tempfile
import threading
import time
import tty
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

BURST_S = 0.008  # USB adapters deliver bytes every 1 to 16 ms


class PtyDevice:
    """Sends the text that is due to the reader that has the port open, and never waits for the reader.

    - `text_due(t_s)` returns the text that became due since its last call, as bytes.
    - `clock()`: time of the device, s.
    - `received(data)` gets the bytes that are sent to the device.
    - `path`: a symbolic link that stays the same over `unplug` and `replug`.

    Either `start` a thread that serves in bursts, or call `serve` yourself. As on a real line, bytes that nobody reads
    are lost: all of them without a reader, and with a slow reader those that do not fit into the kernel's buffer
    (`lost_bytes`).
    """

    def __init__(
        self,
        text_due: Callable[[float], bytes],
        clock: Callable[[], float] = time.monotonic,
        link: Path | None = None,
        received: Callable[[bytes], None] | None = None,
    ) -> None:
        self._text_due = text_due
        self._clock = clock
        self._received = received
        self._directory = tempfile.TemporaryDirectory(prefix="fieldcal-") if link is None else None
        self.path = Path(self._directory.name) / "port" if self._directory else Path(link or "")
        self.lost_bytes = 0
        self._garbage = b""
        self._master: int | None = None
        self._lock = threading.Lock()  # serve() and unplug() or replug() must not run at the same time
        self._stop = threading.Event()
        self._thread: threading.Thread | None = None
        self.replug()

    def replug(self) -> None:
        """Make the port again: a new terminal under the same path. Raises FileExistsError if the path exists."""
        with self._lock:
            if self._master is not None:
                return
            master, slave = os.openpty()
            try:
                tty.setraw(slave)  # otherwise the terminal echoes what the device sent before the port was opened
                os.set_blocking(master, False)
                self.path.symlink_to(os.ttyname(slave))
            except BaseException:
                os.close(master)
                raise
            finally:
                os.close(slave)  # only then the master is told whether a reader has the port open
            self._master = master

    def unplug(self) -> None:
        """Unplug: the next call of a reader fails, and the path is removed."""
        with self._lock:
            if self._master is not None:
                os.close(self._master)
                self._master = None
                self.path.unlink(missing_ok=True)

    def has_reader(self) -> bool:
        """Whether a reader has the port open."""
        with self._lock:
            return self._open_for_reading()

    def inject(self, garbage: bytes) -> None:
        """Send these bytes before the next text."""
        self._garbage += garbage

    def serve(self) -> None:
        """Receive the bytes that were sent to the device, then send what is due."""
        self._listen()
        text = self._garbage + self._text_due(self._clock())
        self._garbage = b""
        with self._lock:
            written = 0
            if self._master is not None and text and self._open_for_reading():
                with contextlib.suppress(BlockingIOError):
                    written = os.write(self._master, text)
            self.lost_bytes += len(text) - written

    def _listen(self) -> None:
        with self._lock:
            if self._received is None or self._master is None or not self._open_for_reading():
                return
            try:
                commands = os.read(self._master, 4096)
            except BlockingIOError:
                return
            except OSError as error:
                if error.errno != errno.EIO:
                    raise
                return  # the reader has closed the port since it was looked whether there is one
        self._received(commands)

    def start(self) -> None:
        """Serve from a thread until `stop`."""
        self._stop.clear()
        self._thread = threading.Thread(target=self._run, name=f"pty {self.path}", daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """End the thread, hang up and remove the path."""
        self._stop.set()
        if self._thread is not None:
            self._thread.join()
            self._thread = None
        self.unplug()
        if self._directory is not None:
            self._directory.cleanup()

    def _run(self) -> None:
        while not self._stop.wait(BURST_S):
            self.serve()

    def _open_for_reading(self) -> bool:
        if self._master is None:
            return False
        poll = select.poll()
        poll.register(self._master, 0)
        return not any(event & select.POLLHUP for _, event in poll.poll(0))


class SampleLines:
    """Text of a sampled signal in the serial text protocol, for `PtyDevice`.

    `values(first, n)` returns (n, axes) indications; `samples_due(t_s)` the number of samples that exist at `t_s`. The
    text starts with a comment, because a reader discards the line during which it opened the port.
    """

    def __init__(
        self,
        values: Callable[[int, int], NDArray[np.float64]],
        samples_due: Callable[[float], int],
        *,
        sequence: bool = True,
        decimals: int = 6,
    ) -> None:
        self._values = values
        self._samples_due = samples_due
        self._sequence = sequence
        self._format = f"%.{decimals}f"
        self._next = 0
        self._greeting = b"# fieldcal virtual device\n"

    def __call__(self, t_s: float) -> bytes:
        due = self._samples_due(t_s) - self._next
        if due <= 0:
            return b""
        text = self._greeting + format_lines(
            self._values(self._next, due), self._format, self._next if self._sequence else None
        )
        self._next += due
        self._greeting = b""
        return text


def format_lines(values: NDArray[np.float64], number: str = "%.6f", first_sequence: int | None = None) -> bytes:
    """Lines of the serial text protocol for (n, axes) values, with sequence numbers if the first one is given."""
    fields: Sequence[str] = [number] * values.shape[1]
    if first_sequence is not None:
        fields = ["%d", *fields]
        values = np.column_stack([np.arange(first_sequence, first_sequence + len(values)), values])
    return ((",".join(fields) + "\n") * len(values) % tuple(values.ravel().tolist())).encode("ascii")
