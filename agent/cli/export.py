"""`fieldcal export`: samples of recordings for other programs, and topics that plot programs show."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import click

from agent.cli.data_dir import DATA_DIR
from agent.cli.finite import Finite
from agent.cli.rules import check_rules
from agent.config.whole_files import status_of
from agent.terminal.text import say

if TYPE_CHECKING:
    from agent.core.events import CalibrationUpdate
    from agent.export.between_visits import BetweenVisits
    from agent.export.samples import RecordedContent
    from agent.export.smoothing import Smoothed

ENDINGS = (".csv", ".parquet", ".uff", ".mseed")
NUMBERED = ENDINGS[:2]  # the formats that can name a calibration for each sample
MOST_CALIBRATIONS = 10_000  # of a sensor, that are asked of a data directory
EPOCHS = ".xml"  # has no samples

_FILE = click.Path(path_type=Path, dir_okay=False)


@click.command()
@click.argument("recordings", nargs=-1, required=True, type=_FILE, metavar="RECORDING...")
@click.option(
    "-o",
    "--to",
    type=_FILE,
    metavar="FILE",
    help="Table of samples: .csv, .parquet, .uff or .mseed; with --corrected also .xml: the epochs of S and Q as "
    "StationXML. It must not exist.",
)
@click.option("--mcap", type=_FILE, metavar="FILE", help="Topics of ROS 2 for plot programs; it must not exist.")
@click.option("--device", metavar="NAME", help="The device. Default: the only sensor of the recordings.")
@click.option(
    "--rate-hz",
    type=click.FloatRange(min=0.01, max=1e6),
    default=100.0,
    show_default=True,
    help="Messages per second in --mcap, each the mean of the samples in its interval.",
)
@click.option(
    "--corrected",
    is_flag=True,
    help="Accelerations by S(t) and Q(t), smoothed over the past: by all windows up to the end of the recordings, or "
    "without a reference by the calibrations before and after.",
)
@click.option(
    "--place",
    nargs=3,
    type=(Finite(-90.0, 90.0), Finite(-180.0, 180.0), Finite()),
    metavar="LATITUDE LONGITUDE ELEVATION",
    help="Where the sensor is, in degrees and m, for StationXML.",
)
@click.option(
    "--site-verdicts", type=_FILE, metavar="FILE",
    help="What `fieldcal fleet watch --json FILE` tells: U then holds a change that is suspected of the device; with "
    "--corrected it comes at its date.",
)  # fmt: skip
@DATA_DIR
def export(
    recordings: tuple[Path, ...], to: Path | None, mcap: Path | None, device: str | None, rate_hz: float,
    corrected: bool, place: tuple[float, float, float] | None, site_verdicts: Path | None, data_dir: Path | None,
) -> int:  # fmt: skip
    """Write the samples of RECORDING (several of one gateway: the oldest first) with the times of their clock.

    A sensor has its indications and, where it was calibrated, accelerations by the newest calibration. With --corrected
    they are those by S and Q at the time of each sample, by all windows before and after it, and each sample has the
    number of the calibration that was in force then; the head of the file says what the smoothing follows from. The
    windows are those up to the end of the recordings, or with --data-dir all that the agent has kept. A sensor without
    a reference has S and Q between its calibrations, with the step that --site-verdicts tells at its date. With the
    ending .xml the epochs of S and Q themselves are written, as StationXML for the channels that .mseed has.

    Exit status 0 if the files are written, 2 on bad input.
    """
    from agent.delivery.history import StoreError
    from agent.export.at_the_end import in_order_of
    from agent.export.samples import ExportError, content_of
    from agent.site_watch.source import WatchError

    _check(to, mcap, place, data_dir, site_verdicts, corrected=corrected)
    try:
        recordings = tuple(in_order_of(recordings))
        content = content_of(recordings, device)
        told = list(content.calibrations)
        _suspect(recordings, content, site_verdicts)
        if corrected:
            _check_axes(recordings, content)
        if to is not None and to.suffix == EPOCHS and place is not None:
            _write_epochs(recordings, content, to, place, data_dir)
            return 0
        if corrected:
            content.smoothed = _smoothed(recordings, content, told, data_dir)
        for fault in content.faults:
            say(f"fieldcal export: {fault}", err=True)
        if not (content.calibrations or corrected) and content.axes == 3:
            say(f"fieldcal export: {content.device} has no calibration: no accelerations are written", err=True)
        _write(recordings, content, to, mcap, rate_hz)
        for why, number in content.left_out.items():
            say(f"fieldcal export: {number} samples have no acceleration: {why}", err=True)
    except (ExportError, StoreError, WatchError, OSError) as error:
        say(f"fieldcal export: {_fault_line(error, to or mcap)}", err=True)
        return status_of(error)
    return 0


def _fault_line(error: Exception, written: Path | None) -> str:
    if isinstance(error, FileExistsError):
        return f"{error.filename}: the file exists; remove it, or choose another name"
    return f"{error.filename or written}: {error.strerror}" if isinstance(error, OSError) else str(error)


def _check(
    to: Path | None, mcap: Path | None, place: tuple[float, float, float] | None, data_dir: Path | None,
    site_verdicts: Path | None, *, corrected: bool,
) -> None:  # fmt: skip
    """Raise click.UsageError for options that do not go together."""
    ending = None if to is None else to.suffix
    epochs = ending == EPOCHS
    if ending not in (None, *ENDINGS, EPOCHS):
        raise click.BadParameter(f"{to}: the ending must be one of {', '.join([*ENDINGS, EPOCHS])}", param_hint="--to")
    check_rules(
        (to is None and mcap is None, "nothing to write; add --to FILE, --mcap FILE, or both"),
        (corrected and (ending not in (*NUMBERED, EPOCHS) or mcap is not None),
         f"--corrected writes one file with the ending {' or '.join(NUMBERED)}, or {EPOCHS}; name it with -o"),
        (epochs and not corrected, f"{to}: StationXML has the epochs of the past; add --corrected"),
        (epochs and place is None,
         "StationXML wants the place of the sensor; add --place LATITUDE LONGITUDE ELEVATION"),
        (place is not None and not epochs,
         f"--place belongs to StationXML; write a file that ends in {EPOCHS}, or remove --place"),
        (site_verdicts is not None and ending not in (None, *NUMBERED),
         f"{to} has no place for U; with --site-verdicts write {' or '.join(NUMBERED)}, or --mcap"),
        (data_dir is not None and not corrected,
         "--data-dir names the windows for --corrected; add that, or remove --data-dir"),
    )  # fmt: skip


def _write(
    recordings: Sequence[Path], content: RecordedContent, to: Path | None, mcap: Path | None, rate_hz: float
) -> None:
    """Write the files. Raises ExportError, OSError."""
    from agent.export.plots import write_plots
    from agent.export.samples import samples
    from agent.export.seismic import write_mseed
    from agent.export.tables import write_csv, write_parquet
    from agent.export.uff import write_uff

    if to is not None:
        writers = write_csv, write_parquet, write_uff, write_mseed
        rows = dict(zip(ENDINGS, writers, strict=True))[to.suffix](to, content, samples(recordings, content))
        say(f"{to}: {rows} samples of {content.device}")
    if mcap is not None:
        count = write_plots(mcap, content, samples(recordings, content), rate_hz)
        say(f"{mcap}: {count} messages of {content.device} at {rate_hz:g} Hz")


def _suspect(recordings: Sequence[Path], content: RecordedContent, verdicts: Path | None) -> None:
    """Enlarge U by what is suspected of the device. Raises ExportError, WatchError."""
    from agent.export.samples import start_of, suspect
    from agent.site_watch.suspicion import suspicion_of

    if verdicts is None:
        return
    suspect(content, suspicion_of(verdicts, content.device, start_of(recordings[0]).gateway))
    told = "nothing is suspected, so U stays" if content.suspicion is None else content.suspicion.text
    say(f"fieldcal export: {content.device}: {told}", err=True)


def _check_axes(recordings: Sequence[Path], content: RecordedContent) -> None:
    """Raise ExportError for a device without S and Q; go on with the kernels of the recordings."""
    from agent.cli.kernels import compute_as_in
    from agent.export.samples import ExportError

    compute_as_in(recordings[0])
    if content.axes != 3:
        raise ExportError(f"{recordings[0]}: {content.device} has {content.axes} axis; S and Q are those of three axes")


def _write_epochs(
    recordings: Sequence[Path],
    content: RecordedContent,
    to: Path,
    place: tuple[float, float, float],
    data_dir: Path | None,
) -> None:
    """Write the epochs of the past as StationXML. Raises ExportError, StoreError, OSError."""
    from agent.delivery.history import FILE_NAME, History
    from agent.export.past import pasts, pasts_of
    from agent.export.samples import samples, start_of
    from agent.export.seismic import rate_of
    from agent.export.stationxml import StationPlace, write_stationxml

    if data_dir is None:
        found = pasts_of(recordings, [])
    else:
        with History(data_dir / FILE_NAME) as history:
            found = pasts(history)
    for fault in content.faults:
        say(f"fieldcal export: {fault}", err=True)
    own = [one for one in found if one.sensor == content.device]
    rate_hz = next(map(rate_of, samples(recordings, content)), 0.0)
    site = start_of(recordings[0]).site
    count = write_stationxml(to, content, own, site=site, rate_hz=rate_hz, place=StationPlace(*place))
    say(f"{to}: {count} epochs of {content.device}")


def _smoothed(
    recordings: Sequence[Path], content: RecordedContent, told: Sequence[CalibrationUpdate], data_dir: Path | None
) -> Smoothed | BetweenVisits:
    """The past by the states where the recordings end, or by those in a data directory; of a sensor without a
    reference by its calibrations: `told` by the recordings, and those in a data directory. Raises ExportError."""
    from agent.core.events import CalibrationUpdate
    from agent.delivery.calibrations import calibrations
    from agent.delivery.history import FILE_NAME, History
    from agent.export.at_the_end import memories_at_the_end
    from agent.export.between_visits import between_visits
    from agent.export.samples import ExportError, channel_of
    from agent.export.smoothing import smoothed

    channel = channel_of(recordings[-1], content.device)
    if channel is None or not channel.watched:
        if data_dir is None:
            return smoothed(memories_at_the_end(recordings), content.device)
        with History(data_dir / FILE_NAME) as history:
            return smoothed(history.memories(), content.device)
    if data_dir is not None:
        with History(data_dir / FILE_NAME) as history:
            kept = [record.result for record in calibrations(history, content.device, limit=MOST_CALIBRATIONS)]
        told = [*told, *(result for result in kept if isinstance(result, CalibrationUpdate))]
    if not told:
        raise ExportError(f"{content.device}: has no calibration, so that no sample can be corrected")
    return between_visits(channel, told, content.suspicion)
