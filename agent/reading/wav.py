"""WAV files: integers of 8 to 32 bits and floating-point numbers, one column for each channel."""

from __future__ import annotations

import os
import struct
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from agent.reading.source import Arrays, Column, Grid, TableError
from calib.model import Slices

PCM, FLOAT, EXTENSIBLE = 1, 3, 0xFFFE
MOST_CHANNELS = 256
# By the kind of numbers and their bits; unsigned integers of 8 bits have their zero at 128.
TYPES = {(PCM, 8): "u1", (PCM, 16): "<i2", (PCM, 32): "<i4", (FLOAT, 32): "<f4", (FLOAT, 64): "<f8"}
# Integers are parts of full scale, as other programs read them too.
FULL_SCALE = {8: 128.0, 16: 2.0**15, 24: 2.0**23, 32: 2.0**31}


class WavChannel:
    """One channel of frames on disk, as floating-point numbers: integers divided by full scale."""

    def __init__(self, frames: NDArray[np.generic], channel: int, bits: int, kind: int) -> None:
        self._frames, self._channel, self._bits, self._kind = frames, channel, bits, kind

    def __len__(self) -> int:
        return len(self._frames)

    def __getitem__(self, rows: slice, /) -> NDArray[np.float64]:
        part = self._frames[rows, self._channel]
        if self._kind == FLOAT:
            return part.astype(np.float64)
        if self._bits == 24:
            high = part.reshape(-1, 3).astype(np.int32)
            whole = high[:, 0] << 8 | high[:, 1] << 16 | high[:, 2] << 24
            return (whole >> 8) / FULL_SCALE[24]
        zero = 128.0 if self._bits == 8 else 0.0
        return np.asarray((part.astype(np.float64) - zero) / FULL_SCALE[self._bits])


def _chunks(path: Path) -> tuple[bytes, tuple[int, int]]:
    """The chunk that describes the samples, and where those are: offset and length in bytes. Raises TableError."""
    size = path.stat().st_size
    with path.open("rb") as file:
        head = file.read(12)
        if len(head) < 12 or head[:4] != b"RIFF" or head[8:] != b"WAVE":
            raise TableError(f"{path}: the file is not RIFF/WAVE; write it as WAV with a 32-bit size")
        form, data = b"", (0, 0)
        while len(chunk := file.read(8)) == 8 and not data[1]:
            name, length = chunk[:4], int.from_bytes(chunk[4:], "little")
            at = file.tell()
            if name == b"fmt ":
                form = file.read(min(length, 40))
            elif name == b"data":
                data = (at, min(length, size - at))  # a recorder that lost power leaves a size that is too large
            file.seek(at + length + length % 2, os.SEEK_SET)
    if len(form) < 16 or not data[1]:
        raise TableError(f"{path}: the file has no {'samples' if len(form) >= 16 else 'format'}; write it anew")
    return form, data


def open_wav(path: Path) -> Arrays:
    """A WAV file as columns `time_s`, `ch1`, `ch2`, ... Raises TableError."""
    form, data = _chunks(path)
    kind, channels, rate_hz, _, frame, bits = struct.unpack_from("<HHIIHH", form)
    if kind == EXTENSIBLE and len(form) >= 26:
        kind = int.from_bytes(form[24:26], "little")
    if (kind, bits) not in TYPES and (kind, bits) != (PCM, 24):
        raise TableError(f"{path}: format {kind} with {bits} bits is not read; write it as 16, 24 or 32 bits or float")
    if not 0 < channels <= MOST_CHANNELS or not rate_hz or frame != channels * bits // 8:
        raise TableError(
            f"{path}: {channels} channels, {bits} bits, {rate_hz} Hz and frames of {frame} bytes do not agree; write "
            "the file anew"
        )
    samples = data[1] // frame
    if not samples:
        raise TableError(f"{path}: the file has no samples; write it anew")
    shape: tuple[int, ...] = (samples, channels, 3) if bits == 24 else (samples, channels)
    frames = np.memmap(path, TYPES.get((kind, bits), "u1"), "r", data[0], shape)
    values: dict[Column, Slices] = {Column("time_s", "s"): Grid(0.0, float(rate_hz), samples)}
    return Arrays(path, values | {Column(f"ch{k + 1}"): WavChannel(frames, k, bits, kind) for k in range(channels)})
