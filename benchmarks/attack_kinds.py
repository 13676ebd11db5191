"""Kinds of attacks on a data directory, each at places 0, 1, 2, ...: of files, of statements and heads, of messages.

The forger knows all formats, and makes every CRC, index and summary right. He has no key of the gateway, but old copies
of the directory, and what the gateway signed for others.
"""

from __future__ import annotations

import hashlib
import os
import shutil
import struct
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from mcap.opcode import Opcode

from agent.core.snapshot import pack, unpack
from agent.engine.known import known_engines
from agent.proto import fieldcal_pb2 as pb
from agent.recording.deleted_list import LIST_NAME
from agent.recording.files import recording_name, recordings
from agent.recording.head import HEAD_NAME
from agent.recording.pruned_ranges import PRUNED_METADATA, Deleted
from agent.recording.records import RecordError
from agent.recording.results_chain import FILE_METADATA
from agent.recording.scan import metadata_of
from agent.recording.set_aside import set_aside
from agent.recording.signed_text import written
from agent.recording.signing import SIGNATURE_METADATA, Signer
from benchmarks.attack_site import OTHER, Site
from benchmarks.mutations import bare
from tests.attacks.chain_site import KEY
from tests.attacks.store_site import GATEWAY
from tests.replay.forgery import Unpacked, records, with_sums

Attack = Callable[[Path, Site, int], object]


@dataclass(frozen=True)
class Kind:
    """An attack; `keyed`: audited with the gateway's key and a kept head; `options`: of the audit, besides."""

    attack: Attack
    keyed: bool = True
    options: tuple[str, ...] = ()


def files(data: Path) -> list[Path]:
    return [path for _, path in recordings(data)]


def at(data: Path, place: int) -> Path:
    """The recording for a place."""
    found = files(data)
    return found[place % len(found)]


# -- files ------------------------------------------------------------------------------------------------------------


def removed(data: Path, _: Site, place: int) -> None:
    """One; the first; the last ones; all but one; every second."""
    found = files(data)
    for path in [*([path] for path in found), found[:3], found[-3:], found[::2]][place]:
        path.unlink()


def replaced(data: Path, _: Site, place: int) -> None:
    found = files(data)
    shutil.copyfile(found[place % 7], found[(place + 1 + place // 7) % 7])


def swapped(data: Path, _: Site, place: int) -> None:
    found = files(data)
    a, b = found[place % 7], found[(place + 1 + place // 7) % 7]
    held = a.read_bytes()
    shutil.copyfile(b, a)
    b.write_bytes(held)


ARABIC = {ord("0") + digit: 0x660 + digit for digit in range(10)}


def renamed(data: Path, _: Site, place: int) -> None:
    """Another number, another number of digits, other digits, another suffix."""
    path = at(data, place)
    number = int(path.name[9:15])
    arabic = f"{number:06d}".translate(ARABIC)
    names = (
        f"fieldcal-{number:07d}.mcap", f"fieldcal-{number}.mcap", f"fieldcal-{arabic}.mcap",
        f"fieldcal-{number + 90:06d}.mcap", f"Fieldcal-{number:06d}.mcap", f"fieldcal-{number:06d}.MCAP",
        f"fieldcal-{number + 1:06d}.mcap.active",
        f"fieldcal-{number:06d}.mcap.bak", f"fieldcal--{number:05d}.mcap", f"fieldcal-{number - 4:06d}.mcap",
    )  # fmt: skip
    path.rename(path.with_name(names[place]))


def doubled(data: Path, _: Site, place: int) -> None:
    """The same recording also under another name, that of a deleted one or of one that never was."""
    names = (
        "000001", "000002", "000010", "000000", "000100", "0000005", "5", "999999999999", "000005".translate(ARABIC),
        "00000000003",
    )  # fmt: skip
    shutil.copyfile(at(data, place), data / f"fieldcal-{names[place]}.mcap")


def put_back(data: Path, site: Site, place: int) -> None:
    """Recordings that the gateway deleted, with one byte of them another; or one as it was before it was closed."""
    for number in ((1,), (2,), (1, 2), (1,), (2,), (1, 2), (1,), (2,), (4,), (4,))[place]:
        for path in site.earlier.glob(f"fieldcal-{number:06d}.mcap*"):
            shutil.copyfile(path, data / path.name)
    if place < 8:
        change_byte(max(data.glob("fieldcal-00000[12].mcap")), 40 + 3000 * place)
    elif place == 9:
        (data / recording_name(4)).unlink()


def change_byte(path: Path, offset: int) -> None:
    content = bytearray(path.read_bytes())
    content[offset] ^= 1
    path.write_bytes(content)


def truncated(data: Path, _: Site, place: int) -> None:
    path = at(data, place)
    ends = Unpacked.of(path).boundaries
    sizes = 0, 8, 9, ends[0], ends[len(ends) // 2], ends[-1], ends[-2], ends[-3] - 1, ends[-1] + 7, ends[1] + 1
    os.truncate(path, sizes[place])


def appended(data: Path, _: Site, place: int) -> None:
    """Bytes behind the footer, a second file behind the first, records between footer and magic, bytes before it."""
    path = at(data, place)
    content = path.read_bytes()
    extra = (b"\0", b"x" * 5000, content, content[:8], content[-8:], content[8:])
    if place < 6:
        path.write_bytes(content + extra[place])
    elif place < 8:
        path.write_bytes(content[:-8] + extra[place - 5] + content[-8:])
    else:
        path.write_bytes((b"\0" if place == 8 else content[:8]) + content)


def flipped(data: Path, _: Site, place: int) -> None:
    path = at(data, place)
    change_byte(path, (path.stat().st_size - 1) * place // 9)


def from_elsewhere(source: str) -> Attack:
    """Recordings of another directory in their places: one, all from one on, and all (with all that is beside them)."""

    def attack(data: Path, site: Site, place: int) -> None:
        other = getattr(site, source)
        if place == 9:
            shutil.rmtree(data)
            shutil.copytree(other, data)
            return
        for number in ((5,), (6,), (7,), (8,), (9,), (5, 6), (8, 9), (6, 7, 8, 9), (5, 6, 7, 8, 9))[place]:
            shutil.copyfile(other / recording_name(number), data / recording_name(number))
        if place > 5:
            shutil.copyfile(other / HEAD_NAME, data / HEAD_NAME)
            shutil.copyfile(other / "state.sqlite", data / "state.sqlite")

    return attack


def set_back(data: Path, site: Site, place: int) -> None:
    """The directory as it was earlier, whole or some of its files."""
    shutil.rmtree(data)
    shutil.copytree(site.earlier, data)
    for number in range(1, 10):
        if (number + place) % 3 == 0 and place and number > 4:
            shutil.copyfile(site.true / recording_name(number), data / recording_name(number))
    if place % 2:
        shutil.copyfile(site.true / HEAD_NAME, data / HEAD_NAME)


def no_file(data: Path, site: Site, place: int) -> None:
    """A directory, FIFO, link to a device, to itself, to nothing, to another recording, where a recording was."""
    path = at(data, place)
    whole = path.rename(path.with_name("kept"))
    makes: tuple[Callable[[], object], ...] = (
        path.mkdir, lambda: os.mkfifo(path), lambda: path.symlink_to("/dev/zero"), lambda: path.symlink_to(path),
        lambda: path.symlink_to("nothing"), lambda: path.symlink_to(site.fork / path.name),
        lambda: path.symlink_to("/dev/stdin"), lambda: path.symlink_to("/proc/self/mem"), path.touch,
        lambda: path.write_bytes(bytes(whole.stat().st_size)),
    )  # fmt: skip
    makes[place]()


def beside(data: Path, site: Site, place: int) -> None:
    """The same under the name of a recording that was deleted, or that never was."""
    path = data / recording_name(10 if place % 2 else 2)
    newest, oldest = data / recording_name(9), data / recording_name(5)
    makes: tuple[Callable[[], object], ...] = (
        path.mkdir, lambda: os.mkfifo(path), lambda: path.symlink_to("/dev/zero"), lambda: path.symlink_to(path),
        lambda: path.symlink_to(newest), lambda: path.symlink_to(site.fork / newest.name),
        path.touch, lambda: path.write_bytes(os.urandom(5000)), lambda: path.write_bytes(oldest.read_bytes()[:-100]),
        lambda: path.with_name(f"{path.name}.active").write_bytes(newest.read_bytes()[:9000]),
    )  # fmt: skip
    makes[place]()


# -- statements, lists and heads --------------------------------------------------------------------------------------


def deletion(path: Path) -> Deleted:
    """What the gateway would say of this recording after its deletion."""
    origin, number = metadata_of(path)[FILE_METADATA], int(path.name[9:15])
    sha256 = hashlib.sha256(path.read_bytes()).hexdigest()
    return Deleted(number, number, origin["epoch"], origin["previous_sha256"], sha256)


def statements_of(source: str) -> Attack:
    """Recordings removed, with statements that the gateway rightly signed elsewhere: of one, of all up to one."""

    def attack(data: Path, site: Site, place: int) -> None:
        other = getattr(site, source)
        found = files(data)
        key = OTHER if source == "key" else KEY
        gateway = "site/other" if source == "gateway" else GATEWAY
        for path in [found[2 + place]] if place < 5 else found[2 : place - 2]:
            path.unlink()
            theirs = Path(shutil.copy(other / path.name, data))
            said = deletion(theirs)
            set_aside(data, said, gateway, Signer(key))

    return attack


def own_statements(data: Path, site: Site, place: int) -> None:
    """Statements about exactly these recordings, but of the wrong form: unsigned, of another key, of version 1, ..."""
    found = files(data)
    chosen = [found[place % 7]] if place % 2 else found[: place + 2 if place < 5 else 7]
    for path, said in [(path, deletion(path)) for path in chosen]:
        number = said.last
        if place in (0, 5):
            set_aside(data, said, GATEWAY, None)
        elif place in (1, 6):
            set_aside(data, said, GATEWAY, Signer(OTHER))
        elif place in (2, 7):
            path.unlink()
            text = written("fieldcal deletion, version 1", {"gateway": GATEWAY, "recording": str(number)})
            (data / f"fieldcal-{number:06d}.deleted").write_bytes(Signer(KEY).sign(text).json)
        elif place in (3, 8):  # the head as a statement
            path.unlink()
            (data / f"fieldcal-{number:06d}.deleted").write_bytes(site.heads[-1])
        else:  # that of another number under this name
            set_aside(data, said, "site/none", Signer(KEY))
            aside = data / f"fieldcal-{number:06d}.deleted"
            aside.rename(data / f"fieldcal-{number + place - 3:06d}.deleted")


def list_edited(data: Path, _: Site, place: int) -> None:
    """`deleted.list` changed, cut, removed, from elsewhere, no file; with recordings removed that it then names."""
    path = data / LIST_NAME
    lines = path.read_bytes().splitlines(keepends=True)
    found = files(data)
    more = "".join(f"{deletion(each).text}\n" for each in found[:2]).encode()
    if place in (0, 5, 6):
        for each in found[:2]:
            each.unlink()
    digits = lines[0].replace(b"1-1", b"1-4")
    contents: tuple[list[bytes], ...] = (
        [*lines, more], lines[:1], [], [lines[1], lines[0]], [digits, *lines[1:]], [more], [b"3-4 - - -\n", *lines],
        [b"\xff" * 300], [*lines[:-1], lines[-1][:-9] + b"0" * 8 + b"\n"], [b"x" * (1 << 24)],
    )  # fmt: skip
    path.write_bytes(b"".join(contents[place]))


def head_forged(data: Path, site: Site, place: int) -> None:
    """The newest recordings removed, with a head that fits: an older one, of elsewhere, two, none, of no form."""
    found = files(data)
    for path in found[-1 - place % 3 :]:
        path.unlink()
    path = data / HEAD_NAME
    old = site.heads[-3 - 2 * (place % 3)]
    if place < 3:
        path.write_bytes(old)
    elif place < 6:
        path.unlink()
        makes = path.mkdir, lambda: os.mkfifo(path), lambda: path.symlink_to("/dev/zero")
        makes[place - 3]()
    elif place == 6:
        path.write_bytes(old + b"\n" + site.heads[-1])
    elif place == 7:
        shutil.copyfile(site.fork / HEAD_NAME, path)
    else:
        path.unlink()
    for store in data.glob("state.*") if place % 2 else ():
        store.unlink()


# -- messages and metadata, with all CRCs right -----------------------------------------------------------------------


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


def other_result(message: Any, place: int) -> None:
    name = ("sxx", "szz", "qx", "u_sxx", "syx", "windows", "coverage_factor", "t_utc_ns", "sequence", "identity")[place]
    value = getattr(message, name)
    setattr(message, name, "ADXL355 1" if name == "identity" else value + 1 if isinstance(value, int) else value * 1.03)


def other_window(message: Any, place: int) -> None:
    if place % 2:
        message.used = not message.used
        message.reason = "" if message.used else "too quiet"
    else:
        name = ("points", "left_out", "start_s", "stop_s", "t_utc_ns")[place // 2]
        setattr(message, name, getattr(message, name) + 1)


def other_status(message: Any, place: int) -> None:
    texts = "VALID", "INVALID", "DRIFT", "", "valid", "x" * 9999, "COLLECTING", "\0", "\x1b[2J", "UNCALIBRATED"
    message.status = texts[place]
    message.reason = "as measured"


def other_samples(message: Any, place: int) -> None:
    """One sample, an arrival, an index, a rate, flags, a temperature: no result need change by it."""

    def bump(name: str, width: int) -> None:
        content = bytearray(getattr(message, name))
        content[len(content) // 2 // width * width] ^= 1
        setattr(message, name, bytes(content))

    match place:
        case 0 | 1:
            bump("differences" if message.differences else "x", 8)
        case 2:
            bump("first_values" if message.first_values else "y", 8)
        case 3:
            bump("burst_intervals_ns" if message.burst_intervals_ns else "burst_t_monotonic_ns", 4)
        case 4:
            message.first_index += 1
        case 5:
            message.nominal_rate_hz *= 1.0001
        case 6:
            message.flags ^= 1
        case 7:
            message.temperature_degc = 21.5
        case 8:
            message.t_utc_ns += 1
        case _:
            message.device = "r"


BIG = (1 << 31) - 1


def hostile_samples(message: Any, place: int) -> None:
    """Sizes that explode, orders and lengths that do not agree, in the packed encoding."""
    for name in ("x", "y", "z", "x_counts", "y_counts", "z_counts"):
        message.ClearField(name)
    message.axes, message.decimal, message.order = 3, place % 2 == 1, 1
    n = 50
    match place:
        case 0:  # many samples of no bytes
            message.burst_sizes, message.first_values, message.differences = b"\xff" * 4_000_000, bytes(12), b""
        case 1:
            message.ClearField("burst_sizes")
            message.burst_count = struct.pack("<i", BIG)
            message.first_values, message.differences = bytes(12), bytes(3)
        case 2:
            message.order = 0xFFFFFFFF
            message.first_values, message.differences = bytes(12), bytes(300)
        case 3:
            message.decimal_places = 0xFFFFFFFF
            message.burst_sizes, message.first_values, message.differences = bytes([n]), bytes(12), bytes(3 * (n - 1))
        case 4:  # sums that wrap around
            message.order, message.burst_sizes = 2, bytes([n])
            message.first_values, message.differences = b"\xff\xff\xff\x7f" * 6, b"\x7f" * (3 * (n - 2) * 4)
        case 5:
            message.burst_sizes, message.first_values, message.differences = bytes([n]), bytes(12), bytes(3 * (n - 1))
            message.negative_zeros = struct.pack("<i", -1) * 1_000_000
        case 6:
            message.axes = 0xFFFFFFFF
            message.burst_sizes, message.first_values, message.differences = bytes([n]), bytes(12), bytes(3 * (n - 1))
        case 7:
            message.burst_sizes, message.first_values, message.differences = b"\1" * n, bytes(12), bytes(1 << 27)
        case 8:
            message.ClearField("burst_sizes")
            message.burst_count = struct.pack("<50i", *range(50, 0, -1))
            message.first_values, message.differences = bytes(12), bytes(3 * (n - 1))
        case _:
            message.burst_sizes, message.first_values, message.differences = bytes(n), bytes(12), bytes(1 << 26)


def other_snapshot(message: Any, place: int) -> bool | None:
    """Another state before the first event, S and Q or what is in force 5 % off."""
    if message.WhichOneof("event") != "run_start":
        return False
    state = unpack(message.run_start.snapshot)
    changed = scaled(state, 1.0 + 0.001 * 3**place)
    message.run_start.snapshot = pack(changed) if place < 8 else (b"", b"\xc1" * 50)[place - 8]
    return None


def scaled(value: Any, factor: float) -> Any:
    """The same with every vector of 12 or more numbers in it multiplied, also in the states of devices in it."""
    if isinstance(value, bytes):
        return pack(scaled(unpack(value), factor))
    if isinstance(value, dict):
        return {key: scaled(each, factor) for key, each in value.items()}
    if isinstance(value, np.ndarray) and value.dtype == float and value.ndim == 1 and value.size >= 12:
        return value * factor
    return value


def engine_names() -> tuple[str, ...]:
    known = known_engines()[-1]
    return (
        f"{known.number}-{known.id}", "11-0123456789abcdef", "", "99", "11", "12-../../etc/passwd", "x" * 100_000,
        "\x1b[2J", f"{known_engines()[0].number}-{known_engines()[0].id}", "11-0123456789ABCDEF",
    )  # fmt: skip


def other_engine(message: Any, place: int) -> bool | None:
    if message.WhichOneof("event") != "run_start":
        return False
    message.run_start.engine = engine_names()[place]
    return None


def other_run(message: Any, place: int) -> bool | None:
    """Another run, gateway, boot, number, configuration or kernel in the first event."""
    start = message.run_start
    if message.WhichOneof("event") != "run_start":
        return False
    match place:
        case 0:
            start.run_id = "run-9"
        case 1:
            start.gateway = "other"
        case 2:
            start.continuation = not start.continuation
        case 3:
            start.file_sequence += 1
        case 4:
            start.config_json = start.config_json.replace("9.80665", "9.80655")
        case 5:
            start.fingerprint["numpy"] = "1.0"
        case 6:
            start.t_utc_ns += 10**15
        case 7:
            start.boot_id = "x"
        case 8:
            start.config_json = "{"
        case _:
            start.engine_sha256 = "0" * 64
    return None


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


# -- bytes of the container -------------------------------------------------------------------------------------------


def record_bytes(opcode: int, content: bytes) -> bytes:
    return struct.pack("<BQ", opcode, len(content)) + content


def attachment(name: str, content: bytes) -> bytes:
    text = b"".join(struct.pack("<I", len(each)) + each for each in (name.encode(), b"application/octet-stream"))
    body = struct.pack("<QQ", 0, 0) + text + struct.pack("<Q", len(content)) + content
    return record_bytes(Opcode.ATTACHMENT, body + struct.pack("<I", zlib.crc32(body)))


def inserted(make: Callable[[int, bytes], bytes]) -> Attack:
    """A record put between two records, at the last place behind the signature; the CRCs are right."""

    def attack(data: Path, _: Site, place: int) -> None:
        path = at(data, place)
        content = path.read_bytes()
        parts = records(content)
        end = next(one for one in parts if one.name == "DataEnd")
        ends = [one.end for one in parts if one.end <= end.offset]
        where = ends[place * (len(ends) - 1) // 9]
        extra = make(place, content)
        section = content[:where] + extra + content[where : end.offset]
        start, offset, _crc = struct.unpack("<QQI", content[-28:-8])
        summary = content[end.end : -28] + struct.pack("<QQ", start + len(extra), offset + len(extra))
        closed = section + record_bytes(Opcode.DATA_END, struct.pack("<I", zlib.crc32(section))) + summary
        path.write_bytes(closed + struct.pack("<I", zlib.crc32(summary)) + content[-8:])

    return attack


def unknown_record(place: int, _: bytes) -> bytes:
    return record_bytes((0x10, 0x20, 0x7F, 0x80, 0x81, 0xC0, 0xFE, 0xFF, 0x90, 0x10)[place], os.urandom(20 * place))


def torn(place: int, content: bytes) -> bytes:
    return attachment("torn" if place % 3 else "x", (b"", content[:5000], bytes(1 << 20))[place % 3])


def one_more(place: int, content: bytes) -> bytes:
    """A record of each kind for a second time."""
    kinds = list({one.name: one for one in records(content)}.values())
    part = kinds[place % len(kinds)]
    return content[part.offset : part.end]


def summary_edited(data: Path, _: Site, place: int) -> None:
    """A byte of index, statistics or offsets, with the CRC of the summary right."""
    path = at(data, place)
    content = bytearray(path.read_bytes())
    parts = records(bytes(content))
    end = next(one for one in parts if one.name == "DataEnd")
    where = end.end + (parts[-1].offset - end.end - 1) * place // 9
    content[where] ^= 0x40
    try:
        path.write_bytes(with_sums(bytes(content)))
    except RecordError:  # the records cannot be walked any longer
        path.write_bytes(content)


# -- store and engines ------------------------------------------------------------------------------------------------


def unsigned(change: Attack) -> Attack:
    """The forger takes away everything signed, and makes the chain right."""

    def attack(data: Path, site: Site, place: int) -> None:
        change(data, site, place)
        bare(data)

    return attack


def forged_results(data: Path, _: Site, place: int) -> None:
    """S 3 % off with U a hundred times as large in all calibrations, by an engine that is known, unknown, or none."""
    for path in files(data):
        found = Unpacked.of(path)
        for index, (topic, schema, *rest, content) in enumerate(found.messages):
            if schema == "fieldcal.v1.Event":
                event = pb.Event.FromString(content)
                if event.WhichOneof("event") != "run_start":
                    continue
                event.run_start.engine = engine_names()[place]
                message: Any = event
            elif schema == "fieldcal.v1.Calibration":
                message = pb.Calibration.FromString(content)
                for name in ("sxx", "syy", "szz"):
                    setattr(message, name, getattr(message, name) * 1.03)
                    setattr(message, f"u_{name}", getattr(message, f"u_{name}") * 100)
                message.engine = engine_names()[place]
            elif schema != "fieldcal.v1.RawBlock":
                message = getattr(pb, schema.rpartition(".")[2]).FromString(content)
                message.engine = engine_names()[place]
            else:
                continue
            found.messages[index] = (topic, schema, *rest, message.SerializeToString(deterministic=True))
        found.write(path)


NO_DIGEST = "0" * 64
KINDS: dict[str, Kind] = {
    "recordings removed": Kind(removed),
    "recording replaced by another": Kind(replaced),
    "recordings swapped": Kind(swapped),
    "recording renamed": Kind(renamed),
    "recording under a second name": Kind(doubled),
    "deleted recordings put back, changed": Kind(put_back),
    "recording truncated": Kind(truncated),
    "bytes appended or put before": Kind(appended),
    "a bit changed": Kind(flipped),
    "recordings of another epoch": Kind(from_elsewhere("epoch")),
    "recordings of another gateway": Kind(from_elsewhere("gateway")),
    "recordings of another key": Kind(from_elsewhere("key")),
    "recordings of a number used again": Kind(from_elsewhere("fork")),
    "directory set back": Kind(set_back),
    "no file in the place of a recording": Kind(no_file),
    "no recording beyond the newest": Kind(beside),
    "statements of another epoch": Kind(statements_of("epoch")),
    "statements of another gateway": Kind(statements_of("gateway")),
    "statements of another key": Kind(statements_of("key")),
    "statements of a number used again": Kind(statements_of("fork")),
    "statements of a wrong form": Kind(own_statements),
    "deleted.list changed": Kind(list_edited),
    "end removed, head forged": Kind(head_forged),
    "calibration edited": Kind(edited("Calibration", other_result)),
    "window edited": Kind(edited("Window", other_window)),
    "status edited": Kind(edited("Status", other_status)),
    "samples edited": Kind(edited("RawBlock", other_samples)),
    "samples hostile": Kind(edited("RawBlock", hostile_samples)),
    "snapshot edited": Kind(edited("Event", other_snapshot)),
    "engine named otherwise": Kind(edited("Event", other_engine)),
    "first event edited": Kind(edited("Event", other_run)),
    "events put in": Kind(more_events),
    "times of messages edited": Kind(times),
    "messages of another epoch": Kind(moved("epoch")),
    "messages of another gateway": Kind(moved("gateway")),
    "messages of a number used again": Kind(moved("fork")),
    "messages dropped": Kind(dropped),
    "messages repeated": Kind(repeated),
    "fieldcal.file edited": Kind(
        metadata_edited(
            FILE_METADATA,
            (
                {"previous_sha256": NO_DIGEST},
                {"previous_sha256": ""},
                {"epoch": NO_DIGEST[:16]},
                {"previous_results": f"0 {NO_DIGEST}"},
                {"public_key": "A" * 43 + "="},
            ),
        )
    ),
    "fieldcal.pruned edited": Kind(
        metadata_edited(
            PRUNED_METADATA,
            (
                {"recordings": f"1-4 - - {NO_DIGEST}"},
                {"recordings": "1-999999999999999999"},
                {"recordings": ""},
                {"list": f"0 {NO_DIGEST}"},
                {"recordings": "9" * 100_000, "list": "x"},
            ),
        )
    ),
    "fieldcal.repair edited": Kind(
        metadata_edited(
            "fieldcal.repair",
            ({"torn_bytes": "0"}, {"reason": "crash"}, {}, {"torn_bytes": "-1"}, {"sound_bytes": "10"}),
        )
    ),
    "signature edited": Kind(signature_edited),
    "record of an unknown kind": Kind(inserted(unknown_record)),
    "attachment put in": Kind(inserted(torn)),
    "record of the container repeated": Kind(inserted(one_more)),
    "summary edited": Kind(summary_edited),
    "unsigned: S 3 % off, U x 100, any engine": Kind(unsigned(forged_results), keyed=False),
    "unsigned: calibration edited": Kind(unsigned(edited("Calibration", other_result)), keyed=False),
    "unsigned: engine named otherwise": Kind(unsigned(edited("Event", other_engine)), keyed=False),
    "unsigned: snapshot edited": Kind(unsigned(edited("Event", other_snapshot)), keyed=False),
    "unsigned: samples hostile": Kind(unsigned(edited("RawBlock", hostile_samples)), keyed=False),
}
