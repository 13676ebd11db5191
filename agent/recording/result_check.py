"""Checks the signature of every result in a recording."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from agent.recording.result_signing import recorded_result
from agent.recording.results_chain import FILE_METADATA
from agent.recording.scan import scan

if TYPE_CHECKING:
    from agent.config.known_keys import KnownKeys


@dataclass(slots=True)
class CheckedResults:
    """`signed`: number of results with a valid signature. `fault`: of the first one without; `faults`: their number."""

    signed: int = 0
    faults: int = 0
    fault: str = ""


def check_results(path: Path, gateway: str, keys: KnownKeys | None) -> CheckedResults:
    """Check the results of a recording whose metadata name the key of its results; others have no such signatures.

    `gateway`: of its RunStart. With `keys` the key must be one of the gateway's. Raises OSError.
    """
    found, checked = scan(path), CheckedResults()
    origin = found.metadata.get(FILE_METADATA, {})
    for result, message in zip(found.results, found.messages, strict=True):
        signed = recorded_result(result, message, gateway, origin)
        if signed is None:
            continue
        fault = signed.fault or (keys.fault(gateway, signed.public_key) if keys is not None else "")
        if fault:
            checked.fault = checked.fault or f"result {result.sequence} ({signed.topic}): {fault}"
            checked.faults += 1
        else:
            checked.signed += 1
    return checked
