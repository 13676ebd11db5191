"""The audit of several recordings: deleted by retention or missing without reason, left by a crash, and signed."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from click.testing import CliRunner
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
from cryptography.hazmat.primitives.asymmetric.x25519 import X25519PrivateKey
from cryptography.hazmat.primitives.serialization import Encoding, NoEncryption, PrivateFormat, PublicFormat

from agent.audit.engines import Engines
from agent.cli.audit import audit, audit_files, run_audit
from agent.cli.given import recordings_of
from agent.config.key_file import KeyFileError
from agent.config.known_keys import KnownKeys
from agent.delivery.store import Store
from agent.recording.files import recordings
from agent.recording.retention import KeepFiles
from agent.recording.signing import Signer, load_public_key
from agent.recording.writer import Recorder
from tests.replay.forgery import records, with_sums
from tests.replay.stand_in import CONFIG, StandIn, happenings, run_start

ROTATE_EACH = 9  # events
FILES = 5


def write_keys(directory: Path) -> tuple[Path, Path]:
    """(private, public) key files."""
    key = Ed25519PrivateKey.generate()
    private, public = directory / "gateway.key", directory / "gateway.pub"
    private.write_bytes(key.private_bytes(Encoding.PEM, PrivateFormat.PKCS8, NoEncryption()))
    private.chmod(0o600)
    public.write_bytes(key.public_key().public_bytes(Encoding.PEM, PublicFormat.SubjectPublicKeyInfo))
    return private, public


def record(directory: Path, *, keep: KeepFiles | None = None, signer: Signer | None = None) -> list[bytes]:
    """Record a run of five files, with a store beside them and the retention limits `keep`; give its heads."""
    store, heads = Store(directory, 0), list[bytes]()
    recorder = Recorder(
        directory, ["acc", "ref"], ["bridge-1"], keep=keep or KeepFiles(), ledger=store, signer=signer,
        tell_head=heads.append,
    )  # fmt: skip
    pipeline = StandIn(CONFIG)
    number = 0
    for event in happenings(4 * FILES, seed=1):
        if number % ROTATE_EACH == 0:
            start = run_start(pipeline, number, recorder.next_file_sequence, event.t_monotonic_ns)
            recorder.record(number, start, pipeline.step(start))
            recorder.look_for_pruning()
            number += 1
            if (pruned := recorder.pruning) is not None:
                recorder.record(number, pruned, pipeline.step(pruned))
                number += 1
        recorder.record(number, event, pipeline.step(event))
        number += 1
    recorder.close()
    store.close()
    return heads


def names(directory: Path) -> list[int]:
    return [number for number, _ in recordings(directory)]


def listed(public: Path) -> KnownKeys:
    """A list of this key alone, which counts for every gateway."""
    return KnownKeys(anywhere=(load_public_key(public).public_bytes_raw(),))


def said(directory: Path, **options: object) -> tuple[int, str]:
    return said_of([directory], **options)


def said_of(paths: list[Path], **options: object) -> tuple[int, str]:
    runner = CliRunner()
    with runner.isolation() as (out, _, _):
        status = run_audit(recordings_of(paths), Engines(StandIn.restore), as_json=False, **options)  # type: ignore[arg-type]
        return status, out.getvalue().decode()


def size(directory: Path, count: int) -> int:
    return sum(path.stat().st_size for _, path in recordings(directory)[:count])


@pytest.fixture
def limit(tmp_path_factory: pytest.TempPathFactory) -> KeepFiles:
    """Retention limits that leave about two of the files."""
    directory = tmp_path_factory.mktemp("size")
    record(directory)
    return KeepFiles(bytes=int(size(directory, FILES) * 2.5 / FILES))


def test_a_whole_directory_passes(tmp_path: Path) -> None:
    record(tmp_path)
    status, text = said(tmp_path)
    assert (status, text.count(": passed")) == (0, len(names(tmp_path))), text
    assert len(names(tmp_path)) >= FILES


def test_what_retention_deleted_is_no_theft(tmp_path: Path, limit: KeepFiles) -> None:
    record(tmp_path, keep=limit)
    left = names(tmp_path)
    assert left[0] > 1, "retention had something to do"
    status, text = said(tmp_path)
    assert status == 0, text


def test_what_was_taken_is_missed(tmp_path: Path, limit: KeepFiles) -> None:
    record(tmp_path, keep=limit)
    left = recordings(tmp_path)
    taken = left[1][1]
    content = taken.read_bytes()
    for index, words in ((0, "missing before it"), (1, "missing before it"), (-1, "missing at the end")):
        path = left[index][1]
        content = path.read_bytes()
        path.unlink()
        status, text = said(tmp_path)
        assert status == 3, index
        assert f"recording {left[index][0]} is {words}" in text, index
        path.write_bytes(content)
    assert said(tmp_path)[0] == 0


def test_a_file_in_the_place_of_the_last_deleted_is_seen(tmp_path: Path, limit: KeepFiles) -> None:
    record(tmp_path, keep=limit)
    files = [path for _, path in recordings(tmp_path)]
    (file,) = audit_files(recordings_of(files[-1:]), Engines(StandIn.restore))
    pruned = file.replay.pruned[-1]
    assert pruned.last_file + 1 == names(tmp_path)[0]
    first = files[0]
    data = first.read_bytes()
    at = data.index(b"previous_sha256") + len(b"previous_sha256") + 4
    other = b"0" if data[at : at + 1] != b"0" else b"1"
    first.write_bytes(with_sums(data[:at] + other + data[at + 1 :]))
    status, text = said(tmp_path)
    assert status == 3
    assert f"the SHA-256 of the deleted recording {pruned.last_file} is not the one that this recording names" in text


def test_neighbours_of_two_runs_are_held_against_each_other(tmp_path: Path) -> None:
    record(tmp_path)
    last = recordings(tmp_path)[-1][1]
    record(tmp_path)
    assert said(tmp_path)[0] == 0
    other = tmp_path / "other"
    other.mkdir()
    record(other, signer=Signer(Ed25519PrivateKey.generate()))
    (other / last.name).rename(last)
    status, text = said(tmp_path)
    assert status == 3
    assert f"{last} is not the file that this one names as the one before it: its SHA-256 differs" in text


def test_a_file_closed_after_a_crash_passes_and_is_counted(tmp_path: Path) -> None:
    record(tmp_path)
    path = recordings(tmp_path)[-1][1]
    data = path.read_bytes()
    *_, last = [r for r in records(data) if r.name == "Chunk"]
    path.unlink()
    path.with_name(path.name + ".active").write_bytes(data[: last.offset + 20])
    assert said(tmp_path)[0] == 3
    recorder = Recorder(tmp_path, [], [])
    recorder.close_torn()
    status, text = said(tmp_path)
    assert status == 0, text
    assert "note: unsealed: left open by a crash, closed later; the last 20 bytes, incomplete, were set aside" in text
    assert said(tmp_path, strict=True)[0] == 3
    runner = CliRunner()
    with runner.isolation() as (out, _, _):
        assert run_audit(recordings_of([tmp_path]), Engines(StandIn.restore), as_json=True) == 0
        assert json.loads(out.getvalue())["unsealed"] == 1


def test_signatures_are_required_with_a_key(tmp_path: Path) -> None:
    private, public = write_keys(tmp_path)
    data = tmp_path / "data"
    data.mkdir()
    record(data, signer=Signer.load(private))
    status, text = said(data, keys=listed(public))
    assert status == 0, text
    assert said(data)[0] == 0
    other = listed(write_keys(tmp_path)[1])
    status, text = said(data, keys=other)
    assert (status, text.count("signed with the key")) == (3, len(names(data)) + 1)  # the files and the head
    unsigned = tmp_path / "unsigned"
    unsigned.mkdir()
    record(unsigned)
    status, text = said(unsigned, keys=other)
    assert (status, text.count("no signature in this file")) == (3, len(names(unsigned)))


def torn(data: Path, lost: int = 3000) -> Path:
    """The newest recording as a crash leaves it."""
    path = recordings(data)[-1][1]
    left = path.with_name(path.name + ".active")
    left.write_bytes(path.read_bytes()[:-lost])
    path.unlink()
    return left


def test_a_file_closed_after_a_crash_is_signed_then(tmp_path: Path) -> None:
    private, public = write_keys(tmp_path)
    data = tmp_path / "data"
    data.mkdir()
    heads = record(data, signer=Signer.load(private))
    torn(data)
    (data / "head.json").write_bytes(heads[-2])  # of its beginning; the last one is of the closed file
    Recorder(data, [], [], signer=Signer.load(private)).close_torn()
    status, text = said(data, keys=listed(public))
    assert status == 0, text
    assert text.count("unsealed") == 1


def test_an_open_file_that_the_gateway_did_not_begin_is_not_signed(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """Whoever writes in the directory while the agent is stopped would have its key under whatever he likes."""
    private, public = write_keys(tmp_path)
    data, other = tmp_path / "data", tmp_path / "other"
    data.mkdir()
    other.mkdir()
    heads = record(data, signer=Signer.load(private))
    record(other)
    last = names(data)[-1]
    genuine = torn(data).read_bytes()
    forged = torn(other).read_bytes()
    for content, head, reason in (
        (forged, heads[-2], "its beginning is not the one that the gateway signed"),
        (forged, heads[0], "no head beside it names it"),
        (genuine, b"", "no head beside it names it"),
    ):
        (data / f"fieldcal-{last:06d}.mcap.active").write_bytes(content)
        (data / "head.json").write_bytes(head)
        Recorder(data, [], [], signer=Signer.load(private)).close_torn()
        assert reason in caplog.text
        status, text = said(data, keys=listed(public))
        assert status == 3
        assert "no signature in this file" in text or "unsigned data follow its signature" in text, text
        assert f"the gateway did not sign it then: {reason}" in text
        caplog.clear()
        (data / f"fieldcal-{last:06d}.mcap").unlink()


def test_every_signed_byte_counts_though_the_sums_fit(tmp_path: Path) -> None:
    private, public = write_keys(tmp_path)
    data = tmp_path / "data"
    data.mkdir()
    record(data, signer=Signer.load(private))
    path = recordings(data)[0][1]
    whole, keys = path.read_bytes(), listed(public)
    signature = next(r for r in records(whole) if r.name == "Metadata" and b"fieldcal.signature" in r.body)
    at = whole.index(b"file_sequence")
    forgeries = {
        "signed byte": (whole[:at] + b"F" + whole[at + 1 :], "its signature is of other bytes"),
        "signature": (
            whole[: signature.end - 9] + bytes([whole[signature.end - 9] ^ 1]) + whole[signature.end - 8 :],
            "its signature was not made with this key",
        ),
        "length": (whole.replace(b"bytes\x04", b"bytes\x05"), "signature"),
    }
    for name, (forged, words) in forgeries.items():
        if forged == whole:
            continue
        path.write_bytes(with_sums(forged))
        status, text = said_of([path], keys=keys)
        assert status == 3, name
        assert words in text, (name, text)
    path.write_bytes(with_sums(whole))
    assert said_of([path], keys=keys)[0] == 0


@pytest.mark.parametrize("content", ["", "-----BEGIN PRIVATE KEY-----\nrubbish\n-----END PRIVATE KEY-----\n"])
def test_a_file_that_is_no_key_is_one_clear_line(tmp_path: Path, content: str) -> None:
    path = tmp_path / "key"
    path.write_text(content)
    makes = "`openssl genpkey -algorithm ed25519` makes one"
    with pytest.raises(KeyFileError, match=f"^{path}: not a private key in PEM without a password; {makes}$"):
        Signer.load(path)
    with pytest.raises(KeyFileError, match=f"^{path}: not a public key in PEM$"):
        load_public_key(path)
    with pytest.raises(KeyFileError, match="cannot be read: No such file"):
        Signer.load(tmp_path / "gone")
    other = X25519PrivateKey.generate().private_bytes(Encoding.PEM, PrivateFormat.PKCS8, NoEncryption())
    path.write_bytes(other)
    with pytest.raises(KeyFileError, match="but not an Ed25519 key"):
        Signer.load(path)


def test_the_command_refuses_what_is_no_key(tmp_path: Path) -> None:
    (tmp_path / "key").write_text("x")
    done = CliRunner().invoke(audit, [str(tmp_path), "--public-key", str(tmp_path / "key")], standalone_mode=False)
    assert done.return_value == 2
    assert done.stderr == f"{tmp_path / 'key'}: not a public key in PEM\n"
