"""Finds frames of fixed length that have no checksum, by the one place in the stream at which all of them fit."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from hw.frames import Found, Layout

AGREEMENT_BITS = 64  # of start and end bytes in neighbouring frames, before their place is believed


class UncheckedFrames:
    """Finds the frames in the pieces of a stream, one piece after the other.

    A place is an offset modulo the length of a frame. A byte inside a frame that is always the same can look like the
    beginning of the frame. So a place is taken only where the start and end bytes of all frames fit, their counter
    rises evenly, and no other place fits. The place is kept as long as each frame fits.

    Nothing proves a single frame. A frame is found only where the frame before it fits too and, without end bytes,
    where another frame begins behind it. So a byte that is lost or added costs the frames beside it, too. A frame whose
    counter does not count on from the frame before it is left out, too: where bytes were lost, it may consist of halves
    of two frames. Two such frames, one behind the other, are at a wrong place. Changed bytes between start and end are
    not noticed.

    - `count(frames)`: the unsigned counter (n,) in frames (n, length); None where the frames have none.
    - `places`: number of places that fit all `undecided` frames at the end of the last piece; 0 where none was left
      open.
    """

    def __init__(
        self, layout: Layout, count: Callable[[NDArray[np.uint8]], NDArray[np.unsignedinteger]] | None = None
    ) -> None:
        self._layout = layout
        self._count = count
        self._least = max(2, -(-AGREEMENT_BITS // (8 * len(layout.start + layout.end))))  # frames that must agree
        self._in_step = False  # a frame is expected at the first byte of the next piece
        self._last = self._step = 0  # the newest count, and by how much it rises
        self._jumped = False  # whether the newest frame did not count on
        self.places = self.undecided = 0

    def find(self, data: bytes) -> Found:
        """Find the frames in `data`: the rest of the piece before, and new bytes."""
        length, end = self._layout.length, self._layout.end
        begins = _matches(data, self._layout.start)
        fits = begins[: max(0, len(data) - length + 1)] & _matches(data, end)[length - len(end) :]
        sound = fits if end else fits[: len(begins[length:])] & begins[length:]
        counts = self._counts(data)
        starts = [np.empty(0, np.int64)]
        at, self.places, self.undecided = 0, 0, 0
        while True:
            if not self._in_step:
                at, place = self._place(counts, fits, at)
                if place is None:
                    break
                at += place + length
                if counts is not None:
                    self._last, self._step = (
                        int(counts[at - length]),
                        int((counts[at : at + 1] - counts[at - length])[0]),
                    )
            run = sound[at::length]
            n = len(run) if run.all() else int(run.argmin())
            start = at + length * np.arange(n)
            if counts is not None and n:
                on = self._count_on(counts[start])
                n = len(on)
                start = start[:n][on]
            starts.append(start)
            at += n * length
            self._in_step = n == len(run)
            if self._in_step:
                break
        found = np.concatenate(starts)
        return Found(data, found, found + length, at, length)

    def _place(
        self, counts: NDArray[np.unsignedinteger] | None, fits: NDArray[np.bool_], at: int
    ) -> tuple[int, int | None]:
        """The first position from `at` on from which one place fits alone, and this place; None where more bytes must
        tell."""
        length = self._layout.length
        steps = None if counts is None else counts[length:] - counts[:-length]  # modulo their type
        alive, n = np.ones(length, np.bool_), 0
        while at + (n + 1) * length <= len(fits):
            alive &= fits[at + n * length :][:length]
            if steps is not None and n:
                step = steps[at + (n - 1) * length :][:length]
                alive &= (step == steps[at:][:length]) & (step != 0)
            n += 1
            if not alive.any():
                at, n, alive = at + length, 0, np.ones(length, np.bool_)
            elif n >= self._least and alive.sum() == 1:
                return at, int(alive.argmax())
        if n >= self._least:
            self.places, self.undecided = int(alive.sum()), n
        return at, None

    def _counts(self, data: bytes) -> NDArray[np.unsignedinteger] | None:
        """The counter of a frame at each position, as far as there are whole frames."""
        if self._count is None:
            return None
        padded = np.frombuffer(data.ljust(self._layout.length, b"\0"), np.uint8)
        return self._count(sliding_window_view(padded, self._layout.length))[
            : max(0, len(data) - self._layout.length + 1)
        ]

    def _count_on(self, counts: NDArray[np.unsignedinteger]) -> NDArray[np.bool_]:
        """Whether frames that lie one behind the other count on from the frame before them, up to the first two that do
        not."""
        on = np.asarray(np.diff(counts, prepend=counts.dtype.type(self._last)) == self._step)
        off = ~np.insert(on, 0, not self._jumped)
        twice = off[1:] & off[:-1]
        if twice.any():
            on = on[: int(twice.argmax())]
        if len(on):
            self._last, self._jumped = int(counts[len(on) - 1]), not on[-1]
        return on


def _matches(data: bytes, pattern: bytes) -> NDArray[np.bool_]:
    """(len(data) - len(pattern) + 1,): whether `pattern` stands at each position."""
    octets = np.frombuffer(data, np.uint8)
    found = np.ones(max(0, len(data) - len(pattern) + 1), np.bool_)
    for i, octet in enumerate(pattern):
        found &= octets[i : i + len(found)] == octet
    return found
