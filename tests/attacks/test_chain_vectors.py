"""docs/audit.md: its test vectors are right, checked with cryptography alone, and are what this program signs."""

from __future__ import annotations

import base64
import hashlib
from dataclasses import replace
from pathlib import Path

import pytest

from agent.recording.head import Head
from agent.recording.result_signing import SignedResult
from agent.recording.results_chain import ResultsChain
from agent.recording.signed_text import key_id, sign
from agent.recording.signing import SignedStatement
from tests.attacks.chain_site import KEY

PAGE = (Path(__file__).parents[2] / "docs" / "audit.md").read_text("utf-8")
RECORDING = SignedStatement(
    "workshop/gateway-1", "00c0ffee00c0ffee", 7, "11" * 32, "4711 " + "22" * 32, 123456, "33" * 32
)
HEAD = Head(RECORDING, "4096 " + "44" * 32, closed=False, utc_ns=1_790_000_000_000_000_000)


def blocks(after: str) -> list[str]:
    """The indented blocks of the page after a line."""
    _, _, rest = PAGE.partition(f"\n{after}\n")
    parts = (part.strip("\n") for part in rest.split("\n\n"))
    return ["".join(f"{line[4:]}\n" for line in part.splitlines()) for part in parts if part.startswith("    ")]


@pytest.mark.parametrize(("title", "text"), [("Recording:", RECORDING.text), ("Head:", HEAD.text)])
def test_the_texts_and_signatures_of_the_page(title: str, text: str) -> None:
    shown, signature = blocks(title)[:2]
    assert shown == text
    KEY.public_key().verify(base64.b64decode(signature), shown.encode())
    assert sign(KEY, text).signature == signature.strip()
    assert sign(KEY, text).fault(KEY.public_key()) == ""
    assert Head.of(sign(KEY, HEAD.text)) == HEAD


def test_the_signed_result_of_the_page() -> None:
    header, message, signature = blocks("Result, with the three bytes `abc` as its message, without a line break:")[:3]
    key = KEY.public_key().public_bytes_raw()
    result = SignedResult("workshop/gateway-1", "00c0ffee00c0ffee", 4711, "/mems/status", key, b"abc")
    assert (header + "\n" + message.rstrip("\n")).encode() == result.data
    KEY.public_key().verify(base64.b64decode(signature), result.data)
    whole = replace(result, message=b"abc\xc2\x3e\x40" + base64.b64decode(signature))
    assert whole.fault == ""
    assert SignedResult.read(whole.data) == whole


def test_the_key_and_the_chain_of_the_page() -> None:
    public = KEY.public_key().public_bytes_raw()
    assert public.hex() in PAGE
    assert f"`{key_id(KEY.public_key())}`" in PAGE
    assert hashlib.sha256(public).hexdigest().startswith(key_id(KEY.public_key()))
    chain, digest = ResultsChain(), bytes(32)
    for topic, message in (("/mems/status", b"abc"), ("/mems/raw", b"no result"), ("/mems/calibration", b"")):
        chain.add(topic, message)
        if topic != "/mems/raw":
            digest = hashlib.sha256(digest + topic.encode() + b"\0" + message).digest()
            assert f"\n    {digest.hex()}\n" in PAGE
    assert chain.digest == digest
