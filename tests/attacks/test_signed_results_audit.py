"""The audit checks the signature of each result, whose key it is, and whether the key is revoked."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from agent.config.known_keys import KnownKeys, read_known_keys, revoke_key
from agent.recording.files import recordings
from agent.recording.scan import scan
from tests.attacks.chain_site import KEY, audited, audited_json, known, record
from tests.attacks.signed_site import OTHER, listed
from tests.replay.forgery import change_messages

NO_KEYS: dict[str, Any] = {"keys": None, "strict": False}


def test_every_result_is_signed_and_the_audit_counts_them(tmp_path: Path) -> None:
    record(tmp_path / "a")
    count = sum(len(scan(path).results) for _, path in recordings(tmp_path / "a"))
    for options in ({}, NO_KEYS):
        assert sum(file["signed_results"] for file in audited_json(tmp_path / "a", **options)["files"]) == count > 5


@pytest.mark.parametrize("options", [{}, NO_KEYS], ids=["with the key", "without"])
@pytest.mark.parametrize("change", [(b"as it is", b"as it WAS"[:8]), (b"\xc2\x3e\x40", b"\xc2\x3e\x3f")])
def test_a_changed_result_is_named_also_without_the_key(
    tmp_path: Path, options: dict[str, Any], change: tuple[bytes, bytes]
) -> None:
    files = record(tmp_path / "a", blocks=3)
    change_messages(files[0], *change)
    status, text = audited(tmp_path / "a", **options)
    assert status == 3
    assert "results without a valid signature; the first: result " in text or "fieldcal.v1.Status" in text, text


def test_results_of_another_gateway_with_the_same_key_are_not_signed_for_this_one(tmp_path: Path) -> None:
    files = record(tmp_path / "a", blocks=3)
    change_messages(files[0], b"gateway", b"getaway")
    status, text = audited(tmp_path / "a", **NO_KEYS)
    assert (status, "results without a valid signature" in text) == (3, True), text


def test_each_gateway_has_its_own_keys_and_a_revoked_one_counts_nowhere(tmp_path: Path) -> None:
    record(tmp_path / "a", blocks=6)
    path = listed(tmp_path / "known.keys", OTHER, KEY, gateway="site/gateway")
    status, text = audited(tmp_path / "a", keys=read_known_keys(path))
    assert status == 0, text
    status, text = audited(tmp_path / "a", keys=read_known_keys(listed(tmp_path / "b.keys", KEY, gateway="site/b")))
    assert (status, "names no key of 'site/gateway'" in text) == (3, True), text
    revoke_key(path, KEY.public_key().public_bytes_raw(), "lost")
    for keys in (read_known_keys(path), KnownKeys(anywhere=known(KEY).anywhere, revoked=read_known_keys(path).revoked)):
        status, text = audited(tmp_path / "a", keys=keys)
        assert (status, "56475aa75463474c, which is revoked: lost" in text) == (3, True), text


def test_a_replaced_key_signs_what_comes_after_it(tmp_path: Path) -> None:
    record(tmp_path / "a", blocks=6)
    record(tmp_path / "a", blocks=6, seed=2, key=OTHER)
    both = listed(tmp_path / "known.keys", KEY, OTHER, gateway="site/gateway")
    status, text = audited(tmp_path / "a", keys=read_known_keys(both))
    assert status == 0, text
    status, text = audited(tmp_path / "a", keys=known(OTHER))
    assert (status, "signed with the key" in text) == (3, True), text
