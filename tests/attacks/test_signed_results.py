"""With a list of keys a consumer gives only what a gateway signed; a stranger or a router can change nothing of it."""

from __future__ import annotations

import random
from collections.abc import Iterator
from itertools import islice
from pathlib import Path

import msgspec
import pytest
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

from agent.config.key_file import KeyFileError
from agent.config.known_keys import WatchedKeys, read_known_keys, revoke_key
from agent.delivery import answers, verifying
from agent.delivery.consumer import Consumer
from agent.delivery.history import History, StoredResult
from agent.delivery.received import receive
from agent.delivery.verifying import UnverifiedError, Verifier
from tests.attacks.chain_site import KEY
from tests.attacks.signed_site import OTHER, PLACE, Gateway, listed, numbers_of, signed_record, signer_of, taken
from tests.unit.results import calibration, status
from tests.unit.zenoh_site import Site


@pytest.fixture
def gateway(site: Site, tmp_path: Path) -> Iterator[Gateway]:
    gateway = Gateway(site, tmp_path / "a")
    yield gateway
    gateway.stop()


def test_signed_results_come_as_they_were_signed(site: Site, gateway: Gateway, tmp_path: Path) -> None:
    with Consumer([site.endpoint], keys=listed(tmp_path / "known.keys", KEY)) as consumer:
        results = iter(consumer)
        (first,) = gateway.send(1)
        assert next(results).sequence == first
        numbers = gateway.send(5)
        live = list(islice(results, 5))
        assert numbers_of(live) == numbers
    with History(gateway.store.path) as history:
        records = {record.sequence: record for record in history.after(0, limit=10)}
    for result in live:
        record = records[result.sequence]
        assert result.fields == record.fields
        assert (result.signed, result.signed_by, result.altered) == (record.signed, "56475aa75463474c", ())
    with Consumer([site.endpoint], last_sequence={"site/gw": 0}, keys=tmp_path / "known.keys") as late:
        from_store = taken(late, numbers[-1])
    assert numbers_of(from_store) == [first, *numbers]
    assert [r.fields for r in from_store[1:]] == [r.fields for r in live]


def forgeries(gateway: Gateway) -> dict[str, tuple[bytes, bytes]]:
    """Payloads and signed bytes that a stranger, or the router, may put in the place of the next result."""
    record = gateway.make()
    epoch, result = gateway.store.epoch, calibration(record.sequence)
    twin = signed_record(result, signer_of("site/twin", epoch, KEY), epoch)
    foreign = signed_record(result, signer_of("site/gw", epoch, OTHER), epoch)
    other_kind = signed_record(status(record.sequence), gateway.signer, epoch)
    spare = gateway.make(sensor="spare")
    changed = record.signed.replace(b"type A, white", b"type A, black")
    assert changed != record.signed
    number = f"sequence {record.sequence}\n".encode()
    return {
        "unsigned": (record.payload, b""),
        "another key": (foreign.payload, foreign.signed),
        "another gateway with this key": (twin.payload, twin.signed),
        "another kind": (record.payload, other_kind.signed),
        "another sensor": (spare.payload, spare.signed),
        "message changed": (record.payload, changed),
        "later": (record.payload, record.signed.replace(number, f"sequence {record.sequence + 5000}\n".encode())),
        "other epoch": (record.payload, record.signed.replace(epoch.encode(), b"0123456789abcdef")),
        "no signature": (record.payload, record.signed[:-67]),
        "signature of zeros": (record.payload, record.signed[:-64] + bytes(64)),
        "bytes behind": (record.payload, record.signed + b"\x08\x01"),
        "key exchanged": (
            record.payload,
            b"\n\n".join([foreign.signed.partition(b"\n\n")[0], record.signed.partition(b"\n\n")[2]]),
        ),
        "rubbish": (record.payload, b"fieldcal result, version 1\n\n"),
    }


def test_nothing_that_a_stranger_publishes_is_given(site: Site, gateway: Gateway, tmp_path: Path) -> None:
    (first,) = gateway.send(1)
    forged = forgeries(gateway)
    with Consumer([site.endpoint], keys=listed(tmp_path / "known.keys", KEY)) as consumer, site.client() as stranger:
        results = iter(consumer)
        assert next(results).sequence == first
        for payload, signed in forged.values():
            stranger.put(PLACE, payload, attachment=f"{first}\n".encode() + signed)
        numbers = gateway.send(24)
        given = list(islice(results, 24))
        assert numbers_of(given) == numbers
        assert all(result.confirmed and result.signed_by and not result.altered for result in given)
        assert consumer.refused == {"site/gw": len(forged)}


@pytest.mark.parametrize("kind", ["unsigned", "another key", "message changed", "key exchanged"])
def test_each_refusal_gives_its_reason(gateway: Gateway, tmp_path: Path, kind: str) -> None:
    told = {
        "unsigned": "it is not signed",
        "another key": "signed with the key .*, not with '?56475aa75463474c",
        "message changed": "its signature was not made with this key, or it was changed",
        "key exchanged": "its signature was not made with this key, or it was changed",
    }[kind]
    payload, signed = forgeries(gateway)[kind]
    verifier = Verifier(WatchedKeys(listed(tmp_path / "known.keys", KEY)))
    with pytest.raises(UnverifiedError, match=told):
        receive(PLACE, payload, b"6\n" + signed, verifier)


def test_json_that_says_something_else_is_told_and_the_signed_bytes_count(
    site: Site, gateway: Gateway, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    (first,) = gateway.send(1)
    with Consumer([site.endpoint], keys=listed(tmp_path / "known.keys", KEY)) as consumer, site.client() as router:
        results = iter(consumer)
        assert next(results).sequence == first
        record = gateway.make()
        payload = msgspec.json.encode(record.fields | {"sequence": first + 99, "offset": [0, 0, 0], "recorded": False})
        router.put(PLACE, payload, attachment=f"{first}\n".encode() + record.signed)
        result = next(results)
        assert result.altered == ("offset", "sequence")
        assert result.fields == record.fields | {"recorded": False}
        assert (result.sequence, result.confirmed) == (record.sequence, True)
        assert "says something else than its signed bytes: offset, sequence" in caplog.text
        second = gateway.make(sequence=first + 2)
        router.put(PLACE, b"no JSON", attachment=f"{first + 1}\n".encode() + second.signed)
        result = next(results)
        assert (result.sequence, result.altered) == (first + 2, ("all",))


def test_a_gateway_that_the_list_does_not_name_is_refused_unless_the_first_key_is_trusted(
    site: Site, gateway: Gateway, tmp_path: Path
) -> None:
    path = listed(tmp_path / "known.keys", OTHER, gateway="site/other")
    other = Gateway(site, tmp_path / "b", OTHER, "other")
    with Consumer([site.endpoint], keys=path) as consumer:
        numbers = gateway.send(2)
        (told,) = other.send(1)
        assert [(r.address.source, r.sequence) for r in taken(consumer, told)] == [("site/other", told)]
        assert consumer.refused.keys() == {"site/gw"}
    other.stop()
    verifier = Verifier(WatchedKeys(path), trust_first=True)
    with History(gateway.store.path) as history:
        record = history.after(0, limit=1)[0]
    received = receive(PLACE, record.payload, b"\n" + record.signed, verifier)
    assert received is not None
    assert received.sequence == numbers[0]
    assert "site/gw" in read_known_keys(path).gateways
    forged = signed_record(calibration(5), signer_of("site/gw", "", OTHER), "")
    with pytest.raises(UnverifiedError, match="not with"):
        receive(PLACE, forged.payload, b"\n" + forged.signed, verifier)


def test_strangers_cannot_fill_or_break_the_list_of_a_consumer_that_trusts_the_first_key(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(verifying, "GATEWAYS_MAX", 3)
    path = listed(tmp_path / "known.keys", KEY)
    verifier = Verifier(WatchedKeys(path), trust_first=True)

    def publish(gateway: str) -> None:
        key = Ed25519PrivateKey.generate()
        record = signed_record(calibration(1), signer_of(gateway, "", key), "")
        receive(f"fieldcal/v1/{gateway}/mems/calibration", record.payload, b"\n" + record.signed, verifier)

    for gateway in ("a b/c", "#/c", "a/\u202e"):
        with pytest.raises(UnverifiedError, match="is not <site>/<gateway>"):
            publish(gateway)
    publish("site/2")
    publish("site/3")
    with pytest.raises(UnverifiedError, match="names no key of 'site/4'"):
        publish("site/4")
    assert list(read_known_keys(path).gateways) == ["site/gw", "site/2", "site/3"]


def test_a_key_is_replaced_and_revoked_while_the_consumer_runs(site: Site, tmp_path: Path) -> None:
    path = listed(tmp_path / "known.keys", KEY)
    gateway = Gateway(site, tmp_path / "a")
    with Consumer([site.endpoint], keys=path) as consumer:
        results = iter(consumer)
        (first,) = gateway.send(1)
        assert next(results).sequence == first
        listed(path, KEY, OTHER)
        gateway.signer = signer_of("site/gw", gateway.store.epoch, OTHER)
        (second,) = gateway.send(1)
        assert next(results).sequence == second
        revoke_key(path, KEY.public_key().public_bytes_raw(), "stolen")
        stolen = signed_record(calibration(second + 1), signer_of("site/gw", gateway.store.epoch, KEY), "")
        with site.client() as thief:
            thief.put(PLACE, stolen.payload, attachment=f"{second}\n".encode() + stolen.signed)
        (third,) = gateway.send(1)
        assert next(results).sequence == third
        assert consumer.refused == {"site/gw": 1}
        path.unlink()  # nobody knows any more which keys are revoked
        with pytest.raises(KeyFileError, match="No such file"):
            Consumer([site.endpoint], keys=path)
    gateway.stop()


def test_unsigned_results_of_the_past_do_not_hide_the_signed_ones(
    site: Site, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(answers, "REPLIES_MAX", 5)
    gateway = Gateway(site, tmp_path / "a", key=None)
    gateway.send(12)
    gateway.signer = signer_of("site/gw", gateway.store.epoch, KEY)
    numbers = gateway.send(7)
    with Consumer([site.endpoint], last_sequence={"site/gw": 0}, keys=listed(tmp_path / "known", KEY)) as consumer:
        results = taken(consumer, numbers[-1])
        assert numbers_of(results) == numbers
        assert all(result.confirmed for result in results), "they came from the store"
    with Consumer([site.endpoint], last_sequence={"site/gw": 0}) as consumer:
        assert len(taken(consumer, numbers[-1])) == 19, "without a list of keys all are given, as before"
    gateway.stop()


def test_changed_bytes_are_never_verified(tmp_path: Path) -> None:
    epoch = "00c0ffee00c0ffee"
    record: StoredResult = signed_record(calibration(7), signer_of("site/gw", epoch, KEY), epoch)
    verifier = Verifier(WatchedKeys(listed(tmp_path / "known.keys", KEY)))
    assert receive(PLACE, record.payload, b"6\n" + record.signed, verifier) is not None
    draw = random.Random(14)
    for _ in range(2000):
        data = bytearray(record.signed)
        kind = draw.randrange(4)
        at, to = sorted(draw.sample(range(len(data)), 2))
        if kind == 0:
            data[at] ^= 1 << draw.randrange(8)
        elif kind == 1:
            del data[at:to]
        elif kind == 2:
            data[at:at] = data[at:to]
        else:
            data[at:to] = draw.randbytes(to - at)
        if bytes(data) != record.signed:
            with pytest.raises(UnverifiedError):
                receive(PLACE, record.payload, b"6\n" + bytes(data), verifier)
