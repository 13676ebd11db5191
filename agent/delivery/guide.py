"""What the guide of `fieldcal bench` says now: one small JSON message at `fieldcal/v1/<site>/<gateway>/bench`.

It shows the session to people who are not at the terminal. It is no result: it has no number, and nobody keeps it.
Where the gateway has a key, the attachment is a signed text that names the gateway and the SHA-256 of the message.
"""

from __future__ import annotations

import hashlib
from typing import TYPE_CHECKING, Annotated, Literal

import msgspec
from msgspec import Meta

from agent.config.key_file import KeyFileError
from agent.config.known_keys import WatchedKeys
from agent.delivery.verifying import UnverifiedError
from agent.recording.signed_text import SignedText, SignedTextError, values_of, written

if TYPE_CHECKING:
    from agent.recording.signing import Signer

WHAT = "bench"  # the end of the key
LARGEST_GUIDE = 64 << 10  # bytes; a session of eight stops has 3 kB with its result
TEXT_MAX, LINES_MAX, STOPS_MAX = 300, 20, 100
_PURPOSE = "fieldcal bench, version 1"
_LINES = ["gateway", "sha256"]

Text = Annotated[str, Meta(max_length=TEXT_MAX)]
Name = Annotated[str, Meta(max_length=63)]
Lines = Annotated[list[Text], Meta(max_length=LINES_MAX)]
Count = Annotated[int, Meta(ge=0, le=10**6)]
Row = Annotated[list[Name], Meta(min_length=4, max_length=4)]


class Expanded(msgspec.Struct, frozen=True):
    """U (k = 2) of S in per cent of the main sensitivity, the worst of each kind, apart from the reference's error."""

    main_pct: float
    transverse_pct: float


class NextStop(msgspec.Struct, frozen=True):
    """The position that comes next."""

    number: Count
    name: Name  # as a person types it
    told: Text  # where to turn or tilt the sensor
    why: Text
    after: Expanded  # U when it was taken
    more: Count | None  # stops after this one to what is wanted; none if 100 stops do not reach it


class Staying(msgspec.Struct, frozen=True):
    """How the present position goes on."""

    name: Name
    stayed_s: float
    least_s: float
    most_s: float
    expanded: Expanded | None  # U with this position as long as it was measured; none in the first seconds


class TakenStop(msgspec.Struct, frozen=True):
    """A position that is used."""

    name: Name
    expanded: Expanded  # U after it


class Warned(msgspec.Struct, frozen=True):
    """Something is wrong."""

    stop: Count  # the number of the position at which it was seen
    text: Text


class MadeFile(msgspec.Struct, frozen=True):
    """A file on the gateway."""

    path: Text  # from the directory that holds the session's own one
    sha256: Annotated[str, Meta(max_length=64)]


class Ending(msgspec.Struct, frozen=True):
    """How the session ended."""

    status: Literal["valid", "refused", "no result"]
    reasons: Lines
    values: Annotated[
        list[Row], Meta(max_length=3)
    ] = []  # S and Q with U, row by row, rounded; the error of the reference is in U
    coverage_factor: float | None = None
    files: Annotated[list[MadeFile], Meta(max_length=LINES_MAX)] = []  # result and certificate


class Guide(msgspec.Struct, frozen=True, kw_only=True):
    """What the guide says now. Texts are those of the terminal."""

    t_utc_ns: int
    sensor: Name
    stage: Literal["planning", "turn", "measuring", "computing", "question", "ended"]
    wanted: Expanded
    expanded: Expanded | None = None  # U so far; none before it is planned
    outlook: Lines = []  # how many stops it takes, or why this bench does not reach what is wanted
    next: NextStop | None = None
    prompt: Text = ""  # the question that waits for an answer at the terminal
    staying: Staying | None = None
    taken: Annotated[list[TakenStop], Meta(max_length=STOPS_MAX)] = []
    warnings: Annotated[list[Warned], Meta(max_length=LINES_MAX)] = []  # the newest
    ending: Ending | None = None


_GUIDE = msgspec.json.Decoder(Guide)  # made during the import, as agent.delivery.record says


def clipped(text: str, most: int = TEXT_MAX) -> str:
    """A text that a message can hold."""
    return text if len(text) <= most else f"{text[: most - 1]}…"


def signature_of(payload: bytes, gateway: str, signer: Signer) -> bytes:
    """The attachment of a message. `gateway`: `<site>/<gateway>`."""
    digest = hashlib.sha256(payload).hexdigest()
    return signer.sign(written(_PURPOSE, {"gateway": gateway, "sha256": digest})).json


def read_guide(payload: bytes, attachment: bytes, gateway: str, keys: WatchedKeys | None) -> Guide | None:
    """The guide of a message that was published in the name of a gateway; None where it is none, for any bytes.

    With a list of known keys only a message that a key of the gateway signed is read.
    Raises UnverifiedError, nothing else, for another one.
    """
    if len(payload) > LARGEST_GUIDE:
        return None
    if keys is not None:
        _verify(payload, attachment, gateway, keys)
    try:
        return _GUIDE.decode(payload)
    except (msgspec.DecodeError, ValueError, RecursionError):
        return None


def _verify(payload: bytes, attachment: bytes, gateway: str, keys: WatchedKeys) -> None:
    if not attachment:
        raise UnverifiedError("it is not signed")
    try:
        signed = SignedText.read(attachment)
        said = values_of(signed.text, _PURPOSE, _LINES)
        if said != [gateway, hashlib.sha256(payload).hexdigest()]:
            raise UnverifiedError("its signature is of another message or gateway")
        if fault := signed.fault_by(keys.now(), gateway):
            raise UnverifiedError(fault)
    except (SignedTextError, KeyFileError) as error:
        raise UnverifiedError(str(error)) from None
