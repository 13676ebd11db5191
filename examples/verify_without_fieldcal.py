"""Verifies recordings of a gateway without fieldcal: their signatures, their chain, and the head of the chain.

    python verify_without_fieldcal.py gateway.pub DIRECTORY [--head kept.json]
    python verify_without_fieldcal.py gateway.pub fieldcal-000007.mcap [--result SEQUENCE]

Needs mcap, protobuf, cryptography and zstandard. docs/audit.md describes the bytes that are signed. Exit status: 0 all
was verified, 3 something was not, 2 wrong usage. Whether results follow from the data is what `fieldcal audit` checks.
"""

import argparse
import base64
import hashlib
import io
import json
import mmap
import re
import struct
import sys
from pathlib import Path

import zstandard
from cryptography.exceptions import InvalidSignature
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PublicKey
from cryptography.hazmat.primitives.serialization import load_pem_public_key
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import Channel, Metadata, Schema

MAGIC = b"\x89MCAP0\r\n"
RESULTS = {"window", "calibration", "estimate", "drift", "status", "clock"}
# Files may be hostile, and mcap's own reader has no limits. Bytes: of a file, a record, a chunk after decompression
# (one that is not compressed may be larger), all chunks of a file; then the numbers of records, and bytes of a head.
FILE, RECORD, CHUNK, CHUNKS, RECORDS, HEAD = 4 << 30, 128 << 20, 8 << 20, 1 << 32, 1 << 23, 4096


def need(condition, reason):
    if not condition:
        raise ValueError(reason)


def records(data, start):
    """(offset, opcode, content) of each record, up to the end of the data."""
    for _ in range(RECORDS):
        if start == len(data):
            return
        opcode, length = struct.unpack_from("<BQ", data, start)
        need(length <= min(RECORD, len(data) - start - 9), f"the record at byte {start} reaches beyond the end")
        yield start, opcode, data[start + 9 : start + 9 + length]
        start += 9 + length
    raise ValueError(f"it has more than {RECORDS} records")


def unpacked(chunk):
    """The content of a chunk. Its size is looked at before it is decompressed."""
    size, _, length = struct.unpack_from("<QII", chunk, 16)
    compression, packed = chunk[32 : 32 + length], chunk[40 + length :]
    need(compression == b"" or (compression == b"zstd" and size <= CHUNK), f"a chunk has {size} bytes decompressed")
    need(compression == b"" or zstandard.frame_content_size(packed) == size, "a chunk states a wrong size")
    return zstandard.ZstdDecompressor().decompress(packed, allow_extra_data=False) if compression else packed


def message_kind(schema):
    """The class of a protobuf message, from its description in the recording."""
    pool = descriptor_pool.DescriptorPool()
    for file in descriptor_pb2.FileDescriptorSet.FromString(schema.data).file:
        pool.AddSerializedFile(file.SerializeToString())
    return message_factory.GetMessageClass(pool.FindMessageTypeByName(schema.name))


def items(data):
    """(offset, topic or name, message or metadata, its bytes) of all messages and metadata before DataEnd."""
    kinds, channels, total = {}, {}, 0
    for at, opcode, body in records(data, len(MAGIC)):
        if opcode == Opcode.DATA_END:
            yield at, "DataEnd", None, b""
            return
        if opcode == Opcode.METADATA:
            record = Metadata.read(ReadDataStream(io.BytesIO(body)))
            yield at, record.name, record.metadata, b""
        content = unpacked(body) if opcode == Opcode.CHUNK else b""
        total += len(content)
        need(total <= CHUNKS, "its chunks are too large")
        for _, kind, part in records(content, 0):
            if kind == Opcode.SCHEMA:
                schema = Schema.read(ReadDataStream(io.BytesIO(part)))
                kinds[schema.id] = message_kind(schema)
            elif kind == Opcode.CHANNEL:
                channel = Channel.read(ReadDataStream(io.BytesIO(part)))
                channels[channel.id] = channel.topic, kinds[channel.schema_id]
            else:
                topic, message = channels[struct.unpack_from("<H", part)[0]]
                yield at, topic, message.FromString(part[22:]), part[22:]


def verified(signed, key, purpose):
    """The lines of a signed text (name: value), after its signature and purpose were checked."""
    try:
        key.verify(base64.b64decode(signed["signature"], validate=True), signed["text"].encode())
    except InvalidSignature:
        raise ValueError("its signature was not made with this key, or its text was changed") from None
    first, *lines = signed["text"].splitlines()
    need(first == purpose, f"it is signed for another purpose, {first!r:.60}")
    return dict(line.split(" ", 1) for line in lines)


def verify_result(key, gateway, epoch, public_key, topic, sequence, message):
    """Verify one result: its signature is the last field of its message, and is over the lines and all bytes before."""
    text = (
        f"fieldcal result, version 1\ngateway {gateway}\nepoch {epoch}\nsequence {sequence}\ntopic {topic}\n"
        f"public_key {public_key}\n\n"
    )
    try:
        need(message[-67:-64] == b"\xc2\x3e\x40", f"result {sequence} is not signed")
        key.verify(message[-64:], text.encode() + message[:-67])
    except InvalidSignature:
        raise ValueError(f"the signature of result {sequence} was not made with this key, or it was changed") from None


def verify_file(path, key, wanted):
    """Verify one closed recording: (lines that its signature has, SHA-256, chain of results at its beginning)."""
    need(0 < path.stat().st_size <= FILE, "it is empty or too large")
    with open(path, "rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
        need(data[:8] == data[-8:] == MAGIC, "it does not begin and end as an MCAP file")
        start, origin, last, signature, number, digest = None, {}, "", {}, "0", bytes(32)
        for at, name, item, raw in items(data):
            if name == "/events" and start is None:
                start = item.run_start
            elif name == "fieldcal.file":
                origin = item
                number, digest = (origin.get("previous_results") or "0 " + "00" * 32).split()
                digest = bytes.fromhex(digest)
            elif name == "fieldcal.signature":
                length, signature = at, item
            elif name.rsplit("/", 1)[-1] in RESULTS:
                number, digest = str(item.sequence), hashlib.sha256(digest + name.encode() + b"\0" + raw).digest()
                if "public_key" in origin:  # of an older version: the results have no signatures of their own
                    gateway = f"{start.site}/{start.gateway}"
                    verify_result(key, gateway, origin.get("epoch") or "-", origin["public_key"], name, number, raw)
                if item.sequence == wanted:
                    say(f"{name}: {item}")
            last, before = name, last
        need(signature, "it is not signed: it was made without a signing key, or its signature was taken out")
        need((before, last) == ("fieldcal.signature", "DataEnd"), "it does not end with its signature")
        with memoryview(data) as whole, whole[:length] as signed:
            content, sha256 = hashlib.sha256(signed).hexdigest(), hashlib.sha256(whole).hexdigest()
    lines = {
        "gateway": f"{start.site}/{start.gateway}", "epoch": origin.get("epoch") or "-",
        "recording": str(start.file_sequence), "previous": origin.get("previous_sha256") or "-",
        "results": f"{number} {digest.hex()}", "content": f"{length} {content}",
    }  # fmt: skip
    said = verified(signature, key, "fieldcal recording, version 2")
    need(said == lines, "its signature is of other bytes: " + ", ".join(n for n in lines if said.get(n) != lines[n]))
    return lines, sha256, origin.get("previous_results") or lines["results"]


def verify_order(before, after):
    """Verify that one recording follows another."""
    (a, sha256, _), (b, _, previous_results) = before, after
    need(a["gateway"] == b["gateway"], f"it is of {b['gateway']}, the recording before it of {a['gateway']}")
    between = f"the recordings between number {a['recording']} and this one are missing, or not verified"
    need(int(b["recording"]) == int(a["recording"]) + 1, between)
    need(b["previous"] in (sha256, "-"), "the recording before it is not the one that it names")
    need(previous_results == a["results"], "its chain of results does not begin where the one before it ends")


def verify_head(path, key, files, gateways):
    """Verify that the recordings reach as far as a head says; returns what it says."""
    with open(path, "rb") as file:
        said = verified(json.loads(file.read(HEAD)), key, "fieldcal head, version 1")
    number, (length, content) = int(said["recording"]), said["content"].split()
    need(gateways <= {said["gateway"]}, f"it is a head of {said['gateway']}")
    need(number in files, f"it names recording {number}, which is missing; the newest one here is {max(files)}")
    with open(files[number], "rb") as file:
        begin = hashlib.sha256(file.read(min(int(length), FILE))).hexdigest()
    need(begin == content, f"{files[number].name} does not begin with the {length} bytes that it names")
    return f"recording {number}, {length} bytes, closed: {said['closed']}, {said['utc_ns']} ns UTC"


def public_key(path):
    """The public key in a PEM file."""
    with open(path, "rb") as file:
        try:
            key = load_pem_public_key(file.read(HEAD))
        except Exception:  # of many kinds, for other files
            key = None
    need(isinstance(key, Ed25519PublicKey), "it is no Ed25519 public key in PEM format")
    return key


def reason(error):
    """Why a file was refused, in one line."""
    if isinstance(error, OSError):
        return error.strerror or str(error)
    return str(error) if type(error) is ValueError else f"its bytes cannot be understood: {error!r:.200}"


def say(text):
    """Print; characters that a terminal obeys are written out."""
    print("".join(c if c.isprintable() or c == "\n" else repr(c)[1:-1] for c in text))


def main(arguments):
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("public_key", type=Path, nargs="?", help="of the gateway, PEM")
    parser.add_argument("recordings", type=Path, nargs="?", help="a directory, or one closed recording")
    parser.add_argument("--head", type=Path, action="append", default=[], help="a head that was kept elsewhere")
    parser.add_argument("--result", type=int, metavar="SEQUENCE", help="print this result")
    given = parser.parse_args(arguments)
    if given.recordings is None:
        print("give two things: the gateway's public key (PEM), then its recordings; see --help", file=sys.stderr)
        return 2
    try:
        key = public_key(given.public_key)
    except (OSError, ValueError) as error:
        print(f"{given.public_key}: not the gateway's public key: {reason(error)}", file=sys.stderr)
        return 2
    paths, beside = [given.recordings], []
    if given.recordings.is_dir():
        paths, beside = sorted(given.recordings.glob("*.mcap*")), sorted(given.recordings.glob("head.json"))
    files = {int(found[1]): path for path in paths if (found := re.match(r"fieldcal-(\d+)\.mcap", path.name))}
    failed, good = 0, []
    for path in [path for path in paths if path.suffix == ".mcap"] + beside + given.head:
        try:
            if path.suffix != ".mcap":
                told = verify_head(path, key, files, {lines["gateway"] for lines, _, _ in good})
            else:
                good.append(verify_file(path, key, given.result))
                told = ", ".join(f"{name} {value}" for name, value in good[-1][0].items())
                if len(good) > 1:
                    verify_order(*good[-2:])
            say(f"{path}: verified: {told}")
        except Exception as error:  # a hostile file can make the libraries raise anything
            failed += 1
            say(f"{path}: FAILED: {reason(error)}")
    if not good and not failed:
        say(f"{given.recordings}: FAILED: no closed recording, fieldcal-<number>.mcap, is there")
    if good and not (beside or given.head):
        say("not proven: that nothing is missing at the end, because there is no head")
    return 3 if failed or not good else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
