"""Limits of what a recording may hold: checked before anything is decompressed, so a small file costs little.

A recording that this program writes stays within the limits: the writer begins a new file, or leaves a large message
uncompressed, before it reaches one. A reader refuses the record that exceeds a limit.
"""

from __future__ import annotations

from mcap.opcode import Opcode

# Bytes of a chunk as it stands in the file. The largest has a snapshot; the largest snapshot that a configuration
# allows (10 kHz, six axes) has 76 MB. What is so large must stand in the file uncompressed.
CHUNK_LIMIT = 128 << 20
RECORD_LIMIT = 2 << 20  # bytes of any other record; a MessageIndex of 65,536 messages has 1 MiB
ATTACHMENT_LIMIT = 9 << 20  # bytes; what a repair sets aside has 8 MiB at most
DECLARATION_LIMIT = 64 << 10  # bytes of a Schema or Channel; ours have less than 6 kB
UNPACKED_LIMIT = 8 << 20  # bytes of a compressed chunk after decompression; ours have 1 MiB, most have 43 kB
MOST_MESSAGES_IN_CHUNK = 1 << 16
MOST_RESULTS = 10_000  # of one event; a hundred channels give some hundred
# Of all chunks of a file together, in bytes after decompression: a fixed part, and a part for each byte of the file.
# Samples of working sensors shrink to a half; zeros shrink to a 32,000th.
UNPACKED_FIXED, UNPACKED_PER_BYTE = 256 << 20, 64
# Each message has 16 bytes in a MessageIndex, which is never compressed.
MESSAGES_FIXED, BYTES_PER_MESSAGE = 1 << 16, 16
MOST_RECORDS = {  # of one kind in a file
    Opcode.SCHEMA: 1 << 8,
    Opcode.CHANNEL: 1 << 12,
    Opcode.CHUNK: 1 << 18,
    Opcode.CHUNK_INDEX: 1 << 18,
    Opcode.METADATA: 1 << 10,
    Opcode.METADATA_INDEX: 1 << 10,
    Opcode.ATTACHMENT: 1 << 8,
    Opcode.ATTACHMENT_INDEX: 1 << 8,
    Opcode.STATISTICS: 1,
    Opcode.SUMMARY_OFFSET: 16,
}


class LimitExceededError(ValueError):
    """A record exceeds a limit. The message names the value and the limit."""


def most_unpacked(size: int) -> int:
    """Bytes that the chunks in the first `size` bytes of a file may have after decompression."""
    return UNPACKED_FIXED + UNPACKED_PER_BYTE * size


def longest(opcode: int) -> int:
    """The most bytes that a record of this kind may have."""
    if opcode == Opcode.CHUNK:
        return CHUNK_LIMIT
    if opcode == Opcode.ATTACHMENT:
        return ATTACHMENT_LIMIT
    return DECLARATION_LIMIT if opcode in (Opcode.SCHEMA, Opcode.CHANNEL) else RECORD_LIMIT


class UsedLimits:
    """What of the limits for a whole file is used. One budget belongs to one pass over one file.

    After a limit was exceeded, each further record of a chunk is refused too, so that nothing more is decompressed.
    """

    def __init__(self) -> None:
        self._records: dict[int, int] = {}
        self._unpacked = 0
        self._messages = 0
        self._exceeded = ""

    def take_record(self, opcode: int, length: int) -> None:
        """Count a record of `length` bytes, before it is read. Raises LimitExceededError."""
        if length > longest(opcode):
            self._refuse(f"its {length} bytes are more than the limit of {longest(opcode)}")
        self._records[opcode] = count = self._records.get(opcode, 0) + 1
        most = 2 * MOST_RECORDS[Opcode(opcode)] if opcode in MOST_RECORDS else None  # the summary repeats some
        if most is not None and count > most:
            self._refuse(f"the file has more than {most} records of this kind")

    def take_chunk(self, end: int, unpacked: int) -> None:
        """Count the bytes of a chunk that ends at byte `end` of the file, before they are decompressed.

        Raises LimitExceededError.
        """
        if self._exceeded:
            raise LimitExceededError(f"not decompressed, because a record before it exceeds a limit: {self._exceeded}")
        self._unpacked += unpacked
        if self._unpacked > most_unpacked(end):
            self._refuse(
                f"the chunks up to here have {self._unpacked} bytes decompressed, more than the limit of "
                f"{most_unpacked(end)} for {end} bytes of a file"
            )

    def take_messages(self, end: int, count: int) -> None:
        """Count the messages of a chunk that ends at byte `end` of the file. Raises LimitExceededError."""
        self._messages += count
        most = MESSAGES_FIXED + end // BYTES_PER_MESSAGE
        if count > MOST_MESSAGES_IN_CHUNK or self._messages > most:
            self._refuse(
                f"{count} messages in this chunk and {self._messages} up to here; at most {MOST_MESSAGES_IN_CHUNK} "
                f"and {most} are allowed"
            )

    def _refuse(self, reason: str) -> None:
        self._exceeded = reason
        raise LimitExceededError(reason)
