"""`fieldcal fleet replay`: audits many recordings, or recomputes them, each by itself."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
import msgspec

from agent.terminal.text import say
from calib.rounding import plus_minus

if TYPE_CHECKING:
    from agent.fleet.results import Summary


@click.command()
@click.argument("recordings", nargs=-1, required=True, metavar="FILE|DIR|GLOB|URL...")
@click.option("--workers", type=click.IntRange(1, 1024), help="Processes of this machine.  [default: one for each CPU]")
@click.option(
    "--scheduler", metavar="ADDRESS", help="Dask scheduler, such as tcp://192.0.2.1:8786, instead of processes."
)
@click.option("--set", "settings", multiple=True, metavar="KEY=VALUE",
              help="Recompute with another setting, such as channels.*.certificate.sensitivity*=0.996.")  # fmt: skip
@click.option("--audit", "with_audit", is_flag=True, help="Check every byte too, as `fieldcal audit`.")
@click.option("--export", "ending", type=click.Choice(["csv", "parquet", "uff", "mseed"]),
              help="Write the samples of each sensor into -o DIR, as `fieldcal export`; replay nothing.")  # fmt: skip
@click.option("-o", "directory", metavar="DIR", type=click.Path(file_okay=False, path_type=Path),
              help="Write the results here, and go on from what is here already.")  # fmt: skip
@click.option("--json", "json_to", type=click.Choice(["-"]), help="Print one JSON object on standard output.")
def replay(
    recordings: tuple[str, ...],
    workers: int | None,
    scheduler: str | None,
    settings: tuple[str, ...],
    with_audit: bool,
    ending: str | None,
    directory: Path | None,
    json_to: str | None,
) -> int:
    """Run many recordings through the pipeline, each by itself, and print one line for each.

    Without --set the computed results must equal the recorded ones. With --set the estimation of each recording begins
    anew with the changed settings, and the calibrations that follow are the result.

    Exit status: 0 all passed, 3 a recording was refused or cannot be read (the others are computed), 2 bad usage.
    """
    from agent.fleet.results import results_of
    from agent.fleet.settings import ChangedSetting, SettingError
    from agent.fleet.sources import SourceError, recordings_in
    from agent.fleet.workers import DaskWorkers, LocalWorkers, SchedulerError

    if scheduler is not None and workers is not None:
        raise click.UsageError("give --workers or --scheduler: Dask has workers of its own")
    if ending is not None and (directory is None or settings or with_audit):
        raise click.UsageError("--export needs -o DIR, and goes neither with --set nor with --audit")
    try:
        for text in settings:
            ChangedSetting.of(text)
        places = recordings_in(recordings)
        if directory is not None:
            directory.mkdir(parents=True, exist_ok=True)
        chosen = DaskWorkers(scheduler) if scheduler else LocalWorkers(workers or len(os.sched_getaffinity(0)))
    except (SourceError, SettingError, SchedulerError) as error:
        say(f"fieldcal fleet replay: {error}", err=True)
        return 2
    where = None if directory is None else directory.absolute()
    with chosen:
        results = results_of(places, settings, chosen, where, audit=with_audit, export=ending or "")
        return _tell(_in_order(places, _shown(results, len(places))), settings, as_json=json_to is not None)


def _tell(results: Iterable[Summary], settings: tuple[str, ...], *, as_json: bool) -> int:
    """Print a line for each result as it comes, or one JSON object at the end; returns the exit status."""
    summaries = []
    for summary in results:
        summaries.append(summary)
        if not as_json:
            say(_line(summary))
    if as_json:
        click.echo(msgspec.json.encode(_as_object(summaries, settings)).decode())
    return 3 if any(summary.reasons for summary in summaries) else 0


def _as_object(summaries: list[Any], settings: tuple[str, ...]) -> dict[str, Any]:
    refused = sum(bool(summary.reasons) for summary in summaries)
    return {
        "ok": not refused,
        "refused": refused,
        "unchanged": sum(summary.unchanged for summary in summaries),
        "settings": settings,
        "files": summaries,
    }


def _in_order(places: list[str], results: Iterable[Any]) -> Iterator[Any]:
    """The summaries in the order of the recordings, each as soon as those before it are there."""
    early: dict[str, Any] = {}
    wanted = iter(places)
    place = next(wanted, None)
    for summary in results:
        early[summary.place] = summary
        while place in early:
            yield early.pop(place)
            place = next(wanted, None)


def _shown(results: Iterable[Any], count: int) -> Iterator[Any]:
    """Show progress on a terminal."""
    if not sys.stderr.isatty():
        yield from results
        return
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    from agent.terminal.console import TextConsole

    columns = (TextColumn("recordings"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, console=TextConsole(sys.stderr), redirect_stdout=sys.stdout.isatty()) as progress:
        yield from progress.track(results, total=count)


def _line(summary: Any) -> str:
    if summary.reasons:
        more = f" (and {len(summary.reasons) - 1} more reasons)" if len(summary.reasons) > 1 else ""
        return f"{summary.place}: REFUSED: {summary.reasons[0]}{more}"
    again = " (unchanged)" if summary.unchanged else ""
    if summary.exported:
        files = (f"{e.file}, {e.samples} samples" + (f" ({e.ends_early})" if e.ends_early else "")
                 for e in summary.exported)  # fmt: skip
        return f"{summary.place}: {'; '.join(files)}{again}"
    told = f"{summary.place}: {summary.events} events, {summary.results} results"
    for update in summary.calibrations:
        S = update["sensitivity"]
        U = [None if u is None else update["coverage_factor"] * u for u in update["standard_uncertainty"]]
        values = ", ".join(f"S{axis}{axis} {plus_minus(S[i][i], U[4 * i])}" for i, axis in enumerate("xyz"))
        told += f"; {update['sensor']} {values} {update['output_unit']} per m/s2"
    return told + again
