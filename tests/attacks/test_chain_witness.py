"""A witness on another machine keeps heads that cannot be changed, and two histories under one key are proven."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest
from click.testing import CliRunner
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

from agent.cli.audit import audit
from agent.config.known_keys import WatchedKeys, revoke_key
from agent.delivery.publication import Publisher
from agent.delivery.store import Store
from agent.recording.head import HEAD_NAME
from agent.recording.signing import Signer
from agent.recording.witness import KEY_NAME, PUBLIC_NAME, ChainWitness, WitnessError
from tests.attacks.chain_site import KEY, known, public_pem, record
from tests.attacks.signed_site import listed
from tests.unit.zenoh_site import Site, wait_for

ROOT = Path(__file__).parents[2]
GATEWAY = "site/gateway"
OWN = Ed25519PrivateKey.from_private_bytes(bytes(32))


def witness(directory: Path, **options: object) -> ChainWitness:
    directory.mkdir(exist_ok=True)
    (directory / PUBLIC_NAME).write_bytes(public_pem(OWN))
    return ChainWitness(directory, Signer(OWN), options.get("keys"), time.time_ns)  # type: ignore[arg-type]


def audited(data: Path, kept: Path, tmp_path: Path) -> tuple[int, str]:
    (tmp_path / "gateway.pub").write_bytes(public_pem())
    options = [str(data), "--public-key", str(tmp_path / "gateway.pub"), "--witness", str(kept)]
    done = CliRunner().invoke(audit, options, standalone_mode=False)
    assert done.exception is None
    return done.return_value, done.output


@pytest.fixture(scope="module")
def kept_site(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """(recordings, directory of a witness that saw all of their heads)."""
    directory, heads = tmp_path_factory.mktemp("witness"), list[Any]()
    record(directory / "data", heads=heads)
    own = witness(directory / "kept")
    assert [own.take(GATEWAY, head)[0] for head in heads] == [True] * len(heads)
    return directory / "data", directory / "kept"


@pytest.fixture
def site(kept_site: tuple[Path, Path], tmp_path: Path) -> tuple[Path, Path]:
    """Copies of `kept_site` to attack."""
    data, kept = (Path(shutil.copytree(path, tmp_path / path.name)) for path in kept_site)
    return data, kept


# The recordings are of a stand-in for the pipeline, so the command refuses each file; what counts is said at the end.
def test_recordings_and_head_deleted_together_are_missed(site: tuple[Path, Path], tmp_path: Path) -> None:
    data, kept = site
    text = audited(data, kept, tmp_path)[1]
    assert "missing at the end" not in text
    assert "received" in text
    assert "not proven: whether more was recorded after" in text
    for path in [*sorted(data.glob("*.mcap"))[2:], data / HEAD_NAME, *data.glob("state.sqlite*")]:
        path.unlink()
    assert "missing at the end" in audited(data, kept, tmp_path)[1]


@pytest.mark.parametrize("change", ["removed", "swapped", "altered", "other key"])
def test_a_line_of_the_witness_cannot_be_changed(site: tuple[Path, Path], tmp_path: Path, change: str) -> None:
    data, kept = site
    path = kept / f"{GATEWAY}.heads"
    first, second, *rest = path.read_bytes().splitlines(keepends=True)
    path.write_bytes(b"".join({
        "removed": [first, *rest],
        "swapped": [second, first, *rest],
        "altered": [first, second.replace(b"closed yes", b"closed no"), *rest],
        "other key": [first, second, *rest],
    }[change]))  # fmt: skip
    if change == "other key":
        (kept / PUBLIC_NAME).write_bytes(public_pem())
    text = audited(data, kept, tmp_path)[1]
    assert f"FAILED: {path}: line" in text
    with pytest.raises(WitnessError):
        ChainWitness(kept, Signer(KEY if change == "other key" else OWN), None, time.time_ns)


def test_two_histories_under_one_key_are_proven(tmp_path: Path) -> None:
    first: list[bytes] = []
    second: list[bytes] = []
    record(tmp_path / "a", blocks=6, heads=first)
    record(
        tmp_path / "b", blocks=6, seed=2, heads=second
    )  # the same gateway again, from a directory that was lost or set back
    own = witness(tmp_path / "kept")
    for head in first:
        own.take(GATEWAY, head)
    said = [own.take(GATEWAY, head) for head in second]
    assert "PROOF of two histories: two recordings 1 with different beginnings were signed" in said[0][1]
    assert not any("PROOF" in text for _, text in map(own.take, [GATEWAY] * len(second), second))
    text = audited(tmp_path / "a", tmp_path / "kept", tmp_path)[1]
    assert "FAILED" in text
    assert "proof of two histories" in text
    assert witness(tmp_path / "kept").take(GATEWAY, second[0]) == (False, ""), "known after a restart too"


def test_heads_of_strangers_are_refused(tmp_path: Path) -> None:
    mine: list[bytes] = []
    theirs: list[bytes] = []
    record(tmp_path / "a", blocks=6, heads=mine)
    record(tmp_path / "b", blocks=6, heads=theirs, key=Ed25519PrivateKey.generate())
    own = witness(tmp_path / "kept")
    assert own.take(GATEWAY, mine[0])[0]
    assert "not with the one seen first" in own.take(GATEWAY, theirs[-1])[1]
    strict = witness(tmp_path / "listed", keys=lambda: known(KEY))
    assert "not with 56475aa75463474c" in strict.take(GATEWAY, theirs[0])[1]
    assert strict.take(GATEWAY, mine[0])[0]
    forged = json.dumps(json.loads(mine[1]) | {"signature": json.loads(mine[0])["signature"]}).encode()
    for source, data in [(GATEWAY, forged), ("site/other", mine[1]), ("../..", mine[1]), (GATEWAY, b"\xff" * 99)]:
        taken, said = strict.take(source, data)
        assert (taken, "refused" in said) == (False, True)
    assert sorted(path.name for path in (tmp_path / "listed").iterdir()) == ["site", PUBLIC_NAME]


def test_the_list_of_keys_counts_and_is_read_again(tmp_path: Path) -> None:
    heads: list[bytes] = []
    record(tmp_path / "a", blocks=6, heads=heads)
    path = listed(tmp_path / "known.keys", KEY, gateway="site/other")
    own = witness(tmp_path / "kept", keys=WatchedKeys(path).now)
    assert "names no key of 'site/gateway'" in own.take(GATEWAY, heads[0])[1], "the key counts for its gateway only"
    listed(path, KEY, gateway=GATEWAY)
    assert own.take(GATEWAY, heads[0])[0]
    path.unlink()
    assert "known.keys: cannot be read" in own.take(GATEWAY, heads[-1])[1]
    listed(path, KEY, gateway=GATEWAY)
    revoke_key(path, KEY.public_key().public_bytes_raw(), "stolen")
    assert "which is revoked: stolen" in own.take(GATEWAY, heads[-1])[1]


def test_a_power_cut_in_the_last_line_costs_that_line(tmp_path: Path) -> None:
    heads: list[bytes] = []
    record(tmp_path / "a", blocks=6, heads=heads)
    own = witness(tmp_path / "kept")
    for head in heads[:-1]:
        own.take(GATEWAY, head)
    path = tmp_path / "kept" / f"{GATEWAY}.heads"
    whole = path.read_bytes()
    path.write_bytes(whole + b'{"text":"fieldcal wit')
    again = witness(tmp_path / "kept")
    assert path.read_bytes() == whole
    assert again.take(GATEWAY, heads[-1])[0]


def test_a_head_reaches_the_witness_over_the_network(tmp_path: Path) -> None:
    """The real program, begun after the head was published; a plain get answers the head too."""
    record(tmp_path / "a", blocks=4)
    head = (tmp_path / "a" / HEAD_NAME).read_bytes()
    site, store = Site(), Store(tmp_path / "a", 0)
    publisher = Publisher("site", "gateway", [site.endpoint], store)
    kept = tmp_path / "kept"
    keys = listed(tmp_path / "known.keys", KEY, gateway=GATEWAY)
    command: list[str | Path] = [
        sys.executable,
        "-m",
        "agent",
        "witness",
        "--dir",
        kept,
        "--connect",
        site.endpoint,
        "--keys",
        keys,
    ]
    try:
        publisher.tell_head(head)
        publisher.start()
        with subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, text=True) as process:
            wait_for((kept / f"{GATEWAY}.heads").exists)
            process.terminate()
            said = process.communicate(timeout=60)[0]
        with site.client() as client:
            assert [r.ok.payload.to_bytes() for r in client.get("fieldcal/v1/*/*/head") if r.ok] == [head]
    finally:
        publisher.close()
        store.close()
        site.kill()
    assert (process.returncode, f"{GATEWAY}: recording" in said) == (0, True), said
    assert (kept / KEY_NAME).stat().st_mode & 0o077 == 0
    assert "received" in audited(tmp_path / "a", kept, tmp_path)[1]
