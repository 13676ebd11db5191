"""`fieldcal export`: samples of recordings for other programs, and topics that plot programs show."""

from __future__ import annotations

from pathlib import Path

import click

from agent.terminal.text import say

_FILE = click.Path(path_type=Path, dir_okay=False)


@click.command()
@click.argument("recordings", nargs=-1, required=True, type=_FILE, metavar="RECORDING...")
@click.option(
    "--to", type=_FILE, metavar="FILE", help="Table of samples: .csv, .parquet, .wav or .mseed; it must not exist."
)
@click.option("--mcap", type=_FILE, metavar="FILE", help="Topics of ROS 2 for plot programs; it must not exist.")
@click.option("--device", metavar="NAME", help="The device. Default: the only sensor of the recordings.")
@click.option(
    "--rate-hz", type=click.FloatRange(min=0.01, max=1e6), default=100.0, show_default=True,
    help="Messages per second in --mcap, each the mean of the samples in its interval.",
)  # fmt: skip
def export(recordings: tuple[Path, ...], to: Path | None, mcap: Path | None, device: str | None, rate_hz: float) -> int:
    """Write the samples of RECORDING (several: in the order given) with the times of their clock.

    A sensor has its indications and, where it was calibrated, accelerations by the newest calibration.

    Exit status 0 if the files are written, 2 on bad input.
    """
    from agent.export.plots import write_plots
    from agent.export.samples import ExportError, content_of, samples
    from agent.export.seismic import write_mseed
    from agent.export.tables import write_csv, write_parquet, write_wav

    formats = {".csv": write_csv, ".parquet": write_parquet, ".wav": write_wav, ".mseed": write_mseed}
    if to is None and mcap is None:
        raise click.UsageError("nothing to write; add --to FILE, --mcap FILE, or both")
    if to is not None and to.suffix not in formats:
        raise click.BadParameter(f"{to}: the ending must be one of {', '.join(formats)}", param_hint="--to")
    try:
        content = content_of(recordings, device)
        for fault in content.faults:
            say(f"fieldcal export: {fault}", err=True)
        if not content.calibrations and content.axes == 3:
            say(f"fieldcal export: {content.device} has no calibration: no accelerations are written", err=True)
        if to is not None:
            rows = formats[to.suffix](to, content, samples(recordings, content))
            say(f"{to}: {rows} samples of {content.device}")
        if mcap is not None:
            count = write_plots(mcap, content, samples(recordings, content), rate_hz)
            say(f"{mcap}: {count} messages of {content.device} at {rate_hz:g} Hz")
    except ExportError as error:
        say(f"fieldcal export: {error}", err=True)
        return 2
    except FileExistsError as error:
        say(f"fieldcal export: {error.filename}: the file exists; remove it, or choose another name", err=True)
        return 2
    except OSError as error:
        say(f"fieldcal export: {error.filename or to or mcap}: {error.strerror}", err=True)
        return 2
    return 0
