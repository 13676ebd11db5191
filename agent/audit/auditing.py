"""The audit of one recording: is every byte as written, and do its results follow from its data?

How recordings continue each other is not looked at here; `fieldcal audit` does that with the links.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import msgspec

from agent.audit.departure import Departure
from agent.audit.replaying import Replayed, ReplayedFile, Replayer
from agent.engine import identity
from agent.recording.chain import ChainLink
from agent.recording.integrity import Integrity, check_integrity
from agent.recording.pruned_ranges import LIST, PRUNED_METADATA, Deleted, from_metadata
from agent.recording.reading import REPAIR_METADATA, open_recording
from agent.recording.records import FileFault
from agent.recording.repair import UNSIGNED
from agent.recording.result_check import check_results
from agent.recording.results_chain import EPOCH, FILE_METADATA, PREVIOUS_RESULTS
from agent.recording.signing import SIGNATURE_METADATA, signed_results, verify_file

if TYPE_CHECKING:
    from agent.config.known_keys import KnownKeys

Trusted = Callable[[str], bool]


class AuditedFile(msgspec.Struct, kw_only=True):
    """The verdict on one file.

    `reasons`: why it failed, empty where it passed. `undecided`: why this program cannot say whether its results follow
    from its data. `notes`: what else could not be decided.
    """

    path: str
    ok: bool
    incomplete: bool
    repaired: bool  # a crash left it open, and a later start closed it
    reasons: list[str]
    undecided: list[str]
    notes: list[str]
    size: int
    sha256: str
    good_bytes: int
    faults: list[FileFault]  # the first ones of `fault_count` faults
    fault_count: int
    chunks: int
    messages: int
    signed_results: int = 0  # results with a valid signature of their own
    replay: ReplayedFile


@dataclass(frozen=True, slots=True)
class Audited:
    """The verdict on one file, not concluded; its replay; its link in the chain."""

    verdict: AuditedFile
    replayed: Replayed
    link: ChainLink


def audit_file(
    path: Path,
    replayer: Replayer,
    *,
    trusted: Trusted,
    strict: bool = False,
    keys: KnownKeys | None = None,
) -> Audited:
    """Audit one recording.

    `trusted`: says of the name of an engine that is not here whether the auditor trusts it: then results that nearly
    agree with those of the present engine pass, unless the audit is `strict`. With `keys`, the file must be signed by a
    key of its gateway. Raises OSError.
    """
    with open_recording(path) as file:
        sha256 = hashlib.file_digest(file, "sha256").hexdigest()
        size = file.tell()
        file.seek(0)
        integrity = check_integrity(file, size)
        replayed = replayer.run(path)
        verdict = _verdict(path, sha256, size, integrity, replayed.file)
        fault = ""
        if keys is not None:
            signature = integrity.metadata.get(SIGNATURE_METADATA)
            said = integrity.statement(verdict.replay.gateway, verdict.replay.file_sequence)
            fault = verify_file(file, size, signature, keys, said)
            verdict.reasons += [fault] if fault else []
    if _unread(replayed.file):
        verdict.undecided.append(f"{_made_by(replayed.file)}; this program cannot read it: {replayed.file.fault}")
    elif replayed.file.departure is not None:
        near_passes = not strict and not verdict.reasons and trusted(replayed.file.engine)
        _judge_departure(verdict, replayed.file.departure, near_passes=near_passes)
    results = check_results(path, verdict.replay.gateway, None if fault else keys)
    verdict.signed_results = results.signed
    if results.fault:
        verdict.reasons.append(f"{results.faults} results without a valid signature; the first: {results.fault}")
    return Audited(verdict, replayed, _link(verdict, integrity))


def conclude(verdict: AuditedFile, *, strict: bool) -> None:
    """Decide whether a file passes, after it was also compared with its neighbours."""
    verdict.notes = [*verdict.replay.notes, *verdict.notes]
    if strict:
        verdict.reasons += verdict.notes
    verdict.ok = not verdict.reasons and not verdict.undecided


def _verdict(path: Path, sha256: str, size: int, integrity: Integrity, replay: ReplayedFile) -> AuditedFile:
    repair = integrity.metadata.get(REPAIR_METADATA)
    notes = []
    if repair is not None:
        torn = repair.get("torn_bytes")
        notes.append(f"unsealed: left open by a crash, closed later; the last {torn} bytes, incomplete, were set aside")
        if unsigned := repair.get(UNSIGNED):
            notes.append(f"the gateway did not sign it then: {unsigned:.200}")
    return AuditedFile(
        path=str(path),
        ok=False,
        incomplete=not integrity.finished and all(fault.kind == "torn" for fault in integrity.faults),
        repaired=repair is not None,
        reasons=_reasons(integrity, replay) + _metadata_reasons(integrity, replay),
        undecided=[],
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


def _judge_departure(verdict: AuditedFile, departure: Departure, *, near_passes: bool) -> None:
    """Say what follows where another engine than the present one made the file, and that engine did not run."""
    replay, made = verdict.replay, _made_by(verdict.replay)
    if replay.refused:
        verdict.undecided.append(f"{made}; engine {replay.replayed_by} cannot replay it: {replay.refused}")
        return
    text = f"{made}; by engine {replay.replayed_by} {departure}"
    (verdict.notes if near_passes and departure.near else verdict.undecided).append(text)


def _made_by(replay: ReplayedFile) -> str:
    return replay.made_by + (f", which is not here ({replay.engine_missing})" if replay.engine_missing else "")


def _unread(replay: ReplayedFile) -> bool:
    """Whether another engine wrote messages that this program cannot decode: no check of its bytes has failed then."""
    return replay.undecoded and replay.engine != identity.name()


def _link(verdict: AuditedFile, integrity: Integrity) -> ChainLink:
    pruned = integrity.metadata.get(PRUNED_METADATA)
    return ChainLink(
        path=verdict.path,
        gateway=verdict.replay.gateway,
        epoch=integrity.metadata.get(FILE_METADATA, {}).get(EPOCH, ""),
        file_sequence=verdict.replay.file_sequence,
        sha256=verdict.sha256,
        incomplete=verdict.incomplete,
        previous_sha256=integrity.metadata.get(FILE_METADATA, {}).get("previous_sha256", ""),
        previous_results=integrity.metadata.get(FILE_METADATA, {}).get(PREVIOUS_RESULTS, ""),
        signed_results=signed_results(integrity.metadata.get(SIGNATURE_METADATA)),
        deleted=(*from_metadata(pruned), *map(Deleted.of, verdict.replay.pruned)),
        listed=(pruned or {}).get(LIST, ""),
    )


def _reasons(integrity: Integrity, replay: ReplayedFile) -> list[str]:
    reasons = []
    for fault in integrity.faults:
        incomplete = f"incomplete, last good byte {integrity.good_bytes}: " if fault.kind == "torn" else ""
        reasons.append(f"{incomplete}{fault}")
    if integrity.fault_count > len(integrity.faults):
        reasons.append(f"{integrity.fault_count - len(integrity.faults)} more faults")
    if replay.fault is not None and not integrity.faults and not _unread(replay):
        reasons.append(str(replay.fault))
    if replay.refused and replay.by_own_engine:
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
