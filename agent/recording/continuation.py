"""Does a run begin with the states of the estimation that the recordings before it left?"""

from __future__ import annotations

from collections.abc import Collection, Iterable

from agent.core.memory import Memory

# After a crash, results may have been published with sequence numbers that no commit has kept. The next run therefore
# skips so many numbers: more than a week of one result a second that the disk refused.
UNKEPT_MAX = 1_000_000


def continues(before: Iterable[Memory], kept: Iterable[Memory], sensors: Collection[str]) -> str:
    """Why a run does not begin with the states that were left for it; "" where it does.

    `before`: what the recordings before it left (`states_left`). `kept`: `Pipeline.all_memories` of the snapshot in the
    first RunStart of the run. `sensors`: those of its configuration; the states of others wait for a later run.
    """
    were = {device: state for device, state in _by_device(before).items() if device[0] in sensors}
    are = _by_device(kept)
    for device in sorted(were.keys() | are.keys()):
        if were.get(device) != are.get(device):
            return _said(device, were.get(device), are.get(device))
    return ""


def states_left(known: Iterable[Memory], end: Iterable[Memory], sensors: Collection[str]) -> list[Memory]:
    """The states that recordings left: those at the end of the newest one, and those of sensors that it does not have.

    `known`: what the recordings before it left. `end`: `Pipeline.all_memories` where it ends, by a replay. `sensors`:
    those of its configuration.
    """
    return [*(memory for memory in known if memory.sensor not in sensors), *end]


def _by_device(memories: Iterable[Memory]) -> dict[tuple[str, str], bytes]:
    return {(memory.sensor, memory.identity): memory.state for memory in memories}


def _said(device: tuple[str, str], was: bytes | None, now: bytes | None) -> str:
    of = f"of {device[0]!r:.70} ({device[1]!r:.130})"
    if now is None:
        return f"the state {of} is missing, which the recordings before it left"
    if was is None:
        return f"it begins with a state {of} that the recordings before it did not leave"
    return f"the state {of} is not the one that the recordings before it left"
