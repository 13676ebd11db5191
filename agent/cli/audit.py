"""`fieldcal audit`: checks that every byte of a recording is as written and that its results follow from its data."""

from __future__ import annotations

import time
from collections.abc import Sequence
from contextlib import ExitStack, suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
import msgspec

from agent.audit.auditing import AuditedFile, audit_file, conclude
from agent.audit.engines import Engines
from agent.audit.parallel import for_each
from agent.audit.replaying import Replayer
from agent.audit.replaying import link as link_replays
from agent.cli.data_dir import DATA_DIR, files_or
from agent.cli.engine_options import ENGINES, JOBS, TRUST_ENGINE, engines_for
from agent.cli.given import GivenFiles, add_witnessed, read_head, recordings_of
from agent.cli.kernels import compute_as_in
from agent.delivery.history import StoreError
from agent.recording.chain import ChainLink, chain_faults, missing_after, unproven
from agent.recording.comparison import OTHER_CPU
from agent.recording.end_check import End, check_end
from agent.recording.gone import Gone, find_gone
from agent.recording.head import HEAD_NAME
from agent.recording.reading import open_recording
from agent.terminal.text import say

if TYPE_CHECKING:
    from agent.config.known_keys import KnownKeys

FILES_NEEDED = 100  # open files of the audit itself, with its libraries
NO_ENGINE = "which engine made these results: without signatures anybody can write the name of another one"
OPEN_AFTER_CRASH = (
    "that the samples of {} recordings that a crash left open are as measured: until the next start only their results "
    "and what a head names were signed"
)


@click.command()
@click.argument("files", nargs=-1, type=click.Path(path_type=Path), metavar="[FILE.mcap...]")
@DATA_DIR
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
@ENGINES
@TRUST_ENGINE
@JOBS
@click.option(
    "--strict", is_flag=True,
    help="Fail also for repaired files and files of another CPU; let results pass by their own engine alone.",
)  # fmt: skip
@click.option("--json", "json_to", type=click.Choice(["-"]), help="Print one JSON object on standard output.")
def audit(
    files: tuple[Path, ...],
    data_dir: Path | None,
    public_key: Path | None,
    known_keys: Path | None,
    heads: tuple[Path, ...],
    witness: Path | None,
    engines: tuple[Path, ...],
    trusted: tuple[str, ...],
    jobs: int,
    strict: bool,
    json_to: str | None,
) -> int:
    """Check recordings: every byte, whether results follow from the data, whether a file is missing.

    With --data-dir all recordings of the directory are checked, and none may be missing. Exit status: 0
    all passed, 3 a check failed, 4 not decided here because another engine made the results, 2 a file cannot be read.
    The end of the output says what cannot be proven.
    """
    from agent.config.key_file import KeyFileError
    from agent.core.pipeline import Pipeline
    from agent.recording.signed_text import SignedTextError
    from agent.recording.witness import WitnessError

    files = files_or(data_dir, files, "FILE.mcap")
    try:
        keys = _known_keys(public_key, known_keys)
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
    if given.paths:
        compute_as_in(given.paths[0])
    chosen = engines_for(Pipeline.restore, files, engines, trusted)
    return run_audit(given, chosen, as_json=json_to is not None, strict=strict, keys=keys, jobs=jobs)


def _known_keys(public_key: Path | None, known_keys: Path | None) -> KnownKeys | None:
    """The keys of the options; None where neither is given. Raises KeyFileError."""
    from agent.config.known_keys import KnownKeys, read_known_keys
    from agent.recording.signing import load_public_key

    if public_key is None and known_keys is None:
        return None
    listed = read_known_keys(known_keys) if known_keys is not None else KnownKeys()
    anywhere = (load_public_key(public_key).public_bytes_raw(),) if public_key is not None else ()
    return replace(listed, anywhere=anywhere)


def _is_signed(links: Sequence[ChainLink]) -> bool:
    """Whether the newest recording is."""
    return bool(links) and links[-1].signed_results is not None


def _print(audited: Sequence[AuditedFile], end: End, lost: str) -> None:
    for file in audited:
        for line in describe(file):
            say(line)
    if lost:
        say(f"FAILED: {lost}")
    for line in end.describe():
        say(line)


def _unproven(audited: Sequence[AuditedFile], keys: KnownKeys | None) -> list[str]:
    """What files cannot prove without keys, or where they were left open."""
    if keys is None:
        return [NO_ENGINE] if audited else []
    left_open = sum(file.repaired for file in audited)
    return [OPEN_AFTER_CRASH.format(left_open)] if left_open else []


def run_audit(
    given: GivenFiles,
    engines: Engines,
    *,
    as_json: bool,
    strict: bool = False,
    keys: KnownKeys | None = None,
    jobs: int = 1,
) -> int:
    """Audit, print, and return the exit status. With `keys`, files must be signed by a key of their gateway."""
    try:
        audited, links, gone = _audit(given, engines, strict=strict, keys=keys, jobs=jobs)
        end = check_end(given.heads, links, gone, keys, time.time_ns())
        end.reasons += [*given.faults, *gone.faults]
        end.unproven += [*unproven(links, gone.statements, whole=gone.whole), *gone.unproven]
    except OSError as error:
        say(f"{error.filename}: {error.strerror}", err=True)
        return 2
    if strict and keys is not None and not given.heads and _is_signed(links):
        end.reasons.append(f"there is no {HEAD_NAME} beside signed recordings, and none was given (--head, --witness)")
    end.unproven += _unproven(audited, keys)
    lost = missing_after(links, given.up_to or 0)
    failed = bool(lost or end.reasons or any(file.reasons for file in audited))
    undecided = sum(bool(file.undecided) for file in audited)
    if as_json:
        click.echo(msgspec.json.encode(_as_object(audited, end, lost, ok=not failed and not undecided)).decode())
    else:
        _print(audited, end, lost)
    return 3 if failed else 4 if undecided else 0


def _as_object(audited: Sequence[AuditedFile], end: End, lost: str, *, ok: bool) -> dict[str, Any]:
    return {
        "ok": ok,
        "undecidable": sum(file.replay.undecidable for file in audited),
        "undecided": sum(bool(file.undecided) for file in audited),
        "unsealed": sum(file.repaired for file in audited),
        "missing": lost,
        "end": end,
        "files": audited,
    }


def audit_files(
    given: GivenFiles, engines: Engines, *, strict: bool = False, keys: KnownKeys | None = None
) -> list[AuditedFile]:
    """The verdict on each file. Each file is also compared with the one before it. Raises OSError."""
    return _audit(given, engines, strict=strict, keys=keys, jobs=1)[0]


def _audit(
    given: GivenFiles, engines: Engines, *, strict: bool, keys: KnownKeys | None, jobs: int
) -> tuple[list[AuditedFile], list[ChainLink], Gone]:
    """(the verdicts, the links of the chain, what is known of recordings that are not there)."""
    from agent.recording.fingerprint import fingerprint

    replayer = Replayer(engines, fingerprint(), OTHER_CPU)
    work = partial(audit_file, replayer=replayer, trusted=engines.trusts, strict=strict, keys=keys)
    with ExitStack() as held:  # kept open to the end, so that retention, which begins with the oldest, deletes none
        for path in given.paths[: _most_open()]:
            held.enter_context(open_recording(path))
        checked = sorted(for_each(work, given.paths, jobs), key=lambda one: one.link.number)
    audited, links = [one.verdict for one in checked], [one.link for one in checked]
    faults, not_linked = link_replays([one.replayed for one in checked])
    gone = find_gone(given.directory, links, [head.number for head in given.heads], keys)
    for index, fault in [*faults, *chain_faults(links, gone.statements, whole=gone.whole)]:
        audited[index].reasons.append(fault)
    for verdict in audited:
        conclude(verdict, strict=strict)
    return audited, links, replace(gone, unproven=(*gone.unproven, *not_linked))


def _most_open() -> int:
    """How many files this process can hold open, besides those that it needs."""
    try:
        import resource
    except ImportError:  # no Unix
        return 0
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    with suppress(OSError, ValueError):
        resource.setrlimit(resource.RLIMIT_NOFILE, (hard, hard))
        soft = hard
    return max(0, min(soft, 1 << 20) - FILES_NEEDED)


def describe(file: AuditedFile) -> list[str]:
    """The verdict as text: one line, and one more line for each reason and note."""
    replay = file.replay
    how = f"equal within {replay.tolerance:g}" if replay.tolerance else "equal bit for bit"
    how = how if replay.by_own_engine else "nearly equal"
    passed = f"passed, {replay.results} results {how}"
    needed = f"not decided: needs engine {replay.engine or '(not named)'}"
    verdict = passed if file.ok else "FAILED" if file.reasons else needed
    lines = [f"{file.path}: {verdict}; {file.size} bytes, {file.chunks} chunks, {replay.events} events replayed"]
    lines[0] += f", {file.signed_results} results signed" if file.signed_results else ""
    lines += [f"  {reason}" for reason in (*file.reasons, *file.undecided)]
    lines += [f"  note: {note}" for note in file.notes if note not in file.reasons]
    return lines
