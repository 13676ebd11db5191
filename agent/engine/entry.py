"""The process of an engine: reads frames, runs the pipeline, answers (agent/engine/frames.py).

This file travels in the wheel of an engine. An engine of an earlier revision gets a file of its own in this place, with
the same `main`.
"""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

from agent.engine import frames

LONGEST_FAULT = 1000  # characters; a hostile configuration has a hundred thousand faults


class Engine:
    """Answers each frame but the first by the pipeline of this engine."""

    def __init__(self) -> None:
        from agent.core.pipeline import Pipeline
        from agent.recording import messages

        self._restore, self._messages = Pipeline.restore, messages
        self._pipeline: Any = None

    def begin(self, schema: bytes, data: bytes) -> list[bytes]:
        """Make the pipeline anew from the RunStart of a file, and give it this event."""
        _, start = self._messages.decode(schema.decode(), data)
        self._pipeline = self._restore(start.config_json, start.snapshot)  # type: ignore[union-attr] # it is a RunStart
        return self.step(schema, data)

    def step(self, schema: bytes, data: bytes) -> list[bytes]:
        """The results of the next event."""
        number, event = self._messages.decode(schema.decode(), data)
        answer = [b"results", b"%d" % number]
        for result in self._messages.recorded_ones(self._begun().step(event)):
            name = self._messages.schema_of(self._messages.topic_of(result))
            answer += [name.encode(), self._messages.encode(number, result)]
        return answer

    def snapshot(self) -> list[bytes]:
        """The state of the pipeline."""
        return [b"snapshot", self._begun().snapshot()]

    def memories(self) -> list[bytes]:
        """What a later run of a gateway would begin with."""
        answer = [b"memories"]
        for memory in self._begun().all_memories():
            answer += [memory.sensor.encode(), memory.identity.encode(), b"%d" % memory.sequence, memory.state]
        return answer

    def _begun(self) -> Any:
        if self._pipeline is None:
            raise ValueError("no file was begun")
        return self._pipeline


def answer_to(call: Callable[..., list[bytes]], arguments: list[bytes]) -> list[bytes]:
    """The answer of one call, or the fault that it ended with."""
    try:
        return call(*arguments)
    except Exception as error:  # a damaged or forged recording may raise any exception
        return [b"fault", f"{type(error).__name__}: {error}"[:LONGEST_FAULT].encode(errors="replace")]


def main(make: Callable[[], Engine] = Engine) -> None:
    """Serve the frames on standard input until it ends. `make` makes the engine, where its modules have other names."""
    # What the engine itself prints goes to standard error, and never between the frames.
    source, target = os.fdopen(0, "rb", buffering=0), os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)
    about = json.loads(Path(__file__).with_name("engine.json").read_text())
    engine: Engine | None = None
    while (parts := frames.read(source)) is not None:
        name, *arguments = parts
        if name == b"engine":
            answer = [b"engine", frames.VERSION, about["id"].encode()]
        else:
            engine = engine or make()
            answer = answer_to(getattr(engine, name.decode()), arguments)
        target.write(frames.packed(answer))
        target.flush()
        if name == b"engine" and arguments[0] != frames.VERSION:
            return
