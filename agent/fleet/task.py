"""What is done with one recording. It runs in a worker, which may be another process or another machine."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import msgspec

from agent import __version__
from agent.audit.auditing import AuditedFile, audit_file, conclude
from agent.audit.engines import Engines, as_if_own
from agent.audit.replaying import PipelineLike, Replayed, ReplayedFile, Replayer
from agent.core.events import CalibrationUpdate, WindowReport
from agent.export.samples import ExportError
from agent.fleet.exporting import Exported, exported
from agent.fleet.settings import ChangedSetting, SettingError, changed_config
from agent.fleet.sources import SourceError, local
from agent.recording.comparison import OTHER_CPU
from agent.recording.reading import open_recording

UNCHANGED = b""  # in place of a result: the one that is known still holds


class RecordingTask(msgspec.Struct, frozen=True, kw_only=True):
    """What is to be done. Everything in it may be written to a log: it holds no credentials.

    `place`: a path or an address. `settings`: as `ChangedSetting.of` reads them. `known`: the fields `sha256` and
    `made_by` of a result that is there already.
    """

    place: str
    settings: tuple[str, ...] = ()
    audit: bool = False
    export: str = ""  # ending of the files of samples that are to be written, such as csv; then nothing is replayed
    directory: str = ""  # where they are written
    known: tuple[str, str] = ("", "")


class FileResult(msgspec.Struct, kw_only=True):
    """What came out of one recording. `reasons`: why it is refused, empty where it is not.

    `made_by`: digest of settings, version of the program and kernels that computed it.
    """

    place: str
    sha256: str = ""
    made_by: str = ""
    fingerprint: dict[str, str] = {}
    settings: tuple[str, ...] = ()
    reasons: list[str] = []
    audited: AuditedFile | None = None
    replayed: ReplayedFile | None = None
    calibrations: list[CalibrationUpdate] = []
    windows: list[WindowReport] = []
    exported: list[Exported] = []


def run_task(task: RecordingTask) -> bytes:
    """The FileResult of a recording as JSON; UNCHANGED where the known result holds. The same bytes on every worker
    that has the same fingerprint. What is wrong with the recording is in the result; a MemoryError is raised."""
    from threadpoolctl import threadpool_limits

    threadpool_limits(1)  # a sum over several threads has other last bits
    return msgspec.json.encode(found) if (found := _result(task)) is not None else UNCHANGED


def _result(task: RecordingTask) -> FileResult | None:
    from agent.recording.fingerprint import fingerprint

    here = fingerprint()
    result = FileResult(place=task.place, fingerprint=here, settings=task.settings, made_by=_made_by(task, here))
    try:
        with local(task.place) as path, open_recording(path) as file:
            result.sha256 = hashlib.file_digest(file, "sha256").hexdigest()
            if (result.sha256, result.made_by) == task.known:
                return None
            if task.export:
                result.exported = exported(path, task.place, task.export, Path(task.directory))
                return result
            settings = [ChangedSetting.of(text) for text in task.settings]
            if task.audit:
                engines = Engines(_recorded)
                audited = audit_file(path, replayer=Replayer(engines, here, OTHER_CPU), trusted=engines.trusts)
                verdict, replayed = audited.verdict, audited.replayed
                conclude(verdict, strict=False)
                verdict.path = task.place
                result.audited, result.reasons = verdict, [*verdict.reasons, *verdict.undecided]
            if settings:
                replayed = _recomputed(path, settings, here, result)
            elif not task.audit:
                replayed = Replayer(Engines(_recorded), here, OTHER_CPU).run(path)
                result.reasons += _reasons(replayed.file)
    except (SourceError, SettingError) as error:
        result.reasons.append(str(error).removeprefix(f"{task.place}: "))
        return result
    except ExportError as error:
        result.reasons.append(str(error).removeprefix(f"{path}: "))
        return result
    except OSError as error:
        result.reasons.append(f"cannot be read: {error.strerror or error}")
        return result
    result.replayed = replayed.file
    result.replayed.path = task.place
    if result.replayed.first_difference is not None:
        result.replayed.first_difference = msgspec.structs.replace(result.replayed.first_difference, file=task.place)
    result.calibrations, result.windows = replayed.calibrations, replayed.windows
    return result


def _recomputed(path: Path, settings: Sequence[ChangedSetting], here: dict[str, str], result: FileResult) -> Replayed:
    """The replay under changed settings: other results than the recorded ones are what was asked for."""
    from agent.core.anew import anew
    from agent.core.pipeline import Pipeline

    refused: list[SettingError] = []

    def restore(config_json: str, snapshot: bytes) -> PipelineLike:
        try:
            config = changed_config(config_json, settings)
        except SettingError as error:
            refused.append(error)
            raise
        return Pipeline.restore(config.model_dump_json(), anew(config, snapshot))

    replayed = Replayer(as_if_own(restore), here, elsewhere=0.0).run(path)
    file = replayed.file
    if refused:
        raise refused[0]
    file.different, file.first_difference = 0, None
    result.reasons += _reasons(file)
    return replayed


def _recorded(config_json: str, snapshot: bytes) -> PipelineLike:
    from agent.core.pipeline import Pipeline

    return Pipeline.restore(config_json, snapshot)


def _reasons(file: ReplayedFile) -> list[str]:
    """Why the replay of a file is refused, as `fieldcal replay` refuses it."""
    if not file.events:
        return [str(file.fault or "not a recording made by fieldcal")]
    reasons = [f"cannot be replayed: {file.refused}"] if file.refused else []
    if file.departure is not None and not file.departure.near:
        reasons.append(f"{file.made_by}; by engine {file.replayed_by} {file.departure}")
    if file.first_difference is not None:
        reasons.append(f"results differ after {file.different} events, first {file.first_difference}")
    if file.fault is not None and file.fault.kind == "corrupt":
        reasons.append(f"damaged at {file.fault}")
    return reasons


def _made_by(task: RecordingTask, here: dict[str, str]) -> str:
    held: list[Any] = [__version__, task.audit, task.export, list(task.settings), sorted(here.items())]
    return hashlib.sha256(msgspec.json.encode(held)).hexdigest()
