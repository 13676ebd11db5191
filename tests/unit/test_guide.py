"""The message of the guide: what is read of it, for any bytes; who may send it; and that it reaches a late monitor."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
from msgspec import structs

from agent.bench.screen import BenchScreen, Person
from agent.config.known_keys import WatchedKeys
from agent.delivery import guide as guide_module
from agent.delivery.guide import Ending, Expanded, Guide, MadeFile, TakenStop, Warned, read_guide, signature_of
from agent.delivery.guide_publication import GuidePublisher
from agent.delivery.verifying import UnverifiedError
from agent.monitor import benches as benches_module
from agent.monitor.benches import Benches
from agent.recording.signing import Signer
from calib.visit.next_stop import WantedUncertainty
from tests.attacks.signed_site import KEY, OTHER, listed
from tests.unit.zenoh_site import Site, wait_for

U = Expanded(0.05, 0.25)
GUIDE = Guide(t_utc_ns=1, sensor="mems", stage="turn", wanted=U)
GATEWAY = "site/gw"


def encoded(**changed: Any) -> bytes:
    return msgspec.json.encode(structs.replace(GUIDE, **changed))


def test_the_largest_guide_fits_and_a_larger_one_is_no_guide() -> None:
    text = "x" * guide_module.TEXT_MAX
    names = ["x" * 63] * 4
    lines = [text] * guide_module.LINES_MAX
    files = [MadeFile(text, "f" * 64)] * guide_module.LINES_MAX
    whole = encoded(
        outlook=lines, prompt=text, warnings=[Warned(8, text)] * guide_module.LINES_MAX,
        taken=[TakenStop("x" * 63, U)] * guide_module.STOPS_MAX,
        ending=Ending("valid", lines, [names] * 3, 2.0, files),
    )  # fmt: skip
    assert len(whole) < guide_module.LARGEST_GUIDE
    assert read_guide(whole, b"", GATEWAY, None) is not None
    assert read_guide(whole + b" " * guide_module.LARGEST_GUIDE, b"", GATEWAY, None) is None
    more: list[dict[str, Any]] = [
        {"prompt": text + "x"},
        {"sensor": "x" * 64},
        {"warnings": [Warned(1, "x")] * (guide_module.LINES_MAX + 1)},
        {"taken": [TakenStop("x", U)] * (guide_module.STOPS_MAX + 1)},
        {"ending": Ending("valid", [], [names] * 4)},
        {"ending": Ending("valid", [], [[*names, "x"]])},
        {"stage": "<script>"},
    ]
    assert [read_guide(encoded(**each), b"", GATEWAY, None) for each in more] == [None] * len(more)


@pytest.mark.parametrize("data", [b"", b"\xff", b"null", b"[]", b"{}", b"[" * 10_000, b'{"t_utc_ns": 1e400}', b"\0"])
def test_other_bytes_are_no_guide(data: bytes) -> None:
    assert read_guide(data, b"", GATEWAY, None) is None


def test_with_a_list_of_keys_only_the_gateways_own_guide_is_read(tmp_path: Path) -> None:
    keys, payload = WatchedKeys(listed(tmp_path / "known.keys", KEY)), encoded()

    def signed(data: bytes = payload, gateway: str = GATEWAY, key: Ed25519PrivateKey = KEY) -> bytes:
        return signature_of(data, gateway, Signer(key))

    assert read_guide(payload, signed(), GATEWAY, keys) == GUIDE
    refused = {
        b"": "not signed",
        b"{}": "not a signed text",
        signed(encoded(prompt="turn it")): "of another message or gateway",
        signed(gateway="site/gw2"): "of another message or gateway",
        signed(key=OTHER): "signed with the key",
        Signer(KEY).sign("fieldcal head, version 1\n").json: "another purpose",
        signed().replace(b"gateway", b"gatewax"): "its lines are not",
    }
    for attachment, reason in refused.items():
        with pytest.raises(UnverifiedError, match=reason):
            read_guide(payload, attachment, GATEWAY, keys)


def test_sessions_are_bounded_and_an_older_guide_changes_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(benches_module, "BENCHES_MAX", 3)
    benches = Benches()
    for name in ("<script>", "..", "a/b", "é", "a" * 64, ""):
        benches.take(name, "gw", GUIDE)
        benches.take("site", name, GUIDE)
    assert benches.rows() == []
    newest = structs.replace(GUIDE, t_utc_ns=5, stage="measuring")
    for guide in (newest, GUIDE):
        benches.take("site", "gw", guide)
    assert (benches.rows()[0]["stage"], benches.version) == ("measuring", 1)
    for k in range(5):
        benches.take("invented", f"g{k}", GUIDE)
        benches.take("site", "gw", newest)  # it goes on, so it stays
    assert [(row["site"], row["gateway"]) for row in benches.rows()] == [
        ("site", "gw"), ("invented", "g4"), ("invented", "g3")
    ]  # fmt: skip
    version = benches.version
    benches.take("site", "gw", newest)  # said again: nothing to draw anew
    assert benches.version == version


def test_a_guide_from_the_future_does_not_hide_those_that_follow(monkeypatch: pytest.MonkeyPatch) -> None:
    """As a clock that was put back, or a stranger where no list of keys is used."""
    benches = Benches()
    benches.take("site", "gw", structs.replace(GUIDE, t_utc_ns=2**62))
    benches.take("site", "gw", structs.replace(GUIDE, stage="measuring"))
    assert benches.rows()[0]["stage"] == "turn"  # it may be one that was recorded and sent again
    monkeypatch.setattr(benches_module, "BACK_S", 0.0)
    benches.take("site", "gw", structs.replace(GUIDE, stage="measuring"))
    assert benches.rows()[0]["stage"] == "measuring"


def test_what_is_said_long_and_often_stays_within_the_message() -> None:
    shown: list[Guide] = []
    screen = BenchScreen(
        "mems", WantedUncertainty(), Person(lambda _: None, lambda _: None, lambda _: None), shown.append
    )
    for _ in range(30):
        screen.warn("knocks " * 100)
        screen.ask("question " * 100)
    screen.took(["x" * 100] * 150, np.full(9, 1e-3))
    screen.show_end(None, 3)
    read = read_guide(msgspec.json.encode(shown[-1]), b"", GATEWAY, None)
    assert read == shown[-1]
    assert len(read.warnings) == guide_module.LINES_MAX
    assert read.ending is not None
    assert read.ending.status == "no result"


@pytest.mark.slow
def test_a_guide_reaches_a_monitor_that_comes_later_and_one_behind_a_new_router(site: Site, tmp_path: Path) -> None:
    pytest.importorskip("starlette", reason="the extra monitor is not installed")
    pytest.importorskip("uvicorn", reason="the extra monitor is not installed")
    from tests.unit.monitor_site import Served

    known = listed(tmp_path / "known.keys", KEY)
    asked = "/api/bench?site=site&gateway=gw"
    with (
        GuidePublisher("site", "gw", [site.endpoint], signer=Signer(KEY)) as publisher,
        GuidePublisher("site", "gw2", [site.endpoint], signer=Signer(OTHER)) as forger,
    ):
        publisher.show(GUIDE)
        forger.show(GUIDE)
        with Served(site, tmp_path / "monitor", known) as served:

            def prompt() -> str | None:
                guide = served.ask(asked).json["guide"]
                return None if guide is None else guide["prompt"]

            wait_for(lambda: prompt() == "")
            wait_for(lambda: served.following.refused.get("site/gw2", 0) > 0)
            assert [row["gateway"] for row in served.ask(asked).json["benches"]] == ["gw"]
            site.kill()
            site.restart()
            publisher.show(structs.replace(GUIDE, t_utc_ns=2, prompt="Enter"))
            wait_for(lambda: prompt() == "Enter")
            publisher.show(structs.replace(GUIDE, t_utc_ns=3, prompt="last"))
            publisher.close()
            wait_for(lambda: prompt() == "last")
