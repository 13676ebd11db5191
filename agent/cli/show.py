"""`fieldcal show`: shows the results in a data directory, also while the agent runs."""

from __future__ import annotations

import contextlib
import datetime as dt
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
import msgspec

from agent import __version__
from agent.cli.rules import check_rules
from agent.config.whole_files import status_of, write_whole
from agent.core.events import RESULTS, CalibrationUpdate, StatusChange, WindowReport
from agent.delivery.calibrations import calibrations
from agent.delivery.history import FILE_NAME, History, StoredResult, StoreError
from agent.terminal.quantity import counted, size
from agent.terminal.text import one_line, say

if TYPE_CHECKING:
    from agent.config.known_keys import KnownKeys
    from agent.core.memory import Memory
    from agent.export.past import SensorPast
    from agent.terminal.console import TextConsole
    from calib.state.sources import Sources

SOURCES_SHOWN = 5  # of U; --json has all
HISTORY_SHOWN = 10  # newest calibrations and windows of a sensor


@click.command()
@click.argument("recordings", nargs=-1, type=click.Path(path_type=Path, dir_okay=False), metavar="[RECORDING]...")
@click.option("--data-dir", type=click.Path(path_type=Path), default=Path("data"), show_default=True, metavar="D",
              help="Where the agent keeps recordings and state.")  # fmt: skip
@click.option("--json", "json_to", metavar="-|FILE", help="One JSON object on standard output, or in FILE.")
@click.option(
    "--past", is_flag=True, help="Show S(t), Q(t) and U(t) of the past instead, by all windows that the agent has kept."
)
@click.option(
    "--csv",
    "csv_to",
    type=click.Path(path_type=Path, dir_okay=False),
    metavar="FILE",
    help="With --past: a row for each epoch; the file must not exist.",
)
@click.option("--budget", type=click.IntRange(1), metavar="NUMBER",
              help="Show what makes U of the calibration with this number instead.")  # fmt: skip
@click.option("--public-key", metavar="K", type=click.Path(path_type=Path),
              help="Show only results that this key (PEM) signed.")  # fmt: skip
@click.option("--limit", type=click.IntRange(1), default=HISTORY_SHOWN, show_default=True, metavar="N",
              help="Show the newest N calibrations and windows of each sensor.")  # fmt: skip
@click.pass_context
def show(
    context: click.Context, recordings: tuple[Path, ...], data_dir: Path, json_to: str | None, past: bool,
    csv_to: Path | None, budget: int | None, public_key: Path | None, limit: int,
) -> int:  # fmt: skip
    """Show calibration in force, status, history and recordings of a data directory.

    A result that the gateway signed is shown as it was signed. One whose signature is not valid is not shown.

    With --past: S and Q with U at each epoch, by all windows before and after it, with the number of the calibration
    that was in force then, and what changed at once, with its date. Old windows are merged to hours, days, weeks,
    months and years. With RECORDING, recordings of one gateway take the place of the data directory: the windows are
    those up to the end of the one that ends last, which is replayed.

    With --budget: the sources of U of the calibration with that number, each with what it alone would make of U. Where
    its result does not say them, the recording in which it was made is replayed up to it.

    Exit status 2 if there is no store, or if it or a recording cannot be read; 3 if a result is refused, or if windows
    do not tell what makes U, with the reasons.
    """
    from agent.config.key_file import KeyFileError
    from agent.export.samples import ExportError

    check_rules(
        (csv_to is not None and not past, "--csv writes the past; add --past, or remove --csv"),
        (past and budget is not None, "--past and --budget show different things; remove one of them"),
    )
    if recordings:
        _check_recordings(context, needed=past or budget is not None)
    try:
        if past:
            found, refused = (_past_of(recordings), False) if recordings else _past_in(data_dir, public_key)
            _show_past(recordings or (data_dir,), found, json_to, csv_to)
            return 3 if refused else 0
        if budget is not None:
            return _show_budget(recordings, data_dir, budget, json_to, public_key)
        return _show_overview(read_overview(data_dir, limit, public_key), json_to)
    except (StoreError, KeyFileError, ExportError) as error:
        say(f"fieldcal show: {error}", err=True)
        return 2
    except OSError as error:
        if error.filename is None:  # of standard output
            raise
        say(f"fieldcal show: {error.filename or data_dir}: {error.strerror}", err=True)
        return status_of(error)


def _show_overview(overview: Overview, json_to: str | None) -> int:
    if json_to:
        _write_json(as_object(overview), json_to)
    else:
        _print(overview)
    return 3 if overview.refused else 0


def _write_json(found: dict[str, Any], to: str) -> None:
    data = msgspec.json.encode(found)
    if to == "-":
        click.echo(data.decode())
    else:
        write_whole(Path(to), data + b"\n")


def _check_recordings(context: click.Context, *, needed: bool) -> None:
    """Raise click.UsageError for options that do not go together with recordings."""
    if not needed:
        raise click.UsageError(
            "recordings tell the past; add --past or --budget, or name a data directory with --data-dir D"
        )
    for name, option in (("data_dir", "--data-dir"), ("public_key", "--public-key")):
        if context.get_parameter_source(name) is click.core.ParameterSource.COMMANDLINE:
            raise click.UsageError(
                f"{option} belongs to a data directory; remove it, or the recordings (`fieldcal audit` checks these)"
            )


def _past_in(data_dir: Path, public_key: Path | None) -> tuple[list[SensorPast], bool]:
    """The past of all sensors, and whether a result is refused. Raises StoreError, KeyFileError, OSError."""
    from agent.export.past import pasts

    with History(data_dir / FILE_NAME, keys := _keys(public_key), signed_only=keys is not None) as history:
        history.check()
        found = pasts(history)
    for sequence, reason in sorted(history.refused.items()):
        say(f"fieldcal show: result {sequence} is refused: {reason}", err=True)
    return found, bool(history.refused)


def _past_of(recordings: Sequence[Path]) -> list[SensorPast]:
    """The past of all sensors of recordings. Raises ExportError, OSError."""
    from agent.cli.kernels import compute_as_in
    from agent.export.past import pasts_of

    compute_as_in(recordings[0])
    found = pasts_of(recordings, faults := list[str]())
    for fault in faults:
        say(f"fieldcal show: {fault}", err=True)
    return found


def _show_past(
    sources: Sequence[Path], found: Sequence[SensorPast], json_to: str | None, csv_to: Path | None
) -> None:  # fmt: skip
    """Show the past of all sensors, as a data directory or recordings tell it. Raises OSError."""
    from agent.export.past import as_object as past_object
    from agent.export.past import lines, write_csv

    if csv_to is not None:
        say(f"{csv_to}: {write_csv(csv_to, found)} epochs", err=json_to == "-")
    if json_to:
        named = {"recordings": list(map(str, sources))} if sources[0].is_file() else {"data_dir": str(sources[0])}
        _write_json({"version": __version__, **named, "past": past_object(found)}, json_to)
    elif csv_to is None:
        for line in [line for one in found for line in lines(one)] or [f"{sources[0]}: no state is kept yet"]:
            say(line)


def _show_budget(
    recordings: Sequence[Path], data_dir: Path, number: int, json_to: str | None, public_key: Path | None
) -> int:  # fmt: skip
    """Show what makes U of a calibration; returns the exit status. Raises ExportError, StoreError, OSError."""
    from agent.cli.kernels import compute_as_in
    from agent.core.past import PastError
    from agent.export.budgets import budget_in, budget_of

    try:
        if recordings:
            compute_as_in(recordings[0])
            found = budget_of(recordings, number)
        else:
            with History(data_dir / FILE_NAME, keys := _keys(public_key), signed_only=keys is not None) as history:
                found = budget_in(history, data_dir, number)
    except PastError as error:
        say(f"fieldcal show: what makes U of the calibration {number} is not known: {error}", err=True)
        return 3
    update, sources = found.update, found.sources
    run, made = update.made
    ratio = sources.standard_uncertainty / update.standard_uncertainty
    if json_to:
        told = {"sensor": update.sensor, "run_id": run, "sequence": made, "budget": _budget_object(sources)}
        times = [float(ratio.min()), float(ratio.max())]
        _write_json({"version": __version__, **told, "u_over_u_in_force": times}, json_to)
        return 0
    say(f"{update.sensor}: calibration {made} of run {run}, in force since {_time(update.t_utc_ns)}")
    for line in _budget_lines(sources, update.output_unit, most=None):
        say(line)
    say(f"u of all sources together is {ratio.min():.4f} to {ratio.max():.4f} times u of the calibration")
    return 0


def _keys(public_key: Path | None) -> KnownKeys | None:
    from agent.config.known_keys import KnownKeys
    from agent.recording.signing import load_public_key

    return None if public_key is None else KnownKeys(anywhere=(load_public_key(public_key).public_bytes_raw(),))


@dataclass(frozen=True, slots=True)
class SensorHistory:
    """Results of one sensor. Lists begin with the newest; each calibration is in them once."""

    status: StoredResult | None
    calibration: StoredResult | None  # in force
    calibrations: list[StoredResult]
    windows: list[StoredResult]
    drift: list[StoredResult]  # verdicts of the drift test
    routine: dict[str, list[StoredResult]]  # results that come by schedule; key: their kind
    budget: Sources | str  # of the calibration in force; why it is not known

    @property
    def records(self) -> list[StoredResult]:
        """All of them."""
        single = [record for record in (self.status, self.calibration) if record is not None]
        listed = [*self.calibrations, *self.windows, *self.drift]
        return [*single, *listed, *(record for records in self.routine.values() for record in records)]


@dataclass(frozen=True, slots=True)
class Overview:
    """Content of a data directory: sensors by name, and (name, size in bytes) of each recording in order.

    `evidence`: sentences on what is signed; `refused`: whether a result was refused.
    """

    data_dir: Path
    sensors: dict[str, SensorHistory]
    recordings: list[tuple[str, int]]
    evidence: list[str]
    refused: bool


def read_overview(data_dir: Path, limit: int, public_key: Path | None = None) -> Overview:
    """Read a data directory, with the newest `limit` results of each kind. Raises StoreError, KeyFileError.

    `public_key`: only results that it signed.
    """
    from agent.delivery.evidence import evidence, signed_with
    from agent.recording.files import recordings

    keys = _keys(public_key)
    with History(data_dir / FILE_NAME, keys, signed_only=keys is not None) as history:
        history.check()
        memories = history.memories()
        in_force = {record.sensor: record for record in history.latest() if record.what == "calibration"}
        sensors = {
            sensor: SensorHistory(
                status=next(iter(history.newest(sensor, "status", limit=1)), None),
                calibration=in_force.get(sensor),
                calibrations=calibrations(history, sensor, limit=limit),
                windows=history.newest(sensor, "window", limit=limit),
                drift=history.newest(sensor, "drift", limit=limit),
                routine={w: history.newest(sensor, w, limit=limit) for w, kind in RESULTS.items() if kind.routine},
                budget=_budget(in_force.get(sensor), memories),
            )
            for sensor in sorted({sensor for sensor, _ in history.channels() if sensor})
        }
        shown = [record for held in sensors.values() for record in held.records]
        said = evidence(history, shown, data_dir)
        if keys is None and (signers := signed_with(shown)):
            said.append(signers)
    sizes = []
    for _, path in recordings(data_dir):
        with contextlib.suppress(FileNotFoundError):  # the agent renames a file when it closes it
            sizes.append((path.name, path.stat().st_size))
    return Overview(data_dir, sensors, sizes, said, bool(history.refused))


def as_object(overview: Overview) -> dict[str, Any]:
    """The overview as a JSON object. Results have the same fields as published ones (agent.core.events)."""
    return {
        "version": __version__,
        "data_dir": str(overview.data_dir),
        "sensors": {
            sensor: {
                "status": held.status.fields if held.status else None,
                "calibration": held.calibration.fields if held.calibration else None,
                "budget": _budget_object(held.budget),
                "history": [record.fields for record in held.calibrations],
                "windows": [record.fields for record in held.windows],
                "drift": [record.fields for record in held.drift],
                **{what: [record.fields for record in records] for what, records in held.routine.items()},
            }
            for sensor, held in overview.sensors.items()
        },
        "recordings": [
            {"file": name, "size_bytes": octets, "finished": name.endswith(".mcap")}
            for name, octets in overview.recordings
        ],
        "evidence": overview.evidence,
    }


def _print(overview: Overview) -> None:
    from agent.terminal.console import TextConsole

    console = TextConsole()
    if not overview.sensors:
        console.print_line(f"{overview.data_dir}: no results yet")
    for sensor, held in overview.sensors.items():
        _print_sensor(console, sensor, held)
    names = [name for name, _ in overview.recordings]
    span = f": {' to '.join(dict.fromkeys((names[0], names[-1])))}" if names else ""
    total = size(sum(octets for _, octets in overview.recordings))
    console.print_line(f"{counted(len(names), 'recordings')} in {overview.data_dir}, {total}{span}")
    for sentence in overview.evidence:
        console.print_line(sentence)


def _print_sensor(console: TextConsole, sensor: str, held: SensorHistory) -> None:
    from rich.text import Text

    from agent.terminal.wording import STATUS_STYLES, calibration_cells, result_lines, verdict, window_span

    name, said = "UNCALIBRATED", "no status yet"
    if held.status and isinstance(status := held.status.result, StatusChange):
        name, said = status.status, one_line(f"since {_time(status.t_utc_ns)}  {status.reason}")
    status_text = (one_line(name), STATUS_STYLES.get(name, "cyan"))
    heading = Text.assemble((one_line(sensor), "bold"), "  ", status_text, f"  {said}")
    console.print(heading, soft_wrap=True)
    if held.calibration and isinstance(calibration := held.calibration.result, CalibrationUpdate):
        _print_calibration(console, calibration, held.budget)
    else:
        console.print("  no calibration in force")
    console.print("  newest calibrations" if held.calibrations else "  no calibration yet", style="dim")
    for record in held.calibrations:
        if isinstance(update := record.result, CalibrationUpdate):
            cells = calibration_cells(update)
            main = "  ".join(f"S{axis}{axis} {cells[i][i]}" for i, axis in enumerate("xyz"))
            console.print_line(f"    {_time(update.date_utc_ns)}  {update.windows:3d} windows  {main}")
    console.print("  newest windows" if held.windows else "  no window yet", style="dim")
    for record in held.windows:
        if isinstance(window := record.result, WindowReport):
            words = f"{window_span(window)}  {window.position}  {verdict(window)}"
            console.print_line(f"    {_time(window.t_utc_ns)}  {words}")
    for what, records in held.routine.items():
        console.print(f"  newest {what} results" if records else f"  no {what} result yet", style="dim")
        for record in records:
            words = result_lines(record.result, None)[0].removeprefix(f"{sensor}: ")
            console.print_line(f"    {_time(record.t_utc_ns)}  {words}")
    console.print()


def _print_calibration(console: TextConsole, calibration: CalibrationUpdate, budget: Sources | str) -> None:
    from agent.terminal.wording import calibration_cells, uncertainty_words
    from calib.output_unit import shown_in
    from calib.rounding import aligned

    rows = [(axis, *cells) for axis, cells in zip("xyz", calibration_cells(calibration), strict=True)]
    for line in (
        *aligned([("", "Sx", "Sy", "Sz", "Q"), *rows]),
        f"{shown_in(calibration.output_unit).words}, {uncertainty_words(calibration)}",
        f"method {calibration.method}, {counted(calibration.windows, 'windows')}, {_since(calibration)}",
        f"of {calibration.identity}",
        *_budget_lines(budget, calibration.output_unit),
    ):
        console.print_line(f"  {line}")


def _budget(in_force: StoredResult | None, memories: Sequence[Memory]) -> Sources | str:
    from agent.core.past import PastError, budget_in_force

    if in_force is None or not isinstance(update := in_force.result, CalibrationUpdate):
        return "no calibration is in force"
    try:
        return budget_in_force(update, memories)
    except PastError as error:
        return str(error)


def _budget_object(budget: Sources | str) -> dict[str, Any]:
    """Standard uncertainties of S row by row, then Q, by source."""
    if isinstance(budget, str):
        return {"none": budget}
    return {
        "standard_uncertainty": {source: u.tolist() for source, u in budget.by_source.items()},
        "coverage_factor": budget.coverage_factor,
        "degrees_of_freedom": budget.degrees_of_freedom.tolist(),
    }


def _budget_lines(budget: Sources | str, unit: str, most: int | None = SOURCES_SHOWN) -> Iterator[str]:
    """The largest sources of U (`most`; None: all), each with its part of U of the main sensitivities and of Q."""
    from calib.model import PARAMETERS
    from calib.output_unit import shown_in
    from calib.rounding import aligned, rounded

    if isinstance(budget, str):
        yield f"what makes U is not known: {budget}"
        return
    chosen = [0, 4, 8, 9, 10, 11]
    factors = budget.coverage_factor * shown_in(unit).factors
    largest = list(budget.by_source.items())[:most]
    heading = "sources" if most is None else "largest sources"
    rows = [(source, *map(rounded, (factors * u)[chosen].tolist())) for source, u in largest]
    yield from aligned([(heading, *(f"U({PARAMETERS[k]})" for k in chosen)), *rows])


def _since(calibration: CalibrationUpdate) -> str:
    if not calibration.made_sequence:
        return f"in force since {_time(calibration.t_utc_ns)}"
    return f"made {_time(calibration.made_utc_ns)}, in force again since {_time(calibration.t_utc_ns)}"


def _time(t_utc_ns: int) -> str:
    return dt.datetime.fromtimestamp(t_utc_ns / 1e9, dt.UTC).strftime("%Y-%m-%d %H:%M:%S UTC")
