"""A command that two readers could understand in two ways is refused, even when its signature is good."""

from __future__ import annotations

import json
from base64 import b64encode

import pytest
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

from agent.commanding.arguments import parse_arguments
from agent.commanding.envelope import Order, parse_envelope, seal
from agent.commanding.refusal import Refused

KEY = Ed25519PrivateKey.from_private_bytes(bytes(range(32)))
ARGUMENTS = parse_arguments("pose", b'{"theta_deg": 1, "alpha_deg": 2}')
GOOD = seal(Order.of("site/gateway", "mems", "pose", ARGUMENTS, 5, 6), "anna", KEY)


def signed(body: bytes) -> bytes:
    """A command with this body and a good signature."""
    signature = b64encode(KEY.sign(b"fieldcal-command-1 anna\n" + body))
    return b"fieldcal-command-1 anna " + signature + b"\n" + body


def opened(data: bytes) -> Order:
    return parse_envelope(data).open(KEY.public_key())


@pytest.mark.parametrize("name", ["ab\n", "ab\r", "\nab", "ab\0", "a b", "ab\u2028", "", "a" * 64])
def test_a_position_is_a_name_from_its_first_to_its_last_character(name: str) -> None:
    with pytest.raises(Refused):
        parse_arguments("pose", json.dumps({"theta_deg": 1, "alpha_deg": 2, "position": name}))
    assert parse_arguments("pose", b'{"theta_deg": 1, "alpha_deg": 2, "position": "ab"}')


@pytest.mark.parametrize(
    "twice",
    [
        (b'"verb":"pose"', b'"verb":"hold","verb":"pose"'),
        (b'"sensor":"mems"', b'"sensor":"mems","\\u0073ensor":"other"'),
        (b'"theta_deg":1.0', b'"theta_deg":80,"theta_deg":1.0'),
        (b'"counter":5', b'"counter":9,"counter":5'),
    ],
)
def test_a_key_that_is_there_twice_is_refused(twice: tuple[bytes, bytes]) -> None:
    body = parse_envelope(GOOD).body
    assert body.count(twice[0]) == 1
    assert opened(signed(body)).sensor == "mems"
    with pytest.raises(Refused, match="there twice") as told:
        opened(signed(body.replace(*twice)))
    assert told.value.kind == "malformed"


def test_one_signature_has_one_spelling() -> None:
    head, mark, rest = GOOD.partition(b"==\n")
    assert opened(GOOD)
    for other in {b"A", b"Q", b"g", b"w", b"B", b"/"} - {head[-1:]}:
        with pytest.raises(Refused):
            opened(head[:-1] + other + mark + rest)
