"""Flips bits of a state file and of a recording, one at a time."""

from __future__ import annotations

import random
import shutil
import time
from collections import Counter
from collections.abc import Iterable
from functools import partial
from pathlib import Path

import numpy as np

from agent.delivery.history import FILE_NAME, History, StoredResult, StoreError
from agent.delivery.store import Store
from agent.recording.integrity import check_integrity
from agent.recording.messages import encode
from agent.recording.reading import RecordingReader, open_recording
from tests.faults.invariants import Findings
from tests.faults.outcome import Outcome
from tests.faults.rig import SENSOR, rig, stop
from tests.scenarios.processes import recordings

SEED = 20261121
STARTED_S = 1.0  # s from the opening of the port to the first results
RUN_S = 8.0  # s of a run that leaves about 24 calibrations in the state file


def of_state(directory: Path, flips: int) -> Outcome:
    """After each flip the store is opened and the calibration in force is read, as the service does at its start."""
    data_dir = _recorded(directory, RUN_S)
    whole = (data_dir / FILE_NAME).read_bytes()
    with History(data_dir / FILE_NAME) as history:
        right = history.after(-1, limit=10_000_000)
        in_force = history.in_force(SENSOR)
    assert in_force is not None
    became: Counter[str] = Counter()
    findings, words = Findings(), []
    for bit in _bits(len(whole) * 8, flips, ()):
        copy = directory / "flipped"
        shutil.rmtree(copy, ignore_errors=True)
        copy.mkdir()
        (copy / FILE_NAME).write_bytes(_flipped(whole, bit))
        try:
            verdict = _start(copy, right, in_force)
        except Exception as error:
            verdict = f"crash: {error!r}"
        if verdict.startswith(("crash", "silently")):
            words.append(f"bit {bit} of {len(whole) * 8}: {verdict}")
        became[verdict.split(":")[0]] += 1
    outcome = Outcome(
        "bits of the state file", f"{_share(len(whole) * 8, flips)}, seed {SEED}", findings, bad=words[:5]
    )
    findings.wrong = became["silently wrong"]
    outcome.also = _words(became)
    return outcome


def of_recording(directory: Path, flips: int, size_bytes: int, edge_bytes: int) -> Outcome:
    """The audit must report each flip, also at both ends of the file, where magic, header and footer are.

    Events and results that can still be read must be unchanged, since a replay follows from them alone.
    """
    data_dir = _recorded(directory, RUN_S, size_bytes)
    path = recordings(data_dir)[0]
    whole = path.read_bytes()
    right = _read(path)
    edges = [*range(edge_bytes * 8), *range((len(whole) - edge_bytes) * 8, len(whole) * 8)]
    became: Counter[str] = Counter()
    words = []
    copy = directory / path.name
    for bit in _bits(len(whole) * 8, flips, edges):
        copy.write_bytes(_flipped(whole, bit))
        try:
            with open_recording(copy) as file:
                noticed = check_integrity(file, len(whole)).fault_count > 0
            read = _read(copy)
        except Exception as error:
            verdict = f"crash: {error!r}"
        else:
            verdict = "noticed" if noticed else "NOT noticed by the audit"
            if read != right[: len(read)]:
                verdict = "read as OTHER data"
        if verdict != "noticed":
            words.append(f"bit {bit} of {len(whole) * 8}: {verdict}")
        became[verdict.split(":")[0]] += 1
    outcome = Outcome(
        f"bits of a recording of {len(whole) / 1e6:.2f} MB",
        f"{_share(len(whole) * 8, flips)} and all of the {edge_bytes} first and last bytes, seed {SEED}",
        Findings(),
        bad=words[:5],
    )
    outcome.also = _words(became)
    return outcome


def _recorded(directory: Path, seconds: float, size_bytes: int = 0) -> Path:
    with rig(directory, SEED) as r, r.agent() as agent:
        began_s = time.monotonic()

        def enough() -> bool:
            files = recordings(r.data_dir)
            return time.monotonic() - began_s > seconds and sum(path.stat().st_size for path in files) >= size_bytes

        assert r.run(agent, 3600.0, until=enough), r.output
        assert stop(agent) == 0, r.output
        return r.data_dir


def _start(data_dir: Path, right: list[StoredResult], in_force: StoredResult) -> str:
    """What a start does with a state file; "silently wrong" where it uses changed values without noticing."""
    try:
        store = Store(data_dir)
    except StoreError:
        return "refused, with the reason"
    try:
        if store.set_aside is not None:
            return "set aside"
        with History(store.path) as history:
            kept, found = history.after(-1, limit=10_000_000), history.in_force(SENSOR)
            for record in kept:
                _ = record.result
        if kept == right and found == in_force and store.last_sequence() >= right[-1].sequence:
            return "no difference"
        return "silently wrong"
    except StoreError:
        return "refused, with the reason"
    finally:
        store.close()


def _read(path: Path) -> list[tuple[int, bytes, list[bytes]]]:
    return [
        (
            step.event_sequence,
            encode(step.event_sequence, step.event),
            [encode(step.event_sequence, r) for r in step.results],
        )
        for step in RecordingReader(path).steps()
    ]


def _bits(bits: int, flips: int, always: Iterable[int]) -> list[int]:
    chosen = random.Random(SEED).sample(range(bits), min(flips, bits))
    return sorted({*chosen, *always})


def _flipped(whole: bytes, bit: int) -> bytes:
    changed = np.frombuffer(whole, np.uint8).copy()
    changed[bit // 8] ^= 1 << bit % 8
    return changed.tobytes()


def _share(bits: int, flips: int) -> str:
    return f"all {bits} bits" if flips >= bits else f"{flips} of {bits} bits"


def _words(became: Counter[str]) -> str:
    return ", ".join(f"{words} {count}" for words, count in sorted(became.items()))


def at_starts(directory: Path, starts: int) -> Outcome:
    """Start the real agent on a state file with a flipped bit; the intact recordings are in the same directory."""
    bits = random.Random(SEED)
    data_dir = _recorded(directory, RUN_S)
    whole = (data_dir / FILE_NAME).read_bytes()
    with History(data_dir / FILE_NAME) as history:
        in_force = history.in_force(SENSOR)
    assert in_force is not None
    before = _calibration(in_force)
    became: Counter[str] = Counter()
    words = []
    for number in range(starts):
        bit = bits.randrange(len(whole) * 8)
        with rig(directory / str(number), SEED) as r:
            shutil.copytree(data_dir, r.data_dir)
            (r.data_dir / FILE_NAME).write_bytes(_flipped(whole, bit))
            with r.agent() as agent:
                lives = r.run(agent, until=partial(getattr, r.sensor, "speaks")) and r.run(agent, STARTED_S)
                status = stop(agent) if lives else agent.wait()
            verdict = _begun(r.data_dir, before)
            if "Traceback" in r.output or status not in (0, 1):
                verdict = f"crash, exit status {status}"
            if verdict != "restored":
                words.append(f"bit {bit}: {verdict}")
            became[verdict] += 1
    outcome = Outcome(
        "starts on a state file with a flipped bit", f"{starts} starts, seed {SEED}", Findings(), bad=words[:5]
    )
    outcome.also = _words(became)
    return outcome


def _begun(data_dir: Path, before: list[object]) -> str:
    """What the newest run began with: the calibration in force before, a different one, or none."""
    try:
        with History(data_dir / FILE_NAME) as history:
            records = history.after(-1, limit=10_000_000)
    except StoreError:
        return "refused, with the reason"
    run = [record for record in records if record.run_id == records[-1].run_id]
    first = next((record for record in run if record.what == "calibration"), None)
    if first is None:
        return "began without a calibration"
    if not any(record.what == "window" and record.sequence < first.sequence for record in run):
        return "restored" if _calibration(first) == before else "silently wrong"
    return "began without a calibration"


def _calibration(record: StoredResult) -> list[object]:
    return [record.fields[name] for name in ("sensitivity", "offset", "covariance", "identity")]
