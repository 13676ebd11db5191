"""The plan of the fleet page: what is taken as a picture, who may change it, and that it is kept."""

from __future__ import annotations

import json
import zlib
from collections.abc import Iterator
from typing import Any

import pytest

pytest.importorskip("starlette", reason="the extra monitor is not installed")
pytest.importorskip("uvicorn", reason="the extra monitor is not installed")
pytest.importorskip("argon2", reason="the extra monitor is not installed")

from agent.monitor.pictures import ImageKind, PictureError, picture_of
from agent.monitor.plan import LARGEST_PICTURE
from agent.monitor.users import set_user
from tests.unit.monitor_site import Answer, Served
from tests.unit.zenoh_site import Site

PASSWORD = "correct horse battery staple"
NAMES = "site/gw/mems"


def png(width: int, height: int, tail: bytes = b"") -> bytes:
    """A PNG up to its header, by the specification of the W3C."""
    header = b"IHDR" + width.to_bytes(4, "big") + height.to_bytes(4, "big") + bytes([8, 2, 0, 0, 0])
    return b"\x89PNG\r\n\x1a\n" + (13).to_bytes(4, "big") + header + zlib.crc32(header).to_bytes(4, "big") + tail


def jpeg(width: int, height: int, frame: int = 0xC0) -> bytes:
    """A JPEG up to its frame header, by ITU-T T.81."""
    app0 = b"\xff\xe0\x00\x10JFIF\x00\x01\x01\x00\x00\x01\x00\x01\x00\x00"
    size = height.to_bytes(2, "big") + width.to_bytes(2, "big")
    return b"\xff\xd8" + app0 + bytes([0xFF, frame]) + b"\x00\x11\x08" + size + b"\x03" + bytes(9)


def test_type_and_size_of_pictures() -> None:
    assert picture_of(png(640, 480)) == ImageKind("image/png", 640, 480)
    assert picture_of(jpeg(640, 480)) == ImageKind("image/jpeg", 640, 480)
    assert picture_of(jpeg(640, 480, frame=0xC2)) == ImageKind("image/jpeg", 640, 480)  # progressive


@pytest.mark.parametrize(
    ("data", "why"),
    [
        (b"", "not a PNG or JPEG"),
        (b"<svg xmlns='http://www.w3.org/2000/svg'/>", "not a PNG or JPEG"),
        (b"<html><script>alert(1)</script>", "not a PNG or JPEG"),
        (b"GIF89a" + bytes(40), "not a PNG or JPEG"),
        (b"RIFF\x00\x00\x00\x00WEBPVP8 ", "not a PNG or JPEG"),
        (png(640, 480)[:20], "without its header"),
        (png(640, 480)[:16] + b"\x00\x00\x10\x00" + png(640, 480)[20:], "damaged"),  # another width, the same CRC
        (png(0, 480), "no size"),
        (png(2**31 - 1, 1), "make it smaller"),
        (png(2**24 + 640, 480), "make it smaller"),
        (png(10_000, 10_000), "make it smaller"),
        (jpeg(65_535, 65_535), "make it smaller"),
        (jpeg(640, 0), "no size"),  # T.81 lets a later DNL segment tell it
        (b"\xff\xd8\xff\xe0\x00\x00" + jpeg(1, 1), "without a frame"),
        (b"\xff\xd8\xff\xe0\xff\xff", "without a frame"),
        (b"\xff\xd8" + b"\xff" * 100_000, "without a frame"),
        (b"\xff\xd8\xff\xda\x00\x08" + jpeg(640, 480), "without a frame"),
    ],
)
def test_what_is_no_picture_is_refused_with_its_reason(data: bytes, why: str) -> None:
    with pytest.raises(PictureError, match=why):
        picture_of(data)


@pytest.fixture(scope="module")
def served(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    directory, site = tmp_path_factory.mktemp("plan"), Site()
    set_user(directory / "users", "anna", ("plan",), PASSWORD)
    set_user(directory / "users", "bob", ("hold",), PASSWORD)
    with Served(site, directory / "monitor", users=directory / "users") as running:
        yield running
    site.kill()


def session(served: Served, name: str) -> dict[str, str]:
    """Headers of a user who has logged in."""
    own = {"origin": f"http://{served.address}"}
    begun = served.ask("/api/login", "POST", json.dumps({"name": name, "password": PASSWORD}), own)
    own["cookie"] = begun.headers["set-cookie"].split(";")[0]
    return own | {"x-csrf-token": served.ask("/api/me", headers=own).json["token"]}


def place(served: Served, headers: dict[str, str], told: object) -> Answer:
    return served.ask("/api/plan/position", "POST", json.dumps(told), headers)


@pytest.mark.thorough
def test_a_user_with_the_right_puts_a_picture_and_sensors(served: Served) -> None:
    anna = session(served, "anna")
    assert served.ask("/plan", headers=anna).status == 404
    for data, media_type in ((png(64, 32, b"<script>"), "image/png"), (jpeg(64, 32), "image/jpeg")):
        assert served.ask("/api/plan/picture", "POST", data, anna).status == 204
        got = served.ask("/plan", headers=anna)
        assert (got.status, got.headers["content-type"]) == (200, media_type)
        assert got.headers["x-content-type-options"] == "nosniff"
    assert place(served, anna, {"place": NAMES, "at": [0.25, 1]}).status == 204
    assert place(served, anna, {"place": NAMES, "at": [0.5, 0]}).status == 204
    told = served.ask("/api/plan", headers=anna).json
    assert told["positions"] == {NAMES: [0.5, 0.0]}
    assert len(told["picture"]) == 64
    assert place(served, anna, {"place": NAMES, "at": None}).status == 204
    assert served.ask("/api/plan", headers=anna).json["positions"] == {}


@pytest.mark.thorough
def test_others_and_other_pages_change_nothing(served: Served) -> None:
    anna, bob = session(served, "anna"), session(served, "bob")
    before = served.ask("/api/plan", headers=anna).json
    nobody = {"origin": f"http://{served.address}"}
    refused = {
        "no login": (nobody, 401), "no right": (bob, 403), "no token": (anna | {"x-csrf-token": ""}, 403),
        "another page": (anna | {"origin": "http://evil.example"}, 400),
    }  # fmt: skip
    for headers, status in refused.values():
        assert served.ask("/api/plan/picture", "POST", png(8, 8), headers).status == status
        assert place(served, headers, {"place": NAMES, "at": [0, 0]}).status == status
    assert served.ask("/api/plan", headers=nobody).status == 401
    assert served.ask("/plan", headers=nobody).status == 401
    assert served.ask("/api/plan", headers=anna).json == before


def test_hostile_requests_are_refused(served: Served) -> None:
    anna = session(served, "anna")
    before = served.ask("/api/plan", headers=anna).json
    assert served.ask("/api/plan/picture", "POST", b"<svg/>", anna).status == 400
    too_large = anna | {"content-length": str(LARGEST_PICTURE + 1)}
    assert served.ask("/api/plan/picture", "POST", b"", too_large).status == 413
    refused: tuple[Any, ...] = (
        [], {}, {"place": NAMES}, {"place": NAMES, "at": [0]}, {"place": NAMES, "at": [0, 1.1]},
        {"place": NAMES, "at": [-0.1, 0]}, {"place": NAMES, "at": ["0", 0]}, {"place": "a/b", "at": [0, 0]},
        {"place": "a/b/c/d", "at": [0, 0]}, {"place": "a/b/<img>", "at": [0, 0]},
        {"place": f"a/b/{'c' * 64}", "at": [0, 0]}, {"place": NAMES, "at": [0, 0], "more": 1},
    )  # fmt: skip
    for told in refused:
        assert place(served, anna, told).status == 400
    for text in (
        '{"place": "site/gw/mems", "at": [NaN, 0]}',
        '{"place": "site/gw/mems", "at": [1e999, 0]}',
        "[" * 3000,
    ):
        assert served.ask("/api/plan/position", "POST", text, anna).status == 400
    assert served.ask("/api/plan", headers=anna).json == before
