"""`fieldcal audit`: checks that every byte of a recording is as written and that its results follow from its data."""

from __future__ import annotations

import hashlib
import time
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import click
import msgspec

from agent.cli.given import Given, add_witnessed, read_head, recordings_of
from agent.delivery.history import StoreError
from agent.recording.chain import Link, chain_faults, missing_after
from agent.recording.comparison import OTHER_CPU
from agent.recording.end_check import check_end
from agent.recording.head import HEAD_NAME
from agent.recording.integrity import Integrity, check_integrity
from agent.recording.pruned_ranges import PRUNED_METADATA, Ranges, from_metadata, merged
from agent.recording.reading import open_recording
from agent.recording.records import Fault
from agent.recording.repair import REPAIR_METADATA
from agent.recording.replaying import Replay, ReplayedFile, Restore
from agent.recording.result_check import check_results
from agent.recording.results_chain import EPOCH, FILE_METADATA, PREVIOUS_RESULTS
from agent.recording.set_aside import deleted as statements
from agent.recording.signing import SIGNATURE_METADATA, Statement, signed_results, verify_file
from agent.terminal.text import say

if TYPE_CHECKING:
    from agent.config.known_keys import KnownKeys


class AuditedFile(msgspec.Struct, kw_only=True):
    """The verdict on one file. `reasons` why it failed, empty where it passed; `notes`: what could not be decided."""

    path: str
    ok: bool
    incomplete: bool
    repaired: bool  # a crash left it open, and a later start closed it
    reasons: list[str]
    notes: list[str]
    size: int
    sha256: str
    good_bytes: int
    faults: list[Fault]  # the first ones of `fault_count` faults
    fault_count: int
    chunks: int
    messages: int
    signed_results: int = 0  # results with a valid signature of their own
    replay: ReplayedFile


@click.command()
@click.argument("files", nargs=-1, required=True, type=click.Path(path_type=Path), metavar="FILE.mcap...")
@click.option(
    "--public-key", metavar="K", type=click.Path(path_type=Path), help="Require signatures by this key (PEM)."
)
@click.option(
    "--keys", "known_keys", metavar="F", type=click.Path(path_type=Path),
    help="Require signatures by the keys that this list (`fieldcal keys`) has for each gateway; revoked ones fail.",
)  # fmt: skip
@click.option(
    "--head", "heads", multiple=True, metavar="F", type=click.Path(path_type=Path),
    help="A head of the recordings that was kept elsewhere: no recording up to it may be missing.",
)  # fmt: skip
@click.option(
    "--witness", metavar="DIR", type=click.Path(path_type=Path),
    help="The directory of `fieldcal witness`, with the heads that it kept of this gateway.",
)  # fmt: skip
@click.option("--strict", is_flag=True, help="Fail also for repaired files, and for files of another CPU or version.")
@click.option("--json", "json_to", type=click.Choice(["-"]), help="Print one JSON object on standard output.")
def audit(
    files: tuple[Path, ...],
    public_key: Path | None,
    known_keys: Path | None,
    heads: tuple[Path, ...],
    witness: Path | None,
    strict: bool,
    json_to: str | None,
) -> int:
    """Check recordings, given in order: every byte, whether results follow from the data, whether a file is missing.

    Give a data directory instead of files to check all its recordings; then no recording may be missing. Exit status: 0
    all passed, 3 a check failed, 2 a file cannot be read. The end of the output says what cannot be proven.
    """
    from agent.config.key_file import KeyFileError
    from agent.core.pipeline import Pipeline
    from agent.recording.fingerprint import compute_as
    from agent.recording.reading import first_event
    from agent.recording.signed_text import SignedTextError
    from agent.recording.witness import WitnessError

    try:
        keys = _known(public_key, known_keys)
        given = recordings_of(files)
        given.heads.extend(read_head(path) for path in heads)
        if witness is not None:
            add_witnessed(given, witness)
    except (KeyFileError, StoreError, SignedTextError, WitnessError) as error:
        say(str(error), err=True)
        return 2
    except OSError as error:
        say(f"{error.filename}: {error.strerror}", err=True)
        return 2
    if not given.paths and not given.up_to:
        # Where the store knows of recordings that are gone, the audit itself reports them.
        say(f"{files[0]}: this directory has no recordings (fieldcal-*.mcap)", err=True)
        return 2
    start = first_event(given.paths[0]) if given.paths else None
    if start is not None:
        compute_as(start.fingerprint)
    return run_audit(given, Pipeline.restore, as_json=json_to is not None, strict=strict, keys=keys)


def _known(public_key: Path | None, known_keys: Path | None) -> KnownKeys | None:
    """The keys of the options; None where neither is given. Raises KeyFileError."""
    from agent.config.known_keys import KnownKeys, read_known_keys
    from agent.recording.signing import load_public_key

    if public_key is None and known_keys is None:
        return None
    listed = read_known_keys(known_keys) if known_keys is not None else KnownKeys()
    anywhere = (load_public_key(public_key).public_bytes_raw(),) if public_key is not None else ()
    return replace(listed, anywhere=anywhere)


def run_audit(
    given: Given, restore: Restore, *, as_json: bool, strict: bool = False, keys: KnownKeys | None = None
) -> int:
    """Audit, print, and return the exit status. With `keys`, files must be signed by a key of their gateway."""
    try:
        audited, links, deleted = _audited(given, restore, strict=strict, keys=keys)
        end = check_end(given.heads, links, deleted, keys, time.time_ns())
        end.reasons += given.faults
    except OSError as error:
        say(f"{error.filename}: {error.strerror}", err=True)
        return 2
    if strict and keys is not None and not given.heads and links[-1:] and links[-1].signed_results is not None:
        end.reasons.append(f"there is no {HEAD_NAME} beside signed recordings, and none was given (--head, --witness)")
    lost = missing_after(links, given.up_to or 0, deleted)
    ok = not lost and not end.reasons and all(file.ok for file in audited)
    if as_json:
        undecidable = sum(file.replay.undecidable for file in audited)
        unsealed = sum(file.repaired for file in audited)
        counted = {"undecidable": undecidable, "unsealed": unsealed}
        verdict = {"ok": ok, **counted, "missing": lost, "end": end, "files": audited}
        click.echo(msgspec.json.encode(verdict).decode())
    else:
        for file in audited:
            for line in describe(file):
                say(line)
        if lost:
            say(f"FAILED: {lost}")
        for line in end.describe():
            say(line)
    return 0 if ok else 3


def audit_files(
    given: Given, restore: Restore, *, strict: bool = False, keys: KnownKeys | None = None
) -> list[AuditedFile]:
    """The verdict on each file. Each file is also compared with the one before it. Raises OSError."""
    return _audited(given, restore, strict=strict, keys=keys)[0]


def _audited(
    given: Given, restore: Restore, *, strict: bool, keys: KnownKeys | None
) -> tuple[list[AuditedFile], list[Link], Ranges]:
    """(the verdicts, the links of the chain, the file numbers that retention deleted)."""
    from agent.recording.fingerprint import fingerprint

    replayed = Replay(restore, fingerprint(), elsewhere=OTHER_CPU)
    audited: list[AuditedFile] = []
    links: list[Link] = []
    said: list[tuple[int, int]] = []  # recordings that retention deleted
    with ExitStack() as held:  # kept open to the end, so that retention deletes none meanwhile
        files = [held.enter_context(open_recording(path)) for path in given.paths]
        for path, file in zip(given.paths, files, strict=True):
            sha256 = hashlib.file_digest(file, "sha256").hexdigest()
            size = file.tell()
            file.seek(0)
            integrity = check_integrity(file, size)
            verdict = _verdict(path, sha256, size, integrity, replayed.run(path))
            fault = ""
            if keys is not None:
                signature = integrity.metadata.get(SIGNATURE_METADATA)
                fault = verify_file(file, size, signature, keys, _statement(verdict, integrity))
                verdict.reasons += [fault] if fault else []
            results = check_results(path, verdict.replay.gateway, None if fault else keys)
            verdict.signed_results = results.signed
            if results.fault:
                verdict.reasons.append(
                    f"{results.faults} results without a valid signature; the first: {results.fault}"
                )
            if strict:
                verdict.reasons += verdict.notes
            audited.append(verdict)
            links.append(_link(verdict, integrity))
            said += from_metadata(integrity.metadata.get(PRUNED_METADATA))
    pruned = [event for verdict in audited for event in verdict.replay.pruned]
    if given.directory is not None:
        gateway = next((link.gateway for link in links if link.gateway), "")
        said += statements(given.directory, gateway, keys)[0]
    gone = merged([*said, *((event.first_file, event.last_file) for event in pruned)])
    for index, fault in chain_faults(links, pruned, gone, from_first=given.up_to is not None):
        audited[index].reasons.append(fault)
    for verdict in audited:
        verdict.ok = not verdict.reasons
    return audited, links, gone


def _verdict(path: Path, sha256: str, size: int, integrity: Integrity, replay: ReplayedFile) -> AuditedFile:
    repair = integrity.metadata.get(REPAIR_METADATA)
    notes = list(replay.notes)
    if repair is not None:
        torn = repair.get("torn_bytes")
        notes.append(f"unsealed: left open by a crash, closed later; the last {torn} bytes, incomplete, were set aside")
    return AuditedFile(
        path=str(path),
        ok=False,
        incomplete=not integrity.finished and all(fault.kind == "torn" for fault in integrity.faults),
        repaired=repair is not None,
        reasons=_reasons(integrity, replay) + _metadata_reasons(integrity, replay),
        notes=notes,
        size=size,
        sha256=sha256,
        good_bytes=integrity.good_bytes,
        faults=integrity.faults,
        fault_count=integrity.fault_count,
        chunks=integrity.chunks,
        messages=integrity.messages,
        replay=replay,
    )


def _statement(verdict: AuditedFile, integrity: Integrity) -> Statement:
    """What the signature of a file must say of it; its content is hashed when the signature is checked."""
    origin, replay = integrity.metadata.get(FILE_METADATA, {}), verdict.replay
    epoch, previous_sha256 = origin.get(EPOCH, ""), origin.get("previous_sha256", "")
    return Statement(replay.gateway, epoch, replay.file_sequence, previous_sha256, integrity.results.text, 0, "")


def _link(verdict: AuditedFile, integrity: Integrity) -> Link:
    return Link(
        path=verdict.path,
        gateway=verdict.replay.gateway,
        file_sequence=verdict.replay.file_sequence,
        sha256=verdict.sha256,
        incomplete=verdict.incomplete,
        repaired=verdict.repaired,
        previous_sha256=integrity.metadata.get(FILE_METADATA, {}).get("previous_sha256", ""),
        previous_results=integrity.metadata.get(FILE_METADATA, {}).get(PREVIOUS_RESULTS, ""),
        signed_results=signed_results(integrity.metadata.get(SIGNATURE_METADATA)),
    )


def _reasons(integrity: Integrity, replay: ReplayedFile) -> list[str]:
    reasons = []
    for fault in integrity.faults:
        incomplete = f"incomplete, last good byte {integrity.good_bytes}: " if fault.kind == "torn" else ""
        reasons.append(f"{incomplete}{fault}")
    if integrity.fault_count > len(integrity.faults):
        reasons.append(f"{integrity.fault_count - len(integrity.faults)} more faults")
    if replay.fault is not None and not integrity.faults:
        reasons.append(str(replay.fault))
    if replay.refused:
        reasons.append(f"cannot be replayed: {replay.refused}")
    if replay.first_difference is not None:
        reasons.append(f"the results do not follow from the data: {replay.first_difference}")
    if replay.undecidable:
        reasons.append(
            "not decided: a decision is so close that this CPU takes another one than was recorded, so what follows in "
            "this file is not checked; audit the file on a CPU like the one that recorded it"
        )
    if replay.different > 1:
        reasons.append(f"results differ after {replay.different} events")
    if not replay.events:
        reasons.append("it holds no events")
    return reasons


def _metadata_reasons(integrity: Integrity, replay: ReplayedFile) -> list[str]:
    """The contradictions between a file's events and its own metadata."""
    metadata = integrity.metadata.get(FILE_METADATA)
    if metadata is None:
        return [f"no metadata record {FILE_METADATA}"] if replay.events else []
    if replay.events and metadata.get("file_sequence") != str(replay.file_sequence):
        return [f"its metadata says file number {metadata.get('file_sequence')}, its RunStart {replay.file_sequence}"]
    return []


def describe(file: AuditedFile) -> list[str]:
    """The verdict as text: one line, and one more line for each reason and note."""
    replay = file.replay
    how = f"equal within {replay.tolerance:g}" if replay.tolerance else "equal bit for bit"
    verdict = f"passed, {replay.results} results {how}" if file.ok else "FAILED"
    lines = [f"{file.path}: {verdict}; {file.size} bytes, {file.chunks} chunks, {replay.events} events replayed"]
    lines[0] += f", {file.signed_results} results signed" if file.signed_results else ""
    lines += [f"  {reason}" for reason in file.reasons]
    lines += [f"  note: {note}" for note in file.notes if note not in file.reasons]
    return lines
