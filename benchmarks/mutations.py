"""Structured mutations of signed recordings: does the audit pass one, with the key and a head, or without them?

    python -m benchmarks.mutations --runs 1000 [--seconds 240] [--json -]

A forger without the gateway's key changes messages or files of a directory. Every CRC, index and summary is right
again. Each mutated directory is audited twice: with the key and a head that was kept elsewhere, and with neither;
before the second audit the forger also takes the head, the store and all signatures away, and makes the SHA-256 of the
file before right in each file.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import random
import shutil
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

from agent.cli.given import read_head
from agent.config.known_keys import KnownKeys
from agent.recording.head import HEAD_NAME
from agent.recording.records import FileRecordError
from agent.recording.result_signing import PUBLIC_KEY
from agent.recording.results_chain import FILE_METADATA, PREVIOUS_RESULTS
from agent.recording.signing import SIGNATURE_METADATA
from tests.attacks.chain_site import KEY, audited, known, record
from tests.replay.forgery import Message, Unpacked

SEED = 14
OTHER = Ed25519PrivateKey.from_private_bytes(bytes(range(1, 33)))


@dataclass(frozen=True)
class Sources:
    """Directories from which a forger takes parts: the true one, another gateway, epoch and key, all else the same."""

    true: Path
    gateway: Path
    epoch: Path
    key: Path

    @staticmethod
    def make(directory: Path) -> Sources:
        """Record them."""
        record(directory / "true")
        record(directory / "gateway", gateway="other")
        record(directory / "epoch", seed=2)
        record(directory / "key", key=OTHER)
        return Sources(*(directory / name for name in ("true", "gateway", "epoch", "key")))


Mutate = Callable[[Path, Sources, random.Random], None]


def files_of(directory: Path) -> list[Path]:
    return sorted(directory.glob("*.mcap"))


def message_mutation(change: Callable[[list[Message], list[Message], random.Random], None], source: str) -> Mutate:
    """A mutation of the messages of one file; `change` gets them, and those of the same file in a source."""

    def mutate(data: Path, sources: Sources, draw: random.Random) -> None:
        path = draw.choice(files_of(data))
        found = Unpacked.of(path)
        donor = getattr(sources, source) / path.name
        change(found.messages, Unpacked.of(donor).messages if donor.exists() else found.messages, draw)
        found.write(path)

    return mutate


def drop(messages: list[Message], _: list[Message], draw: random.Random) -> None:
    at = draw.randrange(len(messages))
    del messages[at : at + draw.choice((1, 1, 3))]


def double(messages: list[Message], _: list[Message], draw: random.Random) -> None:
    at = draw.randrange(len(messages))
    messages.insert(draw.choice((at, draw.randrange(len(messages) + 1))), messages[at])


def swap(messages: list[Message], _: list[Message], draw: random.Random) -> None:
    a, b = draw.sample(range(len(messages)), 2)
    messages[a], messages[b] = messages[b], messages[a]


def splice(messages: list[Message], others: list[Message], draw: random.Random) -> None:
    """Some messages are those of the source at the same places; or all from a place on."""
    at = draw.randrange(min(len(messages), len(others)))
    to = draw.choice((at + 1, at + 4, len(messages)))
    messages[at:to] = others[at:to]


def wrong_schema(messages: list[Message], _: list[Message], draw: random.Random) -> None:
    at = draw.randrange(len(messages))
    topic, schema, *rest = messages[at]
    other = draw.choice([m[1] for m in messages if m[1] != schema] or ["fieldcal.v1.Drift"])
    messages[at] = (topic, other, *rest)  # type: ignore[assignment]


def cut(messages: list[Message], _: list[Message], draw: random.Random) -> None:
    del messages[draw.randrange(1, len(messages)) :]


def drop_file(data: Path, _: Sources, draw: random.Random) -> None:
    draw.choice(files_of(data)).unlink()


def drop_last_files(data: Path, _: Sources, draw: random.Random) -> None:
    files = files_of(data)
    for path in files[draw.randrange(1, len(files)) :]:
        path.unlink()


def double_file(data: Path, _: Sources, draw: random.Random) -> None:
    a, b = draw.sample(files_of(data), 2)
    shutil.copyfile(a, b)


def swap_files(data: Path, _: Sources, draw: random.Random) -> None:
    a, b = draw.sample(files_of(data), 2)
    contents = a.read_bytes(), b.read_bytes()
    b.write_bytes(contents[0])
    a.write_bytes(contents[1])


def file_from(source: str) -> Mutate:
    def mutate(data: Path, sources: Sources, draw: random.Random) -> None:
        shutil.copyfile(draw.choice(files_of(getattr(sources, source))), draw.choice(files_of(data)))

    return mutate


def directory_from(source: str) -> Mutate:
    def mutate(data: Path, sources: Sources, _: random.Random) -> None:
        shutil.rmtree(data)
        shutil.copytree(getattr(sources, source), data)

    return mutate


def truncate(data: Path, _: Sources, draw: random.Random) -> None:
    path = draw.choice(files_of(data))
    size = draw.choice(Unpacked.of(path).boundaries[:-1]) + draw.choice((0, 0, 1, -1))
    path.write_bytes(path.read_bytes()[:size])


def revoked_key(_: Path, __: Sources, ___: random.Random) -> None:
    """Nothing is changed; the key is in the list of revoked ones."""


MUTATIONS: dict[str, Mutate] = {
    "message dropped": message_mutation(drop, "true"),
    "message doubled": message_mutation(double, "true"),
    "messages swapped": message_mutation(swap, "true"),
    "messages of another gateway": message_mutation(splice, "gateway"),
    "messages of another epoch": message_mutation(splice, "epoch"),
    "messages signed by another key": message_mutation(splice, "key"),
    "message of a wrong schema": message_mutation(wrong_schema, "true"),
    "messages cut from the end": message_mutation(cut, "true"),
    "file dropped": drop_file,
    "last files dropped": drop_last_files,
    "file doubled": double_file,
    "files swapped": swap_files,
    "file of another gateway": file_from("gateway"),
    "file of another epoch": file_from("epoch"),
    "file signed by another key": file_from("key"),
    "directory of another epoch": directory_from("epoch"),
    "directory signed by another key": directory_from("key"),
    "truncated at a record": truncate,
    "key revoked": revoked_key,
}


def bare(data: Path) -> None:
    """What a forger does where the auditor has no key: no store, head or signature, and a chain that fits again."""
    for path in [*data.glob("state.*"), data / HEAD_NAME]:
        path.unlink(missing_ok=True)
    before = ""
    for path in files_of(data):
        try:
            found = Unpacked.of(path)
        except FileRecordError:  # a truncated file stays as it is
            continue
        found.metadata = [(name, dict(values)) for name, values in found.metadata if name != SIGNATURE_METADATA]
        for _, values in (entry for entry in found.metadata if entry[0] == FILE_METADATA):
            for member in (PUBLIC_KEY, PREVIOUS_RESULTS):
                values.pop(member, None)
            values["previous_sha256"] = before
        found.write(path)
        before = hashlib.sha256(path.read_bytes()).hexdigest()


def run(runs: int, seconds: float) -> tuple[Counter[str], Counter[str], Counter[str]]:
    """(runs, passed with key and head, passed without) by kind."""
    tried: Counter[str] = Counter()
    with_key: Counter[str] = Counter()
    without: Counter[str] = Counter()
    draw, end = random.Random(SEED), time.monotonic() + seconds
    with tempfile.TemporaryDirectory() as directory:
        sources = Sources.make(Path(directory))
        head = read_head(sources.true / HEAD_NAME)
        revoked = KnownKeys(anywhere=known(KEY).anywhere, revoked={known(KEY).anywhere[0]: "stolen"})
        while tried.total() < runs and time.monotonic() < end:
            kind = list(MUTATIONS)[tried.total() % len(MUTATIONS)]
            data = Path(directory) / "data"
            shutil.copytree(sources.true, data)
            before = {path.name: path.read_bytes() for path in files_of(data)}
            MUTATIONS[kind](data, sources, draw)
            if kind == "key revoked" or before != {path.name: path.read_bytes() for path in files_of(data)}:
                tried[kind] += 1
                keys = revoked if kind == "key revoked" else known(KEY)
                with_key[kind] += audited(data, keys=keys, heads=[head], strict=False)[0] == 0
                bare(data)
                without[kind] += bool(files_of(data)) and audited(data, keys=None, strict=False)[0] == 0
            shutil.rmtree(data)
    return tried, with_key, without


def main(arguments: Sequence[str]) -> int:
    """Print the table; the status is 3 where a mutation passes with key and head."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=1000)
    parser.add_argument("--seconds", type=float, default=float("inf"), help="stop after so many seconds")
    parser.add_argument("--json", choices=["-"])
    given = parser.parse_args(arguments)
    tried, with_key, without = run(given.runs, given.seconds)
    if given.json:
        rows = {kind: {"runs": tried[kind], "with": with_key[kind], "without": without[kind]} for kind in MUTATIONS}
        print(json.dumps(rows))
    else:
        print("| kind | runs | passed with key and head | passed without |\n| --- | --- | --- | --- |")
        for kind in MUTATIONS:
            print(f"| {kind} | {tried[kind]} | {with_key[kind]} | {without[kind]} |")
        print(f"| all | {tried.total()} | {with_key.total()} | {without.total()} |")
    return 3 if with_key.total() else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
