"""Attacks on messages and metadata of one recording; every CRC, index and summary is right again."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

from mcap.opcode import Opcode

from agent.proto import fieldcal_pb2 as pb
from agent.recording.signed_text import written
from agent.recording.signing import SIGNATURE_METADATA, Signer
from benchmarks.attacks.site import OTHER, Attack, Site, at, files
from tests.replay.forgery import Unpacked, records


def seal(path: Path, found: Unpacked, place: int) -> None:
    """Write a changed file: with the signature that it had, without one, or with one of another key."""
    if place % 3 == 1:
        found.metadata = [entry for entry in found.metadata if entry[0] != SIGNATURE_METADATA]
    found.write(path)
    if place % 3 == 2:
        resign(path)


def resign(path: Path) -> None:
    """Sign a recording with another key."""
    content = path.read_bytes()
    found = Unpacked.of(path)
    metadata = dict(found.metadata).get(SIGNATURE_METADATA)
    if metadata is None:
        return
    last = [one for one in records(content) if one.opcode == Opcode.METADATA][-1]
    begin = content[: last.offset]
    values = dict(line.split(" ", 1) for line in metadata["text"].splitlines()[1:])
    values["content"] = f"{len(begin)} {hashlib.sha256(begin).hexdigest()}"
    signed = Signer(OTHER).sign(written("fieldcal recording, version 2", values))
    ours = {"text": signed.text, "public_key": signed.public_key, "signature": signed.signature}
    found.metadata = [(n, v | ours if n == SIGNATURE_METADATA else v) for n, v in found.metadata]
    found.write(path)


def edited(what: str, change: Callable[[Any, int], object]) -> Attack:
    """A message of the kind `what` is another one, in the first file that has one from the place on."""

    def attack(data: Path, _: Site, place: int) -> None:
        for path in [*files(data)[place % 7 :], *files(data)]:
            found = Unpacked.of(path)
            for index, (topic, schema, *times, content) in enumerate(found.messages):
                if schema == f"fieldcal.v1.{what}":
                    message = getattr(pb, what + "Bytes" * (what == "RawBlock")).FromString(content)
                    if change(message, place) is False:
                        continue
                    changed = message.SerializeToString(deterministic=True)
                    found.messages[index] = (topic, schema, *times, changed)
                    seal(path, found, place)
                    return
        raise AssertionError(what)

    return attack


def more_events(data: Path, _: Site, place: int) -> None:
    """An event put in: that recordings were deleted, a gap, a device that is lost, a tick."""
    path = at(data, place)
    found = Unpacked.of(path)
    index = 1 + place * (len(found.messages) - 1) // 9
    event = pb.Event(event_sequence=pb.Event.FromString(found.messages[0][5]).event_sequence + 1)
    match place % 4:
        case 0:
            event.pruned.first_file, event.pruned.last_file, event.pruned.epoch = 1, 3, "0"
        case 1:
            event.gap.device, event.gap.dropped, event.gap.unit, event.gap.reason = "s", 5, "samples", "overrun"
        case 2:
            event.device_change.device, event.device_change.state = "s", "lost"
        case _:
            event.tick.t_monotonic_ns = 1
    topic, schema, *times, _data = found.messages[0]
    found.messages.insert(index, (topic, schema, *times, event.SerializeToString(deterministic=True)))  # type: ignore[arg-type]
    seal(path, found, place)


def times(data: Path, _: Site, place: int) -> None:
    """Log time, publish time or number of a message in the container."""
    path = at(data, place)
    found = Unpacked.of(path)
    index = place * (len(found.messages) - 1) // 9
    message = list(found.messages[index])
    message[2 + place % 3] += 1  # type: ignore[operator]
    found.messages[index] = tuple(message)  # type: ignore[assignment]
    seal(path, found, place // 3)


def moved(source: str) -> Attack:
    """Messages of another directory in their places."""

    def attack(data: Path, site: Site, place: int) -> None:
        path = at(data, place)
        found, theirs = Unpacked.of(path), Unpacked.of(getattr(site, source) / path.name)
        n = min(len(found.messages), len(theirs.messages))
        begin = place * (n - 1) // 9
        end = (begin + 1, n, n)[place % 3]
        found.messages[begin:end] = theirs.messages[begin:end]
        seal(path, found, place // 3)

    return attack


def dropped(data: Path, _: Site, place: int) -> None:
    path = at(data, place)
    found = Unpacked.of(path)
    begin = place * (len(found.messages) - 1) // 9
    del found.messages[begin : begin + 1 + 3 * (place % 2)]
    seal(path, found, place // 3)


def repeated(data: Path, _: Site, place: int) -> None:
    path = at(data, place)
    found = Unpacked.of(path)
    index = place * (len(found.messages) - 1) // 9
    found.messages.insert(index + (0, 5)[place % 2], found.messages[index])
    seal(path, found, place // 3)


def metadata_edited(name: str, changes: tuple[dict[str, str], ...]) -> Attack:
    """Members of a metadata record changed, or the record added."""

    def attack(data: Path, _: Site, place: int) -> None:
        path = at(data, place)
        found = Unpacked.of(path)
        there = dict(found.metadata).get(name)
        change = changes[place % len(changes)]
        if there is None or place >= len(changes):
            found.metadata.insert(place % 2, (name, dict(there or {}) | change))  # also as a second record
        else:
            there.update(change)
        seal(path, found, place // 3)

    return attack


def signature_edited(data: Path, _: Site, place: int) -> None:
    """No signature, that of another file, of version 1, two, of other members."""
    path, other = at(data, place), at(data, place + 1)
    found = Unpacked.of(path)
    own = dict(found.metadata)[SIGNATURE_METADATA]
    theirs = dict(Unpacked.of(other).metadata)[SIGNATURE_METADATA]
    rest = [entry for entry in found.metadata if entry[0] != SIGNATURE_METADATA]
    old = {"algorithm": "Ed25519", "public_key": own["public_key"], "signature": own["signature"]}
    seals: tuple[list[dict[str, str]], ...] = (
        [], [theirs], [old], [own | {"algorithm": "none"}], [theirs, own], [own | {"public_key": "A" * 43 + "="}],
        [own | {"text": own["text"] + "x y\n"}], [own | {"signature": ""}], [own | {"text": theirs["text"]}], [{}],
    )  # fmt: skip
    found.metadata = [*rest, *((SIGNATURE_METADATA, each) for each in seals[place])]
    if place < 4:
        found.messages.pop()
    found.write(path)
