"""Makes sample blocks of bursts of bytes that hold frames of fixed length; needs no port."""

from __future__ import annotations

import itertools
from abc import ABC, abstractmethod
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from hw.block import BlockFlags, Drop, SampleBlock
from hw.cutting import MOST_BREAKS, Break, Cutter, Stretch
from hw.frames import Found, Layout, find

NO_FRAME = "no frame"
NOT_FOLLOWING = (
    "most samples do not follow the one before, by their counter or time, or by bytes between them that are no frames; "
    "check what the configuration says of rate and frames, and the cable"
)


@dataclass(frozen=True, slots=True, eq=False)
class Decoded:
    """Samples of a sequence of frames.

    `indications` (n, axes); `frame` (n,) is the index of the frame that completed each sample.
    """

    indications: NDArray[np.int32] | NDArray[np.float64]
    frame: NDArray[np.int64]
    breaks: list[Break]
    temperature_raw: int | None = None
    temperature_degc: float | None = None


class FrameStream(ABC):
    """Collects bursts with `feed` and decodes all of them in `blocks`.

    Between calls it keeps the bytes that may still become a frame, each with the arrival of its burst. A stretch in
    which most samples do not follow the one before is dropped with the reason: blocks of one sample are of no use and
    would fill the queue to the pipeline.
    """

    def __init__(self, cutter: Cutter, layout: Layout) -> None:
        self._cutter = cutter
        self._layout = layout
        self._dropped = self._not_following = 0
        self.begin()

    @abstractmethod
    def _decode(self, found: Found) -> Decoded:
        """Return the samples of these frames."""

    def _find(self, data: bytes) -> Found:
        """Find the frames in `data`, which begins with the rest of the call before."""
        return find(data, self._layout)

    def begin(self) -> None:
        """Start after a port was opened.

        The bytes up to the first frame are the rest of a frame and are not counted as dropped.
        """
        self._listening = False
        self._slipped = False
        self._bursts: list[bytes] = []  # what no call has decided yet
        self._arrivals_ns: list[int] = []
        self._utc_ns = 0
        self.size = 0
        self._cutter.flag(BlockFlags.RESTART)

    def feed(self, data: bytes, arrival_ns: int, utc_ns: int) -> None:
        """Add one burst (`data`) and its arrival time, ns."""
        self._bursts.append(data)
        self._arrivals_ns.append(arrival_ns)
        self._utc_ns = utc_ns
        self.size += len(data)

    def blocks(self) -> list[SampleBlock]:
        """Decode everything fed since the last call and return its blocks."""
        if not self.size:
            return []
        self.size = 0
        read = np.cumsum([len(burst) for burst in self._bursts])
        arrivals_ns = np.array(self._arrivals_ns, np.int64)
        found = replace(self._find(b"".join(self._bursts)), slipped_before=self._slipped)
        self._keep(found, read)
        self._dropped += found.dropped
        if not self._listening:
            self._dropped -= int(found.start[0]) if len(found.start) else found.dropped
            self._listening = bool(len(found.start))
        self._slipped = bool(found.slipped[-1])
        decoded = self._decode(found)
        if len(decoded.breaks) > max(MOST_BREAKS, len(decoded.frame) // 2):
            self._not_following += len(decoded.frame)
            self._cutter.flag(BlockFlags.RESTART)
            return []
        ends = found.end[decoded.frame]
        return self._cutter.cut(
            Stretch(
                decoded.indications,
                arrivals_ns,
                np.searchsorted(ends, read, side="right"),
                self._utc_ns,
                decoded.temperature_raw,
                decoded.temperature_degc,
            ),
            decoded.breaks,
        )

    def _keep(self, found: Found, read: NDArray[np.int64]) -> None:
        """Keep the bytes that are not decided; `read` (B,) are the positions after each burst."""
        first = int(np.searchsorted(read, found.rest_at, side="right"))
        edges = [found.rest_at, *read[first:].tolist()]
        self._bursts = [found.data[begin:end] for begin, end in itertools.pairwise(edges)]
        self._arrivals_ns = self._arrivals_ns[first:]

    def take_drops(self) -> list[Drop]:
        """Bytes that belong to no frame, and samples of dropped stretches, since the last call."""
        bytes_, samples = self._dropped, self._not_following
        self._dropped = self._not_following = 0
        drops = (Drop(bytes_, "bytes", NO_FRAME), Drop(samples, "samples", NOT_FOLLOWING))
        return [drop for drop in drops if drop.count]
