"""Builds the engines of earlier revisions as wheels, from the history of this repository.

    .venv/bin/python -m deploy.engines.earlier [-o DIRECTORY] [--write] [REVISION...]

Before 26 November 2026 an engine had neither a name nor a process. This script takes its sources out of the history,
adds the process that answers frames (agent/engine/entry.py), and makes the wheel, the same bytes each time. It prints
name and SHA-256 of each, or why a revision has no engine that runs here.

REVISION: any revision that git knows; by default those of the table below. An engine that is not in the table has the
number 0. `-o` keeps the wheels. `--write` adds those of the table to the engines that the program knows
(agent/engine/known.json).
"""

from __future__ import annotations

import argparse
import subprocess
import tempfile
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from io import BytesIO
from pathlib import Path
from typing import NamedTuple

from agent.engine.identity import BEGIN, ROOT, closure, digest
from agent.engine.known import KnownEngine, add
from agent.engine.process import EngineError, EngineFaultError, EngineProcess
from agent.engine.wheel import PROCESS, EngineWheel, file_name, read_wheel, wheel_of

FIRST_BEGIN = ("agent.pipeline", "agent.messages", "agent.recording.messages")  # until 22 November 2026, 12:00


class Revision(NamedTuple):
    """A revision whose engine is known, and the version of the program at that time."""

    number: int
    commit: str
    version: str


REVISIONS = (
    # The first that records and audits: plain Method 3, no on-line estimation.
    Revision(1, "3c2ed1b41129", "0.1.0"),
    # The last before S, Q and nuisances are estimated window by window.
    Revision(2, "743fc0a33450", "0.1.0"),
    # These three made the recordings in tests/replay/golden/format-1, -2 and -3.
    Revision(3, "30b4036f2ba8", "0.1.0"),
    Revision(4, "876e69deb5aa", "0.1.0"),
    Revision(5, "e30ed8f29fda", "0.2.0"),
    # The response over frequency is estimated on-line; results state what they owe to a shared reference.
    Revision(6, "300a08ca3641", "0.2.0"),
    # Files and agent agree on the response.
    Revision(7, "9e616eba7098", "0.2.0"),
    # Noise at some frequencies costs these alone. The last before windows of a sensor that slips are refused.
    Revision(8, "7183c8541ce7", "0.2.0"),
    # Drivers state filters. The last before U contains what no band tells.
    Revision(9, "cab5d9b86642", "0.2.0"),
    # The last before corners that drivers state are undone.
    Revision(10, "b98989ace301", "0.2.0"),
    # The last without a name. Engine 11 gives the same results, and its name in them.
    Revision(11, "46e5f60074dd", "0.2.0"),
    # The last before noise is pooled as sums over windows.
    Revision(12, "f21d15057af9", "0.2.0"),
    # The last before noise is pooled over windows nearby.
    Revision(13, "d383a3c8cd5e", "0.2.0"),
    # The last before the noise that interpolation passes follows from where it interpolates.
    Revision(14, "ed64250afe1b", "0.2.0"),
    # The last before held windows are explained by what an explanation gains beyond chance, and before transverse
    # sensitivities of a reference.
    Revision(15, "d84dd71c851d", "0.2.0"),
    # The last before noise and rounding of a tri-axial reference beside one tone were taken for motion.
    Revision(16, "bda75986f69f", "0.3.0"),
    # The last before U contains what channels without a signal of their own add to transverse slopes.
    Revision(17, "1cf1dd153582", "0.3.0"),
    # The last before bands into which motion leaks are left out, and before the noise of bands is no deviation.
    Revision(18, "0746c1187b6e", "0.3.0"),
    # The last before motion across a uniaxial reference was taken for another response, and at a fixed mount for a
    # change of S.
    Revision(19, "a65bd293c7b7", "0.3.0"),
    # The last before a floor of motion, weaker than the sensor's noise, was no noise of the reference any more.
    Revision(20, "00b8cff4d62e", "0.3.0"),
    Revision(21, "d6ede69441d7", "0.3.0"),
    # The last before the noise of a reference is that of its quietest windows, and motion ends below a gap.
    Revision(22, "6120401ea8aa", "0.3.0"),
    # The last before a fast reference is not folded, and slow motion excites by its whole power.
    Revision(23, "5c157bb27d11", "0.3.0"),
    Revision(24, "b1bf78ccaf86", "0.3.0"),
    # The last before the lag that a window has by itself is taken out of its samples.
    Revision(25, "eae836b18aa3", "0.3.0"),
    # The last before the motion tells how the lag changes within a window.
    Revision(26, "1a5e5ccb6893", "0.3.0"),
    # The last before merged records keep what is open of the lag within each of their windows.
    Revision(27, "1736f5139b67", "0.3.0"),
)


class NoEngineError(Exception):
    """A revision has no engine. The message says why."""


class NoHistoryError(NoEngineError):
    """git does not have the revision, as in a shallow clone."""


@contextmanager
def checkout(commit: str, *paths: str) -> Iterator[Path]:
    """The files of a revision under these paths, in a directory that is removed afterwards. Raises NoHistoryError."""
    # Where a user's settings ask for CRLF, `git archive` writes it (git-for-windows/git, issue 2425).
    command = ["git", "-c", "core.autocrlf=false", "-c", "core.eol=lf", "archive", "--format=zip", "-0", commit, *paths]
    try:
        archive = subprocess.run(command, cwd=ROOT, capture_output=True, check=True).stdout
    except OSError as error:
        raise NoHistoryError(f"git cannot be run: {error.strerror}") from None
    except subprocess.CalledProcessError as error:
        raise NoHistoryError(f"git: {error.stderr.decode(errors='replace').strip()}") from None
    with tempfile.TemporaryDirectory() as directory, zipfile.ZipFile(BytesIO(archive)) as files:
        files.extractall(directory)
        yield Path(directory)


def build(commit: str, number: int, engine: str = "") -> bytes:
    """The wheel of a revision's engine; `engine`: its id, where it is known. Raises NoEngineError."""
    with checkout(commit, "agent", "calib", "hw") as root:
        first = not (root / "agent/core/pipeline.py").exists()
        files = closure(root, FIRST_BEGIN if first else BEGIN)
        if not {name for name, _ in files} & {"agent/pipeline.py", "agent/core/pipeline.py"}:
            raise NoEngineError("it has no pipeline, so it recorded no results")
        sources = {name: path.read_bytes() for name, path in files}
        own = root if (root / "agent/engine/entry.py").exists() else ROOT
        process = {name: (own / name).read_bytes() for name in PROCESS}
    if first:
        process["agent/engine/serving.py"] = process["agent/engine/entry.py"]
        process["agent/engine/entry.py"] = Path(__file__).with_name("first_entry.py").read_bytes()
    return wheel_of(number, engine or digest(sources), sources | process)


def keep(revision: Revision, directory: Path | None) -> EngineWheel:
    """Build an engine, start it, and write its wheel into the directory. Raises NoEngineError, OSError."""
    data = build(revision.commit, revision.number)
    wheel = read_wheel(revision.commit, data)
    try:
        with EngineProcess(wheel) as process:
            process.memories()  # imports everything
    except EngineError as error:
        raise NoEngineError(f"it does not run here: {error}") from None
    except EngineFaultError as fault:
        if str(fault) != "ValueError: no file was begun":
            raise NoEngineError(f"it does not run here: {fault}") from None
    if directory:
        directory.mkdir(parents=True, exist_ok=True)
        (directory / file_name(wheel.engine_id)).write_bytes(data)
    return wheel


def main() -> int:
    """Build what is asked for; print one line for each. The exit status is 1 where a revision has no engine."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("-o", metavar="DIRECTORY", type=Path, help="keep the wheels here")
    parser.add_argument("--write", action="store_true", help="add the engines of the table to agent/engine/known.json")
    parser.add_argument("revisions", metavar="REVISION", nargs="*", help="default: those of the table")
    given = parser.parse_args()
    table = {revision.commit: revision for revision in REVISIONS}
    asked = [table.get(commit[:12], Revision(0, commit, "")) for commit in given.revisions] or REVISIONS
    found = []
    for revision in asked:
        try:
            wheel = keep(revision, given.o)
        except NoEngineError as error:
            print(f"{revision.commit[:12]}: no engine: {error}", flush=True)
            continue
        print(f"{revision.commit[:12]}: {wheel.name} {wheel.sha256}", flush=True)
        found.append(KnownEngine(wheel.number, wheel.engine_id, wheel.sha256, revision.version, revision.commit))
    if given.write:
        add([engine for engine in found if engine.number])
    return len(found) < len(asked)


if __name__ == "__main__":
    raise SystemExit(main())
