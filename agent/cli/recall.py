"""`fieldcal recall`: corrects the results that rest on one reference by a new certificate of this reference."""

from __future__ import annotations

from pathlib import Path

import click
import msgspec

from agent.cli.data_dir import DATA_DIR, files_or
from agent.config.key_file import KeyFileError, load_private_key
from agent.config.whole_files import status_of
from agent.terminal.text import say

_FILE = click.Path(path_type=Path, dir_okay=False)


@click.command()
@click.argument("paths", nargs=-1, type=click.Path(path_type=Path), metavar="[PATH...]")
@DATA_DIR
@click.option("--reference", "serial_number", required=True, metavar="SERIAL", help="Serial number of the reference.")
@click.option("--new", "new_certificate", type=_FILE, required=True, metavar="CERTIFICATE",
              help="TOML with [certificate], or JSON or DCC of `fieldcal certificate`.")  # fmt: skip
@click.option("-o", "--output", type=click.Path(path_type=Path, file_okay=False), required=True, metavar="DIR",
              help="New directory for the corrected results.")  # fmt: skip
@click.option("--signing-key", type=_FILE, help="Ed25519 private key (PEM) that signs each file.")
@click.option("--json", "json_to", type=click.Choice(["-"]), help="Print one JSON object on standard output.")
def recall(
    paths: tuple[Path, ...], data_dir: Path | None, serial_number: str, new_certificate: Path, output: Path,
    signing_key: Path | None, json_to: str | None,
) -> int:  # fmt: skip
    """Say which results rest on a reference, and correct them by its new certificate. Old files stay as they are.

    PATH is a recording, or a JSON of `fieldcal calibrate` or `fieldcal certificate`. --data-dir names the data
    directory of an agent; several directories are given as PATH.

    Exit status 0 if all results that rest on the reference were corrected, 3 if some cannot be corrected, 2 if an input
    cannot be used.
    """
    from agent.calibrate.reference_certificate import read_reference_certificate
    from agent.certificate.recall import RecallError, recalled, results_in, write
    from agent.delivery.history import StoreError
    from agent.reading.source import TableError

    paths = files_or(data_dir, paths, "PATH")
    try:
        new = read_reference_certificate(new_certificate)
        if new.serial_number not in ("", serial_number):
            raise RecallError(
                f"{new_certificate}: the certificate is of serial number {new.serial_number}, not {serial_number}"
            )
        key = None if signing_key is None else load_private_key(signing_key)
        found = [result for path in paths for result in results_in(path)]
        summary = write(recalled(found, serial_number, new), output, key)
    except (RecallError, TableError, StoreError, KeyFileError) as error:
        for line in str(error).splitlines():
            say(f"fieldcal recall: {line}", err=True)
        return 2
    except OSError as error:
        say(f"fieldcal recall: {error.filename or output}: {error.strerror or error}", err=True)
        return status_of(error)
    listed = summary["results"]
    if json_to is not None:
        click.echo(msgspec.json.encode({"results_read": len(found), **summary}).decode())
    else:
        say(f"{len(listed)} of {len(found)} results rest on the reference {serial_number}")
        say(f"{summary['corrected']} of them corrected, in {output}")
    for entry in listed:
        if entry["file"] is None:
            say(f"fieldcal recall: {entry['source']}, {entry['name']}: {entry['reason']}", err=True)
    return 0 if summary["corrected"] == len(listed) else 3
