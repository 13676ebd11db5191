"""kill -9 of a gateway with a key: its states go on bit for bit, and forged ones are refused each time."""

from __future__ import annotations

import shutil
import tempfile
from functools import partial
from pathlib import Path
from random import Random

from agent.audit.recalling import memories_of
from agent.config import recorded_config
from agent.core.memory import Memory
from agent.core.pipeline import Pipeline
from agent.delivery.gateway_key import GatewayKey
from agent.delivery.history import FILE_NAME
from agent.delivery.store import Store
from agent.recording.continuation import continues, states_left
from agent.recording.files import recordings
from agent.recording.reading import RecordingReader, first_event
from agent.recording.signing import Signer
from tests.attacks.store_site import forge_memory, states
from tests.faults.invariants import Ledger
from tests.faults.outcome import Outcome
from tests.faults.remembering import keep_keys
from tests.faults.rig import SOURCE, rig, stop

SEED = 20261126


def killed(directory: Path, kills: int) -> Outcome:
    """Kill the agent so many times. After each: restored states are those of a replay; with a changed S, and with the
    mark `clean` set as if the run had ended, the same ones come back and the change is told."""
    moments, forged, compared = Random(SEED), 0, 0
    directory.mkdir(exist_ok=True)
    with rig(directory / "rig", SEED) as r:
        keep_keys(r, directory)
        key = GatewayKey(SOURCE, Signer.load(directory / "recording.key"))
        ledger = Ledger(r.data_dir)
        outcome = Outcome("kill -9 with a key: states", f"{kills} kills, seed {SEED}", ledger.findings)
        for _ in range(kills):
            with r.agent() as agent:
                r.run_to_a_moment(agent, moments)
                agent.kill()
                agent.wait()
            if not (r.data_dir / FILE_NAME).exists() or not recordings(r.data_dir):
                continue
            right = replayed(r.data_dir)
            found, told = restored(r.data_dir, key, forge=False)
            outcome.require(states(found) == states(right), "the states after a kill are not those of a replay")
            outcome.require(not told, f"a store that nobody changed is refused: {told}")
            compared += bool(right)
            found, told = restored(r.data_dir, key, forge=True)
            outcome.require(states(found) == states(right), "a changed state changed what a run begins with")
            refused = any("refused" in fault for fault in told)
            outcome.require(refused or not right, "a changed state was not told")
            forged += refused
            ledger.inspect()
        with r.agent() as agent:
            r.run(agent, until=lambda: r.sensor.speaks)
            outcome.require(stop(agent) == 0, "the last run did not end well")
        ledger.inspect()
        for fault in broken_off(r.data_dir):
            outcome.require(False, fault)
        outcome.require("Traceback" not in r.output, "a traceback was shown")
        outcome.also = (
            f"{compared} times there were states, the same as by a replay in every bit; {forged} times S x 1.05 was"
            f" refused; {ledger.findings.restored} runs began with the calibration in force before"
        )
    return outcome


def replayed(data_dir: Path) -> list[Memory]:
    """The states where the newest recording with a first event ends."""
    for _, path in reversed(recordings(data_dir)):
        pipeline = None
        for step in RecordingReader(path).steps():
            if pipeline is None:
                pipeline = Pipeline.restore(step.event.config_json, step.event.snapshot)  # type: ignore[union-attr]
            pipeline.step(step.event)
        if pipeline is not None:
            return pipeline.all_memories()
    return []


def restored(data_dir: Path, key: GatewayKey, *, forge: bool) -> tuple[list[Memory], list[str]]:
    """The states with which a run would begin on a copy of the directory, and what it would tell."""
    with tempfile.TemporaryDirectory() as name:
        copy = Path(name) / "data"
        shutil.copytree(data_dir, copy, ignore=shutil.ignore_patterns("*.sock", "*-shm"))
        if forge:
            forge_memory(copy)
        store = Store(copy, recall=partial(memories_of, restore=Pipeline.restore), key=key)
        store.close()
        return store.states, store.faults


def broken_off(data_dir: Path) -> list[str]:
    """Where a recording does not begin with the states that those before it left."""
    known: list[Memory] = []
    faults = []
    for _, path in recordings(data_dir):
        start = first_event(path)
        if start is None:
            continue
        kept = Pipeline.restore(start.config_json, start.snapshot).all_memories()
        sensors = [channel.sensor for channel in recorded_config(start.config_json).channels]
        if fault := continues(known, kept, sensors):
            faults.append(f"{path.name}: {fault}")
        end = memories_of(path, None, restore=Pipeline.restore)
        known = states_left(known, end or [], sensors)
    return faults
