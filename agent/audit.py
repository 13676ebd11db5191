"""`fieldcal audit`: is every byte of a recording as it was written, and do its results follow from its data?"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from pathlib import Path

import click
import msgspec

from agent.recording.comparison import OTHER_CPU
from agent.recording.files import FILE_METADATA
from agent.recording.integrity import Integrity, check_integrity
from agent.recording.reading import open_recording
from agent.recording.records import Fault
from agent.recording.replaying import Replay, ReplayedFile, Restore


class AuditedFile(msgspec.Struct, kw_only=True):
    """The verdict on one file. `reasons` is empty where it passed; `notes` say what could not be decided."""

    path: str
    ok: bool
    incomplete: bool
    reasons: list[str]
    notes: list[str]
    size: int
    sha256: str
    good_bytes: int
    faults: list[Fault]  # the first of `fault_count`
    fault_count: int
    chunks: int
    messages: int
    replay: ReplayedFile


@click.command()
@click.argument("files", nargs=-1, required=True, type=click.Path(path_type=Path), metavar="FILE.mcap...")
@click.option("--public-key", type=click.Path(path_type=Path), help="Require a signature by this key.")
@click.option("--strict", is_flag=True, help="Fail also where something cannot be decided here.")
@click.option("--json", "json_to", type=click.Choice(["-"]), help="One JSON object on standard output.")
def audit(files: tuple[Path, ...], public_key: Path | None, strict: bool, json_to: str | None) -> int:
    """Check recordings, consecutive files of a run in order: every byte, and whether the results follow from the data.

    Exit status 0 when all is as it should be, 3 when not, 2 when a file cannot be read.
    """
    from agent.pipeline import Pipeline
    from agent.recording.fingerprint import compute_as
    from agent.recording.reading import first_event

    start = first_event(files[0])
    if start is not None:
        compute_as(start.fingerprint)
    return run_audit(files, Pipeline.restore, as_json=json_to is not None, strict=strict, signed=public_key is not None)


def run_audit(
    files: Sequence[Path], restore: Restore, *, as_json: bool, strict: bool = False, signed: bool = False
) -> int:
    """Audit, print, and return the exit status. `signed`: a signature is asked for."""
    try:
        audited = audit_files(files, restore, strict=strict, signed=signed)
    except OSError as error:
        click.echo(f"{error.filename}: {error.strerror}", err=True)
        return 2
    ok = all(file.ok for file in audited)
    if as_json:
        undecidable = sum(file.replay.undecidable for file in audited)
        click.echo(msgspec.json.encode({"ok": ok, "undecidable": undecidable, "files": audited}).decode())
    else:
        for file in audited:
            click.echo(describe(file))
    return 0 if ok else 3


def audit_files(
    files: Sequence[Path], restore: Restore, *, strict: bool = False, signed: bool = False
) -> list[AuditedFile]:
    """The verdict on each file; files of one run, in order, are also held against each other. Raises OSError."""
    from agent.recording.fingerprint import fingerprint

    replayed = Replay(restore, fingerprint(), elsewhere=OTHER_CPU)
    audited: list[AuditedFile] = []
    for path in files:
        with open_recording(path) as file:
            sha256 = hashlib.file_digest(file, "sha256").hexdigest()
            size = file.tell()
            file.seek(0)
            integrity = check_integrity(file, size)
        replay = replayed.run(path)
        reasons = _reasons(integrity, replay) + _chain_reasons(integrity, replay, audited[-1] if audited else None)
        if signed:
            reasons.append("no signature in this file")
        if strict:
            reasons += replay.notes
        verdict = AuditedFile(
            path=str(path),
            ok=not reasons,
            incomplete=not integrity.finished and all(fault.kind == "torn" for fault in integrity.faults),
            reasons=reasons,
            notes=replay.notes,
            size=size,
            sha256=sha256,
            good_bytes=integrity.good_bytes,
            faults=integrity.faults,
            fault_count=integrity.fault_count,
            chunks=integrity.chunks,
            messages=integrity.messages,
            replay=replay,
        )
        audited.append(verdict)
    return audited


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
    if replay.different > 1:
        reasons.append(f"results differ after {replay.different} events")
    if not replay.events:
        reasons.append("it holds no events")
    return reasons


def _chain_reasons(integrity: Integrity, replay: ReplayedFile, before: AuditedFile | None) -> list[str]:
    """What does not fit between a file and its metadata, and the file before if that is the one before in its run."""
    metadata = integrity.metadata.get(FILE_METADATA)
    if metadata is None:
        return [f"no metadata record {FILE_METADATA}"] if replay.events else []
    reasons = []
    if replay.events and metadata.get("file_sequence") != str(replay.file_sequence):
        reasons.append(f"its metadata says file {metadata.get('file_sequence')}, its RunStart {replay.file_sequence}")
    if before is None or before.incomplete or before.replay.run_id != replay.run_id:
        return reasons
    if before.replay.file_sequence + 1 == replay.file_sequence and metadata.get("previous_sha256") != before.sha256:
        reasons.append(f"{before.path} is not the file that was there before this one: its SHA-256 differs")
    return reasons


def describe(file: AuditedFile) -> str:
    """The verdict in a line, and a line more for each reason and note."""
    replay = file.replay
    how = f"equal within {replay.tolerance:g}" if replay.tolerance else "equal bit for bit"
    verdict = f"passed, {replay.results} results {how}" if file.ok else "FAILED"
    lines = [f"{file.path}: {verdict}; {file.size} bytes, {file.chunks} chunks, {replay.events} events replayed"]
    lines += [f"  {reason}" for reason in file.reasons]
    lines += [f"  note: {note}" for note in file.notes if note not in file.reasons]
    return "\n".join(lines)
