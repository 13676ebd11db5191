"""`fieldcal replay`: runs recordings through the same pipeline and prints the calibrations."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import click
import msgspec

from agent.audit.engines import Engines
from agent.audit.parallel import for_each
from agent.audit.replaying import Replayed, ReplayedFile, Replayer, link
from agent.cli.engine_options import ENGINES, JOBS, TRUST_ENGINE, engines_for
from agent.cli.kernels import compute_as_in
from agent.core.events import CalibrationUpdate
from agent.terminal.text import one_line, say
from agent.terminal.wording import calibration_cells
from calib.output_unit import shown_in
from calib.rounding import aligned

HEADS = ("sensor", "result", "windows", "Sxx", "Syy", "Szz", "Qx", "Qy", "Qz", "unit of S", "unit of Q")
SHOWN = 12  # calibrations shown in the table; `--json` gives all


@click.command()
@click.argument("files", nargs=-1, required=True, type=click.Path(path_type=Path), metavar="FILE.mcap...")
@ENGINES
@TRUST_ENGINE
@JOBS
@click.option("--json", "json_to", type=click.Choice(["-"]), help="Print one JSON object on standard output.")
def replay(
    files: tuple[Path, ...], engines: tuple[Path, ...], trusted: tuple[str, ...], jobs: int, json_to: str | None
) -> int:
    """Run recordings through the pipeline, in the order given, and print the calibrations.

    Exit status: 0 the computed results equal the recorded ones bit for bit, 3 they do not, 4 another engine made the
    recorded ones and they differ, 2 a file cannot be read.
    """
    from agent.core.pipeline import Pipeline

    compute_as_in(files[0])
    chosen = engines_for(Pipeline.restore, files, engines, trusted)
    return run_replay(files, chosen, as_json=json_to is not None, jobs=jobs)


def run_replay(files: Sequence[Path], engines: Engines, *, as_json: bool, jobs: int = 1) -> int:
    """Replay the files, print the calibrations, and return the exit status."""
    from agent.recording.fingerprint import fingerprint

    replayer = Replayer(engines, fingerprint(), elsewhere=0.0)
    replayed, unreadable = [], []
    for path, one in zip(files, for_each(partial(_replayed, replayer), files, jobs), strict=True):
        if isinstance(one, str):
            unreadable.append(one)
        elif not one.file.events:
            unreadable.append(f"{path}: {one.file.fault or 'not a recording made by fieldcal'}")
        if isinstance(one, Replayed):
            replayed.append(one)
    link(replayed)
    if as_json:
        click.echo(msgspec.json.encode(as_object(replayed)).decode())
    elif not unreadable:
        _print(replayed)
    for line in unreadable:
        say(line, err=True)
    if unreadable:
        return 2
    return _status([one.file for one in replayed])


def _status(files: Sequence[ReplayedFile]) -> int:
    """The exit status for files that can be read."""
    if any((file.by_own_engine and not file.equal) or (file.fault and file.fault.kind == "corrupt") for file in files):
        return 3
    return 0 if all(file.equal for file in files) else 4


def _replayed(replayer: Replayer, path: Path) -> Replayed | str:
    """The replay of a file; why it cannot be read."""
    try:
        return replayer.run(path)
    except OSError as error:
        return f"{path}: {error.strerror or error}"


def as_object(replayed: Sequence[Replayed]) -> dict[str, Any]:
    """The object that `--json -` prints."""
    files = [one.file for one in replayed]
    return {
        "files": files,
        "runs": list(dict.fromkeys(file.run_id for file in files)),
        "calibrations": [update for one in replayed for update in one.calibrations],
        "windows": [window for one in replayed for window in one.windows],
        "equal": bool(files) and all(file.equal for file in files),
        "first_difference": next((file.first_difference for file in files if file.first_difference), None),
        "events": sum(file.events for file in files),
        "results": sum(file.results for file in files),
        "torn": [file.path for file in files if file.fault],
    }


def _print(replayed: Sequence[Replayed]) -> None:
    calibrations = [update for one in replayed for update in one.calibrations]
    if calibrations:
        say("calibrations, with expanded uncertainty")
        for line in aligned([HEADS, *map(_row, calibrations[-SHOWN:])]):
            say(f"  {line}")
    if len(calibrations) > SHOWN:
        say(f"only the last {SHOWN} of {len(calibrations)} calibrations are shown; --json - has all")
    for one in replayed:
        for line in describe(one.file):
            say(line)


def describe(file: ReplayedFile) -> list[str]:
    """The replay of one file as text: one line, and one more line for each result, fault and note."""
    how = "continued from the file before" if file.in_chain else "from its own snapshot"
    lines = [f"{file.path}: {file.events} events, {file.results} results, {how}"]
    if file.refused:
        lines.append(f"  cannot be replayed: {file.refused}")
    elif file.first_difference:
        lines.append(f"  results differ after {file.different} events, first {file.first_difference}")
    elif file.departure is not None:
        lines.append(f"  {file.made_by}; by engine {file.replayed_by} {file.departure}")
    elif not file.results:
        lines.append("  no results were recorded, and none were computed")
    elif file.tolerance:
        lines.append(f"  results equal the recorded ones within {file.tolerance:g}")
    else:
        lines.append("  results equal the recorded ones bit for bit")
    if file.fault:
        lines.append(f"  {'ends early' if file.fault.kind == 'torn' else 'damaged'} at {file.fault}")
        lines.append(f"  last good byte {file.good_bytes}")
    lines += [f"  {note}" for note in file.notes]
    return lines


def _row(update: CalibrationUpdate) -> tuple[str, ...]:
    rows = calibration_cells(update)
    cells = (*(rows[i][i] for i in range(3)), *(row[3] for row in rows))
    shown = shown_in(update.output_unit)
    return (one_line(update.sensor), str(update.sequence), str(update.windows), *cells, shown.sensitivity, shown.offset)
