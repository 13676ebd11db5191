"""`fieldcal witness`: keeps the signed heads of recordings on another machine than the gateway's."""

from __future__ import annotations

import errno
import math
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import click
import zenoh
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
from cryptography.hazmat.primitives.serialization import Encoding, NoEncryption, PrivateFormat, PublicFormat
from zenoh.ext import AdvancedSubscriber, HistoryConfig, RecoveryConfig, declare_advanced_subscriber

from agent.cli.tls_options import TlsOptions, tls_options
from agent.config.key_file import KeyFileError
from agent.config.known_keys import KnownKeys, WatchedKeys
from agent.delivery.ending import StopRequest
from agent.delivery.hearing import Hearing
from agent.delivery.keys import PREFIX, parse_key
from agent.delivery.session import EndpointError, closed_in_time, session_config
from agent.keys.files import write_new
from agent.recording.signing import Signer, load_public_key
from agent.recording.witness import KEY_NAME, PUBLIC_NAME, ChainWitness, WitnessError
from agent.terminal.text import say

INBOX = 1000  # heads that may wait; the oldest are dropped, and each gateway publishes a new one within a minute
CONNECT_MS = 10_000
CLOSE_S = 2.0  # s to wait at the end until a head that has arrived is kept
LOOK_S = 1.0  # s between two looks whether the router still hears
TOLD_S = 10.0  # s between two lines about heads that are not kept, since strangers may publish them without end
FULL = (errno.ENOSPC, errno.EDQUOT)
HEADS = f"{PREFIX}/*/*/head"


@click.command()
@click.option("--dir", "directory", type=click.Path(file_okay=False, path_type=Path), default=Path("witness"),
              show_default=True, help="Where the heads are kept, and the witness's own key.")  # fmt: skip
@click.option("--connect", "endpoints", multiple=True, default=["tcp/127.0.0.1:7447"], show_default=True,
              metavar="ENDPOINT", help="Router; may be given several times.")  # fmt: skip
@click.option("--key", default=HEADS, show_default=True, metavar="KEYEXPR", help="Which gateways.")
@click.option("--public-key", "public_keys", multiple=True, type=click.Path(path_type=Path), metavar="K",
              help="Key of a gateway (PEM); may be given several times. Then only these and those of --keys count; "
              "without both, the first key that is seen for a gateway.")  # fmt: skip
@click.option("--keys", "known_keys", type=click.Path(path_type=Path), metavar="F",
              help="List of known keys (`fieldcal keys`): of each gateway only its own keys count, revoked ones never. "
              "It is read again when it changes.")  # fmt: skip
@tls_options
def witness(
    directory: Path,
    endpoints: tuple[str, ...],
    key: str,
    public_keys: tuple[Path, ...],
    known_keys: Path | None,
    tls: TlsOptions,
) -> int:
    """Keep the heads that gateways publish, with the time of this machine, signed with a key of this machine.

    `fieldcal audit --data-dir D --witness DIR` then notices recordings that are missing at the end. Run it on a machine
    that those who can write on the gateway cannot write on. While the disk is full it says so, and keeps nothing.
    Without --public-key and --keys it keeps heads of 100 gateways at most.

    Exit status: 1 no router or a fault of the disk, 2 bad input.
    """
    stop = StopRequest.by_signals()
    files = tls.files(endpoints)
    try:
        kept = ChainWitness(directory, _signer(directory), _keys(public_keys, known_keys), time.time_ns)
        config = session_config("client", connect=endpoints, tls=files)
    except (KeyFileError, EndpointError, WitnessError) as error:
        say(f"fieldcal witness: {error}", err=True)
        return 2
    config.insert_json5("connect/timeout_ms", str(CONNECT_MS))
    try:
        session = zenoh.open(config)
    except zenoh.ZError:
        say(f"fieldcal witness: no Zenoh router answers at {', '.join(endpoints)}", err=True)
        return 1
    return _follow(session, key, kept, stop)


def _keys(public_keys: Sequence[Path], known_keys: Path | None) -> Callable[[], KnownKeys] | None:
    """Gives the keys of both options as they are now; None where neither is given. Raises KeyFileError."""
    if not public_keys and known_keys is None:
        return None
    anywhere = tuple(load_public_key(path).public_bytes_raw() for path in public_keys)
    if known_keys is None:
        return lambda: KnownKeys(anywhere=anywhere)
    watched = WatchedKeys(known_keys)
    watched.now()
    return lambda: replace(watched.now(), anywhere=anywhere)


def _follow(session: zenoh.Session, key: str, kept: ChainWitness, stop: StopRequest) -> int:
    faults: list[OSError] = []

    def take_all() -> None:
        try:
            _keep_heads(subscriber, kept)
        except OSError as error:
            faults.append(error)
            stop.set()

    thread = threading.Thread(target=take_all, name="witness", daemon=True)
    # Closing the session ends the subscription. The subscriber's `undeclare` would hold the lock of the interpreter
    # while it waits for Zenoh.
    with closed_in_time(session):
        subscriber = declare_advanced_subscriber(
            session,
            key,
            zenoh.handlers.RingChannel(INBOX),
            history=HistoryConfig(detect_late_publishers=True),
            recovery=RecoveryConfig(heartbeat=True),  # type: ignore[call-arg]
        )
        thread.start()
        say(f"keeping the heads of {key}")
        heard = _until_lost(session, stop)
    thread.join(CLOSE_S)
    if not heard:
        say("fieldcal witness: the router does not answer any more; start this command again", err=True)
    for fault in faults:
        say(f"fieldcal witness: {fault}", err=True)
    return 1 if faults or not heard else 0


def _keep_heads(subscriber: AdvancedSubscriber[Any], kept: ChainWitness) -> None:
    """Take each head that comes, and say which are not kept. Raises OSError where a disk fails that is not full."""
    refused, silent_until_s = 0, -math.inf
    for sample in subscriber:
        address = parse_key(str(sample.key_expr))
        try:
            taken, said = kept.take(address.source if address else "", sample.payload.to_bytes())
        except OSError as error:
            if error.errno not in FULL:
                raise
            taken, said = False, f"{address.source if address else ''}: not kept, the disk is full"
        if said and not taken:
            refused += 1
            said = f"{said} ({refused} not kept so far)" if time.monotonic() > silent_until_s else ""
            silent_until_s = time.monotonic() + TOLD_S if said else silent_until_s
        if said:
            say(said)


def _until_lost(session: zenoh.Session, stop: StopRequest) -> bool:
    """Wait until `stop` is set, or the router does not answer any more; returns whether it does."""
    hearing = Hearing()
    hearing.begin(session)
    while not stop.wait(LOOK_S):
        if hearing.lost():
            return False
    return True


def _signer(directory: Path) -> Signer:
    """The witness's own key, made at the first start. Raises KeyFileError."""
    path = directory / KEY_NAME
    if not path.exists():
        key = Ed25519PrivateKey.generate()
        private = key.private_bytes(Encoding.PEM, PrivateFormat.PKCS8, NoEncryption())
        public = key.public_key().public_bytes(Encoding.PEM, PublicFormat.SubjectPublicKeyInfo)
        write_new(directory, {KEY_NAME: private, PUBLIC_NAME: public})
    return Signer.load(path)
