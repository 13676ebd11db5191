"""Commands that Python and the browser must sign with the same bytes, in command_vectors.json.

`python -m tests.unit.test_command_vectors` writes the file anew.
"""

from __future__ import annotations

import json
from base64 import b64decode, b64encode
from pathlib import Path
from typing import Any

import pytest
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PublicKey
from cryptography.hazmat.primitives.serialization import Encoding, PublicFormat

from agent.commanding.arguments import parse_arguments
from agent.commanding.envelope import Order, parse_envelope, seal
from agent.keys.files import SigningKey
from tests.unit.browser import Watched, chromium, needs_chromium
from tests.unit.command_desk import ANNA
from tests.unit.zenoh_site import Site

FILE = Path(__file__).with_name("command_vectors.json")
NOW = 1_790_000_000_123_456_789
ARGUMENTS: list[tuple[Any, dict[str, Any]]] = [
    ("hold", {}),
    ("hold", {"release": True}),
    ("accept", {"sequence": 1795425517669}),
    ("rollback", {"sequence": 1}),
    ("pose", {"theta_deg": 35.0, "alpha_deg": -120.25}),
    ("pose", {"theta_deg": -0.0, "alpha_deg": 1e-7, "position": "A.1_b-2"}),
    ("pose", {"direction": [0.6, 0.0, -0.8], "gravity_mps2": [0.00001, -9.80665, 0.000123]}),
    ("pose", {"gravity_mps2": [1 / 3, 9.8, 1.5e-6]}),
]


def vectors() -> list[dict[str, str]]:
    """Each command: its arguments as JSON, and its bytes as text."""
    made = []
    for verb, arguments in ARGUMENTS:
        parsed = parse_arguments(verb, json.dumps(arguments))
        order = Order.of("workshop/gateway-1", "mems", verb, parsed, NOW, NOW + 60_000_000_000)
        made.append({"verb": verb, "arguments": json.dumps(arguments), "bytes": seal(order, "anna", ANNA).decode()})
    return made


def test_python_signs_the_vectors() -> None:
    assert json.loads(FILE.read_text()) == vectors()
    for vector in json.loads(FILE.read_text()):
        order = parse_envelope(vector["bytes"].encode()).open(ANNA.public_key())
        assert (order.verb, order.counter) == (vector["verb"], NOW)


@needs_chromium
def test_the_browser_signs_the_same_bytes_with_a_key_that_it_does_not_give_away(site: Site, tmp_path: Path) -> None:
    pytest.importorskip("uvicorn", reason="the extra monitor is not installed")
    from tests.unit.monitor_site import Served

    script = """async ([vectors, keyFile, now]) => {
        const signing = await import("/signing.js"), key = await signing.readKeyFile(keyFile);
        const signed = [];
        for (const vector of vectors) {
            const order = {gateway: "workshop/gateway-1", sensor: "mems", verb: vector.verb,
                           arguments: JSON.parse(vector.arguments), counter: BigInt(now),
                           expires_utc_ns: BigInt(now) + 60000000000n};
            signed.push(new TextDecoder().decode(await signing.seal(order, key.id, key.privateKey)));
        }
        const given = await crypto.subtle.exportKey("pkcs8", key.privateKey).then(() => "exported", (e) => e.name);
        await signing.keep(key);
        await signing.keep(await signing.makeKey("made"));
        const kept = await signing.keys(), made = kept.find((k) => k.id === "made");
        const first = await signing.sign({gateway: "w/g", sensor: "s", verb: "hold", arguments: {}}, "made");
        const again = await signing.sign({gateway: "w/g", sensor: "s", verb: "hold", arguments: {}}, "made");
        const counters = [first, again].map((b) => /"counter":([0-9]+)/.exec(new TextDecoder().decode(b))[1]);
        return [signed, key.publicKey, [given, ...kept.map((k) => String(k.privateKey.extractable))], counters,
                made.publicKey, new TextDecoder().decode(first)];
    }"""
    with Served(site, tmp_path / "monitor") as served, chromium() as browser:
        watched = Watched(browser, served.address)
        told = watched.open().evaluate(script, [vectors(), SigningKey("anna", ANNA).pem.decode(), str(NOW)])
        signed, public, secrecy, counters, made_public, made_signed = told
        watched.close()
    assert signed == [vector["bytes"] for vector in json.loads(FILE.read_text())]
    assert public == b64encode(ANNA.public_key().public_bytes(Encoding.Raw, PublicFormat.Raw)).decode()
    assert secrecy == ["InvalidAccessError", "false", "false"]
    assert int(counters[0]) < int(counters[1])

    assert parse_envelope(made_signed.encode()).open(Ed25519PublicKey.from_public_bytes(b64decode(made_public)))


if __name__ == "__main__":
    FILE.write_text(json.dumps(vectors(), indent=1) + "\n")
