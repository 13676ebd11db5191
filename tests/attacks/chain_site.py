"""Data directories of gateways for attacks on their chains: recorded by a small pipeline, with a store, signed."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import msgspec
from click.testing import CliRunner
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
from cryptography.hazmat.primitives.serialization import Encoding, PublicFormat

from agent.audit.engines import Engines
from agent.cli.audit import run_audit
from agent.cli.given import recordings_of
from agent.config.known_keys import KnownKeys
from agent.core.events import Event
from agent.delivery.store import Store
from agent.recording.end_check import GivenHead
from agent.recording.files import recordings
from agent.recording.retention import FOR_EVER, KeepFiles
from agent.recording.signing import Signer
from agent.recording.writer import Recorder
from tests.replay.stand_in import CONFIG, StandIn, happenings, run_start

KEY = Ed25519PrivateKey.from_private_bytes(bytes(range(32)))
ROTATE_EACH = 8  # events


def record(
    directory: Path,
    *,
    gateway: str = "gateway",
    seed: int = 1,
    blocks: int = 14,
    key: Ed25519PrivateKey = KEY,
    heads: list[bytes] | None = None,
    keep: KeepFiles = FOR_EVER,
) -> list[Path]:
    """Record one run of `gateway` into `directory`, signed with `key`; returns its recordings.

    All heads that the gateway publishes are added to `heads`. `keep`: the limits of the recordings.
    """
    directory.mkdir(exist_ok=True)
    store = Store(directory, 0)
    told = [] if heads is None else heads
    names = (["acc", "ref"], ["bridge-1"])
    recorder = Recorder(
        directory, *names, ledger=store, signer=Signer(key), tell_head=told.append, epoch=store.epoch, keep=keep
    )
    recorder.close_torn()
    pipeline = StandIn(CONFIG)
    at = 0

    def take(event: Event) -> None:
        nonlocal at
        assert recorder.record(at, event, pipeline.step(event)), recorder.fault
        at += 1

    for number, event in enumerate(happenings(blocks, seed)):
        if number % ROTATE_EACH == 0:
            start = run_start(pipeline, at, recorder.next_file_sequence, event.t_monotonic_ns)
            take(msgspec.structs.replace(start, gateway=gateway, run_id=f"run-{seed}"))
            while recorder.pruning is not None:
                take(recorder.pruning)
        take(event)
    recorder.close()
    store.close()
    return [path for _, path in recordings(directory)]


def audited(directory: Path, **options: Any) -> tuple[int, str]:
    """(exit status, text) of `fieldcal audit DIRECTORY --public-key K --strict`; `options` replace these options."""
    return _run(directory, as_json=False, **options)


def audited_json(directory: Path, **options: Any) -> dict[str, Any]:
    """What the same audit prints with `--json -`."""
    return json.loads(_run(directory, as_json=True, **options)[1])  # type: ignore[no-any-return]


def _run(directory: Path, *, heads: Sequence[GivenHead] = (), **options: Any) -> tuple[int, str]:
    runner = CliRunner()
    with runner.isolation() as (out, _, _):
        given = recordings_of([directory])
        given.heads.extend(heads)
        stated: dict[str, Any] = {"strict": True, "keys": known(KEY)}
        status = run_audit(given, Engines(StandIn.restore), **stated | options)
        return status, out.getvalue().decode()


def known(*keys: Ed25519PrivateKey) -> KnownKeys:
    """A list by which these keys count for every gateway."""
    return KnownKeys(anywhere=tuple(key.public_key().public_bytes_raw() for key in keys))


def public_pem(key: Ed25519PrivateKey = KEY) -> bytes:
    """The public key as a PEM file holds it."""
    return key.public_key().public_bytes(Encoding.PEM, PublicFormat.SubjectPublicKeyInfo)
