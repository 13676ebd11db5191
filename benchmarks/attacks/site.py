"""A signed data directory of the real pipeline to attack, and what a forger can take elsewhere.

The gateway ran twice. The first run was killed, so its last recording was closed by the next start. The second run
deleted the two oldest recordings by its limit; seven are left. A head was kept at each moment.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

from agent.engine import identity
from agent.engine.keeping import keep_engine
from agent.engine.wheel import ENGINES
from agent.recording.files import recordings
from agent.recording.retention import KeepFiles
from tests.attacks.chain_site import KEY
from tests.attacks.store_site import GATEWAY, Run, rests

OTHER = Ed25519PrivateKey.from_private_bytes(bytes(range(1, 33)))
POSES = 6  # that the sensor rests in, in each run
FILES = (4, 5)  # of the two runs
BEGIN_S = 96.0  # of the second run, by the clock of the first
SHARE = 1.92  # of the bytes of the first run: with this limit two of nine recordings are deleted


@dataclass(frozen=True)
class Site:
    """`true`: the directory. `earlier`: a copy of it before the second run. `fork`: the second run again, from there,
    with other data: the same gateway, key, epoch and numbers. `epoch`, `gateway`, `key`: another directory of the same
    gateway and key, of another gateway with the same key, of the same gateway with another key. `heads`: of `true`.
    """

    directory: Path
    heads: list[bytes]

    def __getattr__(self, name: str) -> Path:
        return self.directory / name

    @staticmethod
    def make(directory: Path) -> Site:
        """Record all of it."""
        heads: list[bytes] = []
        true, earlier, fork = (directory / name for name in ("true", "earlier", "fork"))
        first_run(true, 1, heads)
        shutil.copytree(true, earlier)
        shutil.copytree(true, fork)
        keep = KeepFiles(bytes=int(SHARE * sum(path.stat().st_size for _, path in recordings(true))))
        second_run(true, 2, heads, keep=keep)
        second_run(fork, 5, [])
        for name, gateway, key in (("epoch", GATEWAY, KEY), ("gateway", "site/other", KEY), ("key", GATEWAY, OTHER)):
            first_run(directory / name, 3, [], gateway=gateway, key=key)
            second_run(directory / name, 4, [], gateway=gateway, key=key)
        keep_engine(true)
        for name in ("earlier", "fork", "epoch", "gateway", "key"):
            shutil.copytree(true / ENGINES, directory / name / ENGINES)
        return Site(directory, heads)


def first_run(directory: Path, seed: int, heads: list[bytes], **options: Any) -> None:
    """Four recordings; the run is killed in the last one."""
    run = Run(directory, 1, engine=identity.name(), tell_head=heads.append, **options)
    record(run, seed, 0.0, FILES[0])
    run.kill()


def second_run(directory: Path, seed: int, heads: list[bytes], **options: Any) -> None:
    """Closes the last recording of the first run, and makes five more."""
    run = Run(directory, 2, engine=identity.name(), tell_head=heads.append, **options)
    run.store.mark_published(run.store.last_sequence())  # what is not published is never deleted
    record(run, seed, BEGIN_S, FILES[1])
    run.stop()


def record(run: Run, seed: int, begin_s: float, files: int) -> None:
    """Feed a run with rests, in so many recordings."""
    events = list(rests(seed, begin_s=begin_s, count=POSES))
    each = -(-len(events) // files)
    for first in range(0, len(events), each):
        if first:
            run.rotate()
        run.feed(events[first : first + each])


Attack = Callable[[Path, Site, int], object]  # on a copy of `true`, with a place


def files(data: Path) -> list[Path]:
    """The recordings of a directory."""
    return [path for _, path in recordings(data)]


def at(data: Path, place: int) -> Path:
    """The recording for a place."""
    found = files(data)
    return found[place % len(found)]
