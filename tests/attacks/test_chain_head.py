"""Recordings deleted at the end, with the store or with its mark set back: a head shows it, and no head is said."""

from __future__ import annotations

import json
import re
import sqlite3
from pathlib import Path

import pytest
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

from agent.cli.given import read_head
from agent.delivery.schema import write_mark
from agent.recording.head import HEAD_NAME, Head
from agent.recording.signed_text import SignedText, SignedTextError, sign
from tests.attacks.chain_site import KEY, audited, audited_json, record


def take(directory: Path, kept: int, *, store: str = "deleted", head: bool = False) -> None:
    """Leave only the first `kept` recordings; the store is deleted, or its mark set back."""
    for path in sorted(directory.glob("*.mcap"))[kept:]:
        path.unlink()
    for path in directory.glob("state.sqlite*"):
        if store == "deleted":
            path.unlink()
    if store == "set back":
        with sqlite3.connect(directory / "state.sqlite") as connection:
            write_mark(connection, "file", kept)
    if head:
        (directory / HEAD_NAME).unlink()


@pytest.mark.parametrize("store", ["deleted", "set back"])
@pytest.mark.parametrize("kept", [-1, 1], ids=["the last", "all but the first"])
def test_the_head_beside_the_recordings_names_what_was_taken(tmp_path: Path, kept: int, store: str) -> None:
    count = len(record(tmp_path / "a"))
    kept %= count
    take(tmp_path / "a", kept, store=store)
    for strict in (True, False):
        status, text = audited(tmp_path / "a", strict=strict)
        assert status == 3
        missing = f"recording {count} is" if kept == count - 1 else f"recordings {kept + 1} to {count} are"
        assert f"{missing} missing at the end" in text


def test_without_any_head_the_audit_says_what_it_cannot_prove(tmp_path: Path) -> None:
    record(tmp_path / "a")
    take(tmp_path / "a", 2, head=True)
    status, text = audited(tmp_path / "a", strict=False)
    assert (status, "not proven: that no recording is missing at the end" in text) == (0, True), text
    status, text = audited(tmp_path / "a")
    assert (status, f"there is no {HEAD_NAME} beside signed recordings" in text) == (3, True)


def test_an_older_head_put_back_is_found_by_a_head_kept_elsewhere(tmp_path: Path) -> None:
    directory = tmp_path / "a"
    record(directory, blocks=6)
    older = (directory / HEAD_NAME).read_bytes()
    kept = len(list(directory.glob("*.mcap")))
    record(directory, seed=2)
    elsewhere = tmp_path / "kept.json"
    elsewhere.write_bytes((directory / HEAD_NAME).read_bytes() + b"\n")
    status, text = audited(directory, heads=[read_head(elsewhere)])
    assert status == 0, text
    assert "whether more was recorded after 2026-09-21" in text
    assert " days ago" in text
    take(directory, kept)
    (directory / HEAD_NAME).write_bytes(older)
    status, text = audited(directory)
    assert (status, "whoever deletes recordings can put an older head there" in text) == (0, True), text
    status, text = audited(directory, heads=[read_head(elsewhere)])
    assert (status, "missing at the end" in text) == (3, True)


def test_the_audit_says_how_old_the_head_is(tmp_path: Path) -> None:
    files = record(tmp_path / "a")
    signed = SignedText.read((tmp_path / "a" / HEAD_NAME).read_bytes())
    head = Head.of(signed)
    end = audited_json(tmp_path / "a")["end"]
    assert (end["recording"], end["length"]) == head.place == (len(files), files[-1].stat().st_size)
    assert (end["utc_ns"], end["gateway"], end["reasons"]) == (head.utc_ns, "site/gateway", [])
    assert end["age_s"] > 86400.0
    assert f"result {end['result']}" in audited(tmp_path / "a")[1]


def test_a_last_recording_that_was_cut_or_changed_is_not_the_one_of_the_head(tmp_path: Path) -> None:
    record(tmp_path / "a")
    other = record(tmp_path / "b", seed=2)[-1]
    last = tmp_path / "a" / other.name
    last.write_bytes(other.read_bytes())
    status, text = audited(tmp_path / "a")
    assert status == 3
    assert re.search(r"(is not the recording|bytes, but) .*this head .*names", text), text
    last.write_bytes(b"")
    status, text = audited(tmp_path / "a")
    assert status == 3
    assert "missing at the end: this head of 2026-09-21" in text


@pytest.mark.parametrize("forgery", ["another key", "another gateway", "changed", "rubbish"])
def test_a_forged_head_is_refused(tmp_path: Path, forgery: str) -> None:
    record(tmp_path / "a")
    record(tmp_path / "b", gateway="other")
    path = tmp_path / "a" / HEAD_NAME
    signed = SignedText.read(path.read_bytes())
    forged = {
        "another key": sign(Ed25519PrivateKey.generate(), signed.text).json,
        "another gateway": (tmp_path / "b" / HEAD_NAME).read_bytes(),
        "changed": path.read_bytes().replace(b"closed yes", b"closed no"),
        "rubbish": json.dumps({"text": "fieldcal head, version 1\n", "public_key": "", "signature": "\ud800"}).encode(),
    }[forgery]
    path.write_bytes(forged)
    status, text = audited(tmp_path / "a")
    words = {"another gateway": "it is a head of 'site/other'", "rubbish": "not a head"}
    assert (status, words.get(forgery, "its signature is not by the given key") in text) == (3, True), text
    if forgery == "rubbish":
        with pytest.raises(SignedTextError, match="not a head of recordings"):
            read_head(path)


def test_the_head_is_written_at_the_beginning_and_never_ahead_of_the_disk(tmp_path: Path) -> None:
    files = record(tmp_path / "a")
    seen = audited_json(tmp_path / "a")["end"]
    text = SignedText.read((tmp_path / "a" / HEAD_NAME).read_bytes()).text
    assert text.startswith("fieldcal head, version 1\ngateway site/gateway\n")
    assert text.endswith(f"closed yes\nutc_ns {seen['utc_ns']}\n")
    length = int(text.partition("opening ")[2].split()[0])
    assert 0 < length < files[-1].stat().st_size
    assert KEY.public_key().public_bytes_raw().hex()


@pytest.mark.parametrize("name", ["text", "public_key", "signature"])
def test_a_head_that_two_readers_could_read_in_two_ways_is_none(name: str) -> None:
    whole = SignedText("a", "b", "c")
    twice = b'{"' + name.encode() + b'":"another",' + whole.json[1:]
    assert SignedText.read(whole.json) == whole
    with pytest.raises(SignedTextError, match=f"not a signed text in JSON: the key '{name}' is there twice"):
        SignedText.read(twice)
