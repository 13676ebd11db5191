"""Hostile and odd streams of heads: the witness goes by its own clock, its disk is bounded, and real heads are kept."""

from __future__ import annotations

import hashlib
import itertools
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

from agent.recording.head import Head
from agent.recording.signing import SignedStatement, Signer
from agent.recording.witness import DAY_NS, GATEWAYS_MAX, PROOFS_MAX, ChainWitness, HeadFile
from tests.attacks.chain_site import KEY, known

OWN = Ed25519PrivateKey.from_private_bytes(bytes(32))  # the witness's
GATEWAY, OTHER = "site/gateway", "site/other"
SECOND_NS, YEAR_NS = 1_000_000_000, 365 * DAY_NS
NOW_NS = 1_790_000_000 * SECOND_NS
LINE = 1000  # bytes that a line has at most, with heads as they are here
AT_ONCE_BYTES, A_DAY_BYTES = 32 << 10, 64 << 10  # an eighth of what is allowed, so that less must be sent


def head(
    number: int, length: int, *, gateway: str = GATEWAY, closed: bool = False, utc_ns: int = NOW_NS,
    content: str = "", epoch: str = "00c0ffee00c0ffee", history: str = "", key: Ed25519PrivateKey = KEY,
) -> bytes:  # fmt: skip
    """A head as a gateway signs it. `history`: in another one, recordings begin and go on in another way."""
    digests = [
        hashlib.sha256(f"{part} {number} {history}".encode()).hexdigest() for part in ("begin", f"{length}{content}")
    ]
    statement = SignedStatement(gateway, epoch, number, "", "1 " + "0" * 64, length, digests[1])
    return Signer(key).sign(Head(statement, f"100 {digests[0]}", closed, utc_ns).text).json


class Machine:
    """A witness with its disk and its clock."""

    def __init__(self, directory: Path, *, listed: bool = False) -> None:
        self.directory, self.now_ns = directory, NOW_NS
        self.keys = (lambda: known(KEY)) if listed else None
        directory.mkdir(exist_ok=True)
        self.start()

    def start(self) -> None:
        self.witness = ChainWitness(self.directory, Signer(OWN), self.keys, lambda: self.now_ns)

    def take(self, data: bytes, gateway: str = GATEWAY, after_s: float = 0.0) -> tuple[bool, str]:
        self.now_ns += int(after_s * SECOND_NS)
        return self.witness.take(gateway, data)

    def lines(self, gateway: str = GATEWAY) -> int:
        return (self.directory / f"{gateway}.heads").read_bytes().count(b"\n")

    def file(self) -> HeadFile:
        """The file of the gateway, as an audit reads it."""
        return HeadFile(self.directory / f"{GATEWAY}.heads", OWN.public_key())

    def proofs(self) -> int:
        return len(self.file().contradictions)

    def bytes_of(self, gateway: str = GATEWAY) -> int:
        return (self.directory / f"{gateway}.heads").stat().st_size


@pytest.fixture(autouse=True)
def _small_allowance(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("agent.recording.witness.AT_ONCE_BYTES", AT_ONCE_BYTES)
    monkeypatch.setattr("agent.recording.witness.A_DAY_BYTES", A_DAY_BYTES)


@pytest.fixture
def machine(tmp_path: Path) -> Machine:
    return Machine(tmp_path / "kept")


@pytest.mark.parametrize("step_ns", [YEAR_NS, -60 * SECOND_NS, 0])
def test_the_clock_of_a_gateway_does_not_count(machine: Machine, step_ns: int) -> None:
    """Its clock jumps by a year at each head, runs backwards, or stands still; here an hour passes."""
    for minute in range(61):
        machine.take(head(1, 1000 + minute, utc_ns=NOW_NS + minute * step_ns), after_s=60)
    assert machine.lines() == 7


@pytest.mark.parametrize("step_ns", [-2 * YEAR_NS, 2 * YEAR_NS])
def test_the_clock_of_the_witness_is_set(machine: Machine, step_ns: int) -> None:
    """The hour after it is kept as the hour before, and a gateway gains what is allowed at once, and no more."""
    for minute in range(61):
        machine.take(head(1, 1000 + minute), after_s=60)
    machine.now_ns += step_ns
    machine.start()
    for minute in range(61, 122):
        machine.take(head(1, 1000 + minute), after_s=60)
    assert machine.lines() == 7 + 7
    for n in range(2, 100):
        machine.take(head(n, 1, closed=True), after_s=0.001)
    assert machine.bytes_of() < AT_ONCE_BYTES + 14 * LINE
    assert machine.take(head(100, 1), after_s=3600)[0], "the allowance grows by the new clock"


@pytest.mark.parametrize(("listed", "closed"), [(False, False), (True, True)])
def test_a_head_each_millisecond_costs_its_gateway_alone(tmp_path: Path, listed: bool, closed: bool) -> None:
    machine = Machine(tmp_path / "kept", listed=listed)
    for n in range(1, 100):
        machine.take(head(n, n, closed=closed), after_s=0.001)
        if n % 30 == 0:
            machine.start()  # also over a restart
    assert AT_ONCE_BYTES < machine.bytes_of() < AT_ONCE_BYTES + LINE
    assert machine.take(head(1, 1, gateway=OTHER), OTHER)[0]
    for n in range(100, 388):
        machine.take(head(n, n, closed=closed), after_s=300)
    assert AT_ONCE_BYTES + A_DAY_BYTES - LINE < machine.bytes_of() < AT_ONCE_BYTES + A_DAY_BYTES + LINE
    assert machine.take(head(388, 1), after_s=1200)[0], "it is kept again when its allowance has grown"


def test_invented_gateways_fill_no_disk_and_keep_no_real_one_out(
    machine: Machine, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("agent.recording.witness.GATEWAYS_MAX", 20)
    for hour in range(25):
        assert machine.take(head(hour + 1, 10, closed=True), after_s=3600)[0]
    stranger = Ed25519PrivateKey.generate()
    for n in range(200):
        name = f"site{n}/gateway"
        machine.take(head(1, 1, gateway=name, key=stranger), name, after_s=0.001)
    files = list(machine.directory.glob("*/*.heads"))
    assert len(files) == 20
    assert len(list(machine.directory.iterdir())) == 20, "no empty directories of sites are left"
    assert sum(path.stat().st_size for path in files) < (25 + 20) * LINE
    assert machine.take(head(99, 1), after_s=60)[0], "who was heard for a day stays"
    for minute in range(60):
        machine.take(head(1, 1 + minute, gateway=OTHER), OTHER, after_s=60)
        name = f"more{minute}/gateway"
        if minute > 12:
            machine.take(head(1, 1, gateway=name, key=stranger), name)
    assert machine.lines(OTHER) == 6, "who begins now displaces one that was heard for a shorter time, and stays"
    assert machine.lines() == 26


def test_who_was_heard_for_a_day_makes_no_place(machine: Machine) -> None:
    names = [f"site/real{n}" for n in range(GATEWAYS_MAX)]
    for name in names:
        machine.take(head(1, 1, gateway=name), name)
    machine.now_ns += DAY_NS
    for name in names:
        machine.take(head(1, 2, gateway=name), name)
    machine.start()
    taken, said = machine.take(head(1, 1))
    assert (taken, "heads of 100 gateways are kept already; a list of keys" in said) == (False, True)
    machine.keys = lambda: known(KEY)
    machine.start()
    assert machine.take(head(1, 1))[0], "a listed key has a place"


def test_a_recording_that_is_closed_again_and_again(machine: Machine) -> None:
    for n in range(120):
        machine.take(head(1, 1000 + n, closed=n % 2 == 0), after_s=0.001)
    assert machine.bytes_of() < AT_ONCE_BYTES + 2 * LINE
    assert machine.proofs() == 1


@pytest.mark.parametrize("spent", [False, True])
def test_two_contents_of_one_place_are_proven(machine: Machine, spent: bool) -> None:
    """Also where the first of the two heads was not worth a line, and where the allowance is spent."""
    machine.take(head(1, 1))
    for n in range(2, 60 if spent else 2):
        machine.take(head(n, 1, closed=True), after_s=0.001)
    number, lines = 100 if spent else 1, machine.lines()
    assert machine.take(head(number, 500, content="one"), after_s=60) == (False, "")
    taken, said = machine.take(head(number, 500, content="two"), after_s=1)
    assert (taken, "PROOF of two histories" in said) == (True, True)
    assert machine.lines() == lines + 2, "both heads are there, so that the file alone proves it"
    machine.start()
    assert machine.proofs() == 1
    assert not machine.take(head(number, 500, content="two"))[0], "once is enough"


def test_proofs_are_bounded_and_a_lost_directory_is_witnessed_on(machine: Machine) -> None:
    """The same key begins again at recording 1: each is a proof, and after some of them ordinary heads are kept."""
    for n in range(1, 41):
        machine.take(head(n, 10, closed=True), after_s=3600)
    lines = machine.lines()
    for n in range(1, 41):
        machine.take(head(n, 10, closed=True, epoch="1" * 16, history="other"), after_s=3600)
        machine.take(head(n, 9, closed=True, history=f"more{n}"))  # older ones of the first epoch
    assert machine.lines() == lines + 40
    assert machine.proofs() == PROOFS_MAX


def test_old_heads_that_a_stranger_sends_again_hold_no_new_one_back(machine: Machine) -> None:
    sent = [head(1, 1000 + minute) for minute in range(61)]
    for minute, data in enumerate(sent):
        machine.take(sent[minute * 2 // 3], after_s=30)  # older ones, of which none was kept
        machine.take(data, after_s=30)
    assert machine.file().newest_of_each[1][1].head.statement.length == 1060
    assert machine.lines() == 7


@pytest.mark.parametrize("name", ["witness.key/a", "witness.pub/a", "notes/a"])
def test_a_site_with_the_name_of_a_file_is_refused(machine: Machine, name: str) -> None:
    (machine.directory / name.partition("/")[0]).write_text("kept")
    taken, said = machine.take(head(1, 1, gateway=name), name)
    assert (taken, "is a file of this machine" in said) == (False, True)
    assert machine.take(head(1, 1))[0]


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    place = tmp_path / "disk"
    place.mkdir()
    if subprocess.run(
        ["mount", "-t", "tmpfs", "-o", "size=64k", "tmpfs", place], capture_output=True, check=False
    ).returncode:
        pytest.skip("no right to mount a file system")
    yield place
    subprocess.run(["umount", place], check=True)


def test_a_full_disk_loses_what_finds_no_place_and_nothing_else(small_disk: Path) -> None:
    machine = Machine(small_disk)
    numbers = itertools.count(1)

    def fill() -> None:
        while machine.take(head(next(numbers), 1), after_s=3600)[0]:
            pass

    with pytest.raises(OSError, match="No space left"):
        fill()
    whole = (small_disk / f"{GATEWAY}.heads").read_bytes()
    assert whole.endswith(b"\n")
    with pytest.raises(OSError, match="No space left"):
        machine.take(head(1, 1, gateway="new/gateway"), "new/gateway")
    assert not (small_disk / "new").exists()
    subprocess.run(["mount", "-o", "remount,size=128k", small_disk], check=True)
    assert machine.take(head(next(numbers), 1), after_s=3600)[0]
    assert machine.take(head(1, 1, gateway="new/gateway"), "new/gateway")[0]
    machine.start()
    assert machine.lines() == whole.count(b"\n") + 1, "every line is whole"
