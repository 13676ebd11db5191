"""What a consumer takes for a result: all fields, of the right types, within bounds; other bytes are none."""

from __future__ import annotations

import random
from typing import Any

import msgspec
import pytest

from agent.delivery.received import LARGEST_RESULT, receive
from tests.unit.test_commands import mutated
from tests.unit.zenoh_site import KEY, record

WINDOW = f"{KEY}/mems/window"


def payload(**changes: Any) -> bytes:
    fields = record(7).fields | changes
    return msgspec.json.encode({name: value for name, value in fields.items() if value != "left out"})


@pytest.mark.parametrize("what", ["window", "calibration", "status", "clock"])
def test_a_result_is_taken(what: str) -> None:
    whole = record(7, what)
    received = receive(f"{KEY}/mems/{what}", whole.payload, b"6")
    assert received is not None
    assert (received.sequence, received.previous, received.fields) == (7, 6, whole.fields)


def test_numbers_that_were_not_finite_come_as_null_and_are_taken() -> None:
    fields = record(7, "calibration").fields
    fields["offset"][2] = None
    assert receive(f"{KEY}/mems/calibration", msgspec.json.encode(fields), None) is not None


def test_a_kind_of_a_later_version_is_taken_and_fields_of_one_too() -> None:
    assert receive(f"{KEY}/mems/weather", payload(), None) is not None
    assert receive(WINDOW, payload(colour="red"), None) is not None


@pytest.mark.parametrize(
    "data",
    [
        b"",
        b"[]",
        b"7",
        b"\xff",
        payload(sequence="left out"),
        payload(sequence=-1),
        payload(sequence=2**63),
        payload(sequence=7.5),
        payload(sequence=True),
        payload(sequence=None),
        payload(sensor="other"),  # not the key's
        payload(points="many"),
        payload(used=None),
        payload(numbers={"coherence": [1]}),
        payload(reason="left out"),
        payload(reason="x" * LARGEST_RESULT),
        payload(extra="left out").replace(b"0.99", b"1e999"),
        b'{"a":' + b"[" * 100_000 + b"]" * 100_000 + b"}",
        payload(colour="deep").replace(b'"deep"', b'{"a":' * 900 + b"1" + b"}" * 900),
    ],
)
def test_what_is_no_result_is_none(data: bytes) -> None:
    assert receive(WINDOW, data, None) is None


@pytest.mark.parametrize("field", ["sensitivity", "offset", "standard_uncertainty", "covariance", "determined"])
def test_a_calibration_of_another_shape_is_none(field: str) -> None:
    fields = record(7, "calibration").fields
    for value in (fields[field][:-1], fields[field] * 2, list[float]()):
        assert receive(f"{KEY}/mems/calibration", msgspec.json.encode(fields | {field: value}), None) is None


@pytest.mark.parametrize("attachment", [b"x", b"-1", b"9" * 20, "²".encode(), b"7 "])
def test_an_attachment_that_is_no_number_makes_it_none(attachment: bytes) -> None:
    assert receive(WINDOW, payload(), b"6") is not None
    assert receive(WINDOW, payload(), attachment) is None


def test_mutated_payloads_never_raise_and_what_is_taken_is_whole() -> None:
    """2000 here; benchmarks/fuzz.py does 10^5."""
    random_ = random.Random(21)
    good = record(7, "calibration").payload
    taken = 0
    for _ in range(2000):
        received = receive(f"{KEY}/mems/calibration", mutated(good, random_), b"6")
        if received is not None:
            taken += 1
            assert len(received.fields["covariance"]) == 12
            assert received.fields["sensor"] == "mems"
    assert taken < 1000
