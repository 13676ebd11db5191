"""The chain of a gateway's results: one digest that changes with every result recorded so far, and with their order.

It begins with 32 zero bytes. With each result it becomes SHA-256(digest, topic, a zero byte, message), where the
message is the bytes that the recording stores. A file begins with the digest at the end of the file before it.
"""

from __future__ import annotations

import hashlib
import re
from dataclasses import dataclass

from agent.core.events import Result
from agent.recording.messages import MessageError, decode, is_result_topic, schema_of

FILE_METADATA = "fieldcal.file"  # the metadata record at the beginning of each recording
PREVIOUS_RESULTS = "previous_results"  # in it: the chain at the end of the file before, as text
EPOCH = "epoch"  # in it: the epoch of the store when the recording began
_AS_TEXT = re.compile(r"(\d{1,19}) ([0-9a-f]{64})")


@dataclass(slots=True)
class ResultsChain:
    """`digest`: of all results so far. `last`: topic and message of the last one, where this file holds one."""

    digest: bytes = bytes(32)
    before: int = 0  # sequence of the last result before this file
    last: tuple[str, bytes] | None = None

    @staticmethod
    def of_text(text: str) -> ResultsChain:
        """The chain that `text` names; a new one where it names none."""
        match = _AS_TEXT.fullmatch(text)
        return ResultsChain(bytes.fromhex(match[2]), int(match[1])) if match else ResultsChain()

    def add(self, topic: str, message: bytes) -> None:
        """Take the next recorded message; only results count."""
        if is_result_topic(topic):
            self.digest = hashlib.sha256(self.digest + topic.encode() + b"\0" + message).digest()
            self.last = (topic, message)

    @property
    def text(self) -> str:
        """`<sequence of the last result> <digest>`, as signatures and heads name the chain."""
        return f"{self.sequence} {self.digest.hex()}"

    @property
    def sequence(self) -> int:
        """The sequence of the last result; 0 where there is none."""
        if self.last is None:
            return self.before
        topic, message = self.last
        try:
            _, result = decode(schema_of(topic), message)
        except MessageError:
            return 0
        return result.sequence if isinstance(result, Result) else 0
