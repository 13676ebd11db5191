"""Replaces the library sounddevice, with one sound card connected."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

BUFFER_S = 1.0


class PortAudioError(Exception):
    """Like the error of the library."""


class SoundCardTwin:
    """Replaces the module. `source(first, n)` returns (n, 2) 24-bit counts, `samples_due()` how many samples exist.

    A full buffer drops the newest samples, and the next read reports an overflow, like with PortAudio.
    """

    PortAudioError = PortAudioError

    def __init__(
        self, name: str, source: Callable[[int, int], NDArray[np.int32]], samples_due: Callable[[], int]
    ) -> None:
        self.name = name
        self.plugged = True
        self.next = 0
        self.lost = 0
        self._source = source
        self.samples_due = samples_due

    def query_devices(self, index: int | None = None) -> Any:
        """All cards, or one."""
        cards = [{"name": "HDA Intel PCH: ALC (hw:0,0)", "index": 0, "max_input_channels": 2}]
        if self.plugged:
            cards.append({"name": self.name, "index": 1, "max_input_channels": 2})
        return cards if index is None else cards[index]

    def InputStream(self, **settings: Any) -> Stream:  # noqa: N802 - the library's name
        """Open a stream from the card."""
        if settings["samplerate"] > 48000:
            raise PortAudioError("Invalid sample rate [PaErrorCode -9997]")
        return Stream(self, settings["samplerate"])

    def take(self, n: int) -> NDArray[np.int32]:
        """The next n frames, left-justified like those of the library."""
        frames = self._source(self.next, n) << 8
        self.next += n
        return frames


class Stream:
    """Replaces the object that `InputStream` returns."""

    def __init__(self, card: SoundCardTwin, rate_hz: float) -> None:
        self._card = card
        self._capacity = int(BUFFER_S * rate_hz)

    def start(self) -> None:
        """Start to keep samples."""
        self._card.next = self._card.samples_due()

    def close(self, ignore_errors: bool = True) -> None:
        """Close the stream."""

    @property
    def read_available(self) -> int:
        """Frames that can be read now."""
        if not self._card.plugged:
            raise PortAudioError("Unanticipated host error [PaErrorCode -9999]")
        return min(self._card.samples_due() - self._card.next, self._capacity)

    def read(self, n: int) -> tuple[NDArray[np.int32], bool]:
        """Frames (n, 2), and whether frames were lost."""
        frames = self._card.take(n)
        over = self._card.samples_due() - self._card.next
        lost, self._card.lost = self._card.lost or over, 0
        self._card.next += over
        return frames, bool(lost)
