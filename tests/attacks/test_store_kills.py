"""After a kill the states of the estimation are those of the recording, in every bit, and no forged ones."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path
from random import Random

import msgspec
import numpy as np
import pytest

from agent.core.events import CalibrationUpdate, Event, RunStart
from agent.core.memory import Memory
from agent.core.snapshot import pack, unpack
from agent.delivery.history import FILE_NAME
from agent.recording.continuation import continues, states_left
from agent.recording.files import final_name, recordings
from agent.recording.head import HEAD_NAME
from agent.recording.messages import decode, encode
from agent.recording.repair import close_file
from agent.recording.result_signing import PUBLIC_KEY
from hw.block import SampleBlock
from tests.attacks.store_site import Run, forge_memory, put_back, rests, rows, states
from tests.replay.forgery import Unpacked

EVENTS = list(rests(1))
ROTATE_AT = 30


def lived(directory: Path, events: list[Event], *, committed: bool = True) -> dict[tuple[str, str], bytes]:
    """A run that is killed after these events; the last of its results is recorded, but not in the store, unless
    `committed`. Returns its states after the last event: nothing interrupts this pipeline."""
    run = Run(directory).feed(events[:ROTATE_AT])
    if len(events) > ROTATE_AT:
        run.rotate()
    *earlier, last = events[ROTATE_AT:] or [events[-1]]
    if len(events) > ROTATE_AT:
        run.feed(earlier)
        if not committed:
            run.store.commit = lambda *_: None  # type: ignore[assignment, method-assign]
        run.feed([last])
    run.kill()
    return states(run.pipeline.all_memories())


@pytest.mark.parametrize("seed", range(4))
def test_nothing_is_lost_by_a_kill(tmp_path: Path, seed: int) -> None:
    """Also between the recording and the store, and where the store and the mark `clean` are forged or older."""
    draw, data = Random(seed), tmp_path / "data"
    right = lived(data, EVENTS[: draw.randrange(10, len(EVENTS))], committed=bool(draw.randrange(2)))
    for kind in ("as it is", "forged", "as if it had ended", "no store"):
        copy = Path(shutil.copytree(data, tmp_path / kind))
        if kind == "no store":
            for path in copy.glob(f"{FILE_NAME}*"):
                path.unlink()
        elif kind != "as it is":
            forge_memory(copy)
            if kind == "as if it had ended":
                clean = Run(tmp_path / "clean")
                clean.stop()
                put_back(copy, tmp_path / "clean" / FILE_NAME, "marks")
                shutil.rmtree(tmp_path / "clean")
        again = Run(copy, 2)
        assert states(again.begun_with) == right, kind
        assert bool(again.faults) == (kind in ("forged", "as if it had ended") and bool(right)), kind
        again.kill()


def test_a_gateway_that_is_killed_again_and_again_begins_each_run_with_what_the_one_before_left(tmp_path: Path) -> None:
    known: list[Memory] = []
    for number in range(1, 8):
        run = Run(tmp_path / "data", number)
        assert continues(known, run.begun_with, ["s"]) == ""
        run.feed(list(rests(number, "AB"[number % 2]))[: 5 * number])
        run.stop() if number == 3 else run.kill()
        known = states_left(known, run.pipeline.all_memories(), ["s"])
    assert {identity.split()[1] for _, identity in states(known)} == {"A", "B"}


def forge(path: Path, what: str) -> None:
    """Write another open recording in the place of this one; every CRC in it is right."""
    close_file(path)
    found = Unpacked.of(final_path(path))
    changed = []
    for topic, schema, *times, data in found.messages:
        number, item = decode(schema, data)
        if what == "data" and isinstance(item, SampleBlock):
            data = encode(number, replace(item, indications=np.asarray(1.05 * item.indications)))
        elif what == "results" and isinstance(item, CalibrationUpdate):
            signature = data[-67:]
            sensitivity = (1.05 * np.array(item.sensitivity)).tolist()
            data = encode(number, msgspec.structs.replace(item, sensitivity=sensitivity)) + signature
        elif what == "snapshot" and isinstance(item, RunStart):
            state = unpack(item.snapshot)
            state["channels"]["s"]["estimation"]["state"]["now"]["x"][:9] *= 1.05
            data = encode(number, msgspec.structs.replace(item, snapshot=pack(state)))
        changed.append((topic, schema, *times, data))
    assert changed != found.messages or what == "unsigned"
    found.messages = changed  # type: ignore[assignment]
    if what == "unsigned":
        for _, metadata in found.metadata:
            metadata.pop(PUBLIC_KEY, None)
    final_path(path).unlink()
    found.write(path)


def final_path(path: Path) -> Path:
    return path.with_name(final_name(path))


@pytest.mark.parametrize("head", ["head", "no head"])
@pytest.mark.parametrize("what", ["nothing", "data", "results", "snapshot", "unsigned"])
def test_what_somebody_writes_into_the_open_recording_is_refused(tmp_path: Path, what: str, head: str) -> None:
    """Then the run begins with what the store has: the states after the last result.

    No result follows the changed snapshot that could contradict it.
    """
    data = tmp_path / "data"
    right = lived(data, EVENTS[: ROTATE_AT + 1 if what == "snapshot" else 45])
    stored = {(s, i): state for s, i, state in rows(data, "SELECT sensor, identity, state FROM memory")}
    _, (_, path) = recordings(data)
    if what != "nothing":
        forge(path, what)
    if head == "no head":
        (data / HEAD_NAME).unlink()
    again = Run(data, 2)
    assert states(again.begun_with) == (right if what == "nothing" else stored)
    assert bool(again.faults) == (what != "nothing")
    again.kill()
