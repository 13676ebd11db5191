"""A stranger verifies recordings of the real program without fieldcal, and sees each kind of tampering."""

from __future__ import annotations

import ast
import re
import shutil
import sqlite3
import struct
import subprocess
import sys
import threading
from collections.abc import Callable
from contextlib import closing
from pathlib import Path

import msgspec
import pytest
import verify_without_fieldcal as outsider
from cryptography.hazmat.primitives.asymmetric.ec import SECP256R1, generate_private_key
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
from cryptography.hazmat.primitives.serialization import Encoding, NoEncryption, PrivateFormat, PublicFormat

from agent.delivery.consumer import Consumer, Received
from tests.attacks.chain_site import KEY, public_pem, record
from tests.attacks.signed_site import listed
from tests.replay.forgery import change_messages
from tests.scenarios.processes import ROOT, fieldcal
from tests.unit.zenoh_site import Site

SCRIPT = ROOT / "examples" / "verify_without_fieldcal.py"
UNSIGNED = ROOT / "tests" / "replay" / "golden" / "format-3" / "fieldcal-000001.mcap"
PAGE = (ROOT / "docs" / "audit.md").read_text("utf-8")
# A second for each position, so that each second gives a result; the virtual bench has no port.
CONFIG = """
[gateway]
site = "site"
name = "gateway"
[[devices]]
name = "mems"
driver = "virtual"
options = {{ role = "sensor" }}
[[devices]]
name = "reference"
driver = "virtual"
options = {{ role = "reference" }}
[[channels]]
sensor = "mems"
reference = "reference"
prior = {{}}
guard_s = 0.1
poses = [{{ start_s = 0, stop_s = 0.8, theta_deg = 35, alpha_deg = 0 }}]
poses_repeat_s = 1
[recording]
rotate_s = 1
signing_key = "{key}"
[zenoh]
connect = ["{endpoint}"]
"""


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """`data`, the directory of a real run; `gateway.pub`, its key; `other`, `twin`: with the same key."""
    directory = tmp_path_factory.mktemp("outsider")
    private = directory / "gateway.key"
    private.write_bytes(KEY.private_bytes(Encoding.PEM, PrivateFormat.PKCS8, NoEncryption()))
    private.chmod(0o600)
    (directory / "gateway.pub").write_bytes(public_pem())
    router = Site()
    (directory / "config.toml").write_text(CONFIG.format(key=private, endpoint=router.endpoint))
    record(directory / "other", gateway="other")
    record(directory / "twin")
    consumer = Consumer([router.endpoint], keys=listed(directory / "known.keys", KEY, gateway="site/gateway"))
    received: list[Received] = []
    iterating = threading.Thread(target=lambda: received.extend(consumer), daemon=True)
    iterating.start()
    done = fieldcal("run", directory / "config.toml", "--data-dir", directory / "data", "--duration", "5")
    assert done.returncode == 0, done.stderr
    consumer.close()
    iterating.join(60.0)
    router.kill()
    assert consumer.refused == {}
    (directory / "received").write_bytes(msgspec.msgpack.encode([result.signed for result in received]))
    return directory


@pytest.fixture
def site(recorded: Path, tmp_path: Path) -> Path:
    shutil.copytree(recorded / "data", tmp_path / "data")
    shutil.copy(recorded / "gateway.pub", tmp_path)
    return tmp_path


def verify(site: Path, capsys: pytest.CaptureFixture[str], *more: str) -> tuple[int, list[str]]:
    """(exit status of the script, its lines that say that something failed)."""
    status = outsider.main([str(site / "gateway.pub"), str(site / "data"), *more])
    return status, [line for line in capsys.readouterr().out.splitlines() if "FAILED" in line]


def test_the_script_verifies_what_the_program_recorded(recorded: Path) -> None:
    files = sorted((recorded / "data").glob("*.mcap"))
    assert len(files) >= 3
    command = [sys.executable, "-I", str(SCRIPT), "../gateway.pub", "."]
    done = subprocess.run(command, cwd=recorded / "data", capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    assert done.stdout.count(": verified: ") == len(files) + 1
    assert f"recording {len(files)}, {files[-1].stat().st_size} bytes, closed: yes" in done.stdout


def test_the_script_imports_nothing_of_fieldcal() -> None:
    tree = ast.parse(SCRIPT.read_text())
    named = {alias.name for node in ast.walk(tree) if isinstance(node, ast.Import) for alias in node.names}
    named |= {node.module or "" for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)}
    outside = {name.split(".")[0] for name in named} - sys.stdlib_module_names
    assert outside == {"mcap", "google", "cryptography", "zstandard"}


def test_it_prints_one_result(site: Path, capsys: pytest.CaptureFixture[str]) -> None:
    first = str(min((site / "data").glob("*.mcap")))
    outsider.main([str(site / "gateway.pub"), first])
    sequence = re.search(r"results (\d+) ", capsys.readouterr().out)
    assert sequence
    outsider.main([str(site / "gateway.pub"), first, "--result", sequence[1]])
    assert f"\nsequence: {sequence[1]}\n" in capsys.readouterr().out


def test_the_store_holds_the_bytes_of_the_recording(site: Path) -> None:
    with closing(sqlite3.connect(site / "data" / "state.sqlite")) as store:
        kept = [bytes(data).partition(b"\n\n")[2] for (data,) in store.execute("SELECT data FROM signed")]
    stored = [
        raw
        for path in sorted((site / "data").glob("*.mcap"))
        for _, topic, _, raw in outsider.items(path.read_bytes())
        if topic.rsplit("/", 1)[-1] in outsider.RESULTS
    ]
    assert kept == stored
    assert len(kept) >= 2


def test_a_consumer_received_the_same_bytes(recorded: Path) -> None:
    with closing(sqlite3.connect(recorded / "data" / "state.sqlite")) as store:
        kept = [bytes(data) for (data,) in store.execute("SELECT data FROM signed ORDER BY sequence")]
    assert msgspec.msgpack.decode((recorded / "received").read_bytes()) == kept


def change_byte(data: Path, _: Path) -> None:
    path = data / "fieldcal-000002.mcap"
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 1
    path.write_bytes(content)


def swap(data: Path, _: Path) -> None:
    a, b = data / "fieldcal-000001.mcap", data / "fieldcal-000002.mcap"
    a.rename(data / "c"), b.rename(a), (data / "c").rename(b)


def cut(data: Path, kept: float) -> None:
    path = data / "fieldcal-000002.mcap"
    content = path.read_bytes()
    path.write_bytes(content[: int(kept * len(content)) if kept < 1 else -int(kept)])


def change_result(data: Path, _: Path) -> None:
    """As a careful forger would: all CRCs are right."""
    change_messages(data / "fieldcal-000001.mcap", b"mems", b"MEMS")


def resign(data: Path, _: Path) -> None:
    """The same recording, signed by another key."""
    other = record(data.parent / "forged", key=Ed25519PrivateKey.generate())
    shutil.copy(other[1], data / "fieldcal-000002.mcap")


TAMPERED: dict[str, tuple[Callable[[Path, Path], object], str]] = {
    "byte changed": (change_byte, r"000002.mcap: FAILED"),
    "result changed": (
        change_result,
        r"mcap: FAILED: the signature of result \d+ was not made with this key, or it was changed",
    ),
    "other key": (resign, r"000002.mcap: FAILED: .* was not made with this key"),
    "first dropped": (lambda data, _: (data / "fieldcal-000001.mcap").unlink(), ""),
    "middle dropped": (lambda data, _: (data / "fieldcal-000002.mcap").unlink(), r"000003.mcap: FAILED: .* missing"),
    "last dropped": (lambda data, _: max(data.glob("*.mcap")).unlink(), r"head.json: FAILED: .* which is missing"),
    "swapped": (swap, r"000002.mcap: FAILED: the recordings between number 2 and this one are missing"),
    "cut in the middle": (lambda data, _: cut(data, 0.5), r"000002.mcap: FAILED: it does not begin and end as"),
    "cut at the end": (lambda data, _: cut(data, 9), r"000002.mcap: FAILED: it does not begin and end as"),
    "empty": (lambda data, _: cut(data, 0.0), r"000002.mcap: FAILED: it is empty"),
    "other gateway's file": (
        lambda data, other: shutil.copy(other / "fieldcal-000002.mcap", data),
        r"000002.mcap: FAILED: it is of site/other, the recording before it of site/gateway",
    ),
    "other gateway's head": (
        lambda data, other: shutil.copy(other / "head.json", data),
        r"head.json: FAILED: it is a head of site/other",
    ),
    "head of another directory": (
        lambda data, other: shutil.copy(other.parent / "twin" / "head.json", data),
        r"head.json: FAILED: (fieldcal-\d+.mcap does not begin with|it names recording)",
    ),
    "head changed": (
        lambda data, _: (data / "head.json").write_text((data / "head.json").read_text().replace("yes", "no")),
        r"head.json: FAILED: its signature was not made with this key, or its text was changed",
    ),
}


@pytest.mark.parametrize("kind", TAMPERED)
def test_it_names_what_was_tampered_with(
    kind: str, site: Path, recorded: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    tamper, told = TAMPERED[kind]
    tamper(site / "data", recorded / "other")
    status, failed = verify(site, capsys)
    if kind == "first dropped":  # retention does the same: the recordings say who deleted it, the script does not
        assert (status, failed) == (0, [])
        return
    assert status == 3
    assert any(re.search(told, line) for line in failed), failed


def test_a_hostile_file_takes_no_memory_and_no_control_of_the_terminal(
    site: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = site / "data" / "fieldcal-000002.mcap"
    chunk = struct.pack("<QQQI", 0, 0, 1 << 40, 0) + struct.pack("<I", 4) + b"zstd" + struct.pack("<Q", 4) + b"abcd"
    path.write_bytes(outsider.MAGIC + struct.pack("<BQ", 6, len(chunk)) + chunk + outsider.MAGIC)
    assert verify(site, capsys)[1][0].endswith(f"a chunk has {1 << 40} bytes decompressed")
    path.write_bytes(outsider.MAGIC + struct.pack("<BQ", 12, 1 << 62) + outsider.MAGIC)
    assert verify(site, capsys)[1][0].endswith("the record at byte 8 reaches beyond the end")
    outsider.say("\x1b[2J\u202e")
    assert capsys.readouterr().out == "\\x1b[2J\\u202e\n"


@pytest.mark.parametrize(
    ("arguments", "status", "told"),
    [
        ("", 2, "give two things"),
        ("unsigned", 2, "give two things: the gateway's public key"),
        ("no.pub unsigned", 2, "no.pub: not the gateway's public key: No such file or directory"),
        ("unsigned unsigned", 2, "unsigned: not the gateway's public key: Is a directory"),
        ("text unsigned", 2, "text: not the gateway's public key: it is no Ed25519 public key in PEM format"),
        ("private.key unsigned", 2, "it is no Ed25519 public key"),
        ("ec.pub unsigned", 2, "it is no Ed25519 public key"),
        ("gateway.pub unsigned", 3, "000001.mcap: FAILED: it is not signed: it was made without a signing key"),
        ("gateway.pub unsigned/fieldcal-000001.mcap", 3, "FAILED: it is not signed"),
        ("gateway.pub nowhere", 3, "nowhere: FAILED: no closed recording"),
        ("gateway.pub nowhere.mcap", 3, "nowhere.mcap: FAILED: No such file or directory"),
        ("gateway.pub empty", 3, "empty: FAILED: no closed recording"),
        ("gateway.pub open", 3, "open: FAILED: no closed recording"),
        ("gateway.pub text.mcap", 3, "text.mcap: FAILED: it does not begin and end as an MCAP file"),
        ("gateway.pub other.mcap", 3, "other.mcap: FAILED: its bytes cannot be understood"),
        ("gateway.pub unsigned --head text", 3, "text: FAILED: its bytes cannot be understood: JSONDecodeError"),
        ("gateway.pub unsigned --head no.json", 3, "no.json: FAILED: No such file or directory"),
    ],
)
def test_each_line_about_what_cannot_be_verified_is_clear(
    arguments: str,
    status: int,
    told: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    for name in ("unsigned", "empty", "open"):
        Path(name).mkdir()
    shutil.copy(UNSIGNED, "unsigned")
    shutil.copy(UNSIGNED, "open/fieldcal-000002.mcap.active")
    Path("gateway.pub").write_bytes(public_pem())
    Path("private.key").write_bytes(KEY.private_bytes(Encoding.PEM, PrivateFormat.PKCS8, NoEncryption()))
    other = generate_private_key(SECP256R1()).public_key()
    Path("ec.pub").write_bytes(other.public_bytes(Encoding.PEM, PublicFormat.SubjectPublicKeyInfo))
    for name in ("text", "text.mcap"):
        Path(name).write_text("not what it should be")
    Path("other.mcap").write_bytes(
        outsider.MAGIC + struct.pack("<BQ", 4, 0) + struct.pack("<BQ", 12, 3) + b"abc" + outsider.MAGIC
    )
    assert outsider.main(arguments.split()) == status
    output = capsys.readouterr()
    lines = (output.out + output.err).splitlines()
    assert len(lines) == (2 if "--head" in arguments else 1)
    assert told in lines[-1]


def commands(title: str) -> str:
    """The indented commands of the page under a line that begins with `title`."""
    after = PAGE.partition("### With openssl and sha256sum")[2].partition(title)[2]
    lines = after.partition("\n\n    ")[2].split("\n\n")[0].splitlines()
    return "\n".join(line.strip() for line in lines)


@pytest.mark.skipif(not (shutil.which("openssl") and shutil.which("sha256sum")), reason="needs openssl and sha256sum")
@pytest.mark.parametrize(
    ("what", "checked", "changed", "sums"),
    [
        ("The signature of a recording", "data/fieldcal-000002.mcap", b"gateway site/gateway", 2),
        ("The head", "data/head.json", b"gateway site/gateway", 1),
        ("A result", "result.signed", b"gateway site/gateway", 0),
    ],
)
def test_the_commands_of_the_page_verify_and_refuse(
    what: str, checked: str, changed: bytes, sums: int, site: Path
) -> None:
    with closing(sqlite3.connect(site / "data" / "state.sqlite")) as store:
        (data,) = store.execute("SELECT data FROM signed ORDER BY sequence DESC LIMIT 1").fetchone()
    (site / "result.signed").write_bytes(data)

    def run() -> subprocess.CompletedProcess[str]:
        script = f"set -eu\n{commands(what)}"
        return subprocess.run(["bash", "-c", script], cwd=site, capture_output=True, text=True, check=False)

    done = run()
    assert done.returncode == 0, done.stdout + done.stderr
    assert "Signature Verified Successfully" in done.stdout
    assert done.stdout.count(": OK") == sums
    path = site / checked
    path.write_bytes(path.read_bytes().replace(changed, changed[:-1] + b"z"))
    assert "Signature Verification Failure" in run().stdout + run().stderr
