"""The options for TLS certificates that several commands have."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import click

from agent.config.tls import TlsFiles, tls_faults

_FILE = click.Path(exists=True, dir_okay=False)


def tls_options(command: Callable[..., Any]) -> Callable[..., Any]:
    """Add the options `--ca`, `--certificate` and `--certificate-key`; pass their values to `tls_files`."""
    for name, help_text in (
        ("--certificate-key", "Private key of --certificate (PEM)."),
        ("--certificate", "Certificate that is shown to the router (PEM), see `fieldcal keys`."),
        ("--ca", "Certificate of the trusted authority (PEM), for endpoints tls/..."),
    ):
        command = click.option(name, type=_FILE, metavar="F", help=help_text)(command)
    return command


def tls_files(
    endpoints: tuple[str, ...], ca: str | None, certificate: str | None, certificate_key: str | None
) -> TlsFiles | None:
    """The files that the options name; None where no option is given.

    Raises click.UsageError where an option is missing or the files do not belong together.
    """
    given = (ca, certificate, certificate_key)
    if not any(given):
        if any(endpoint.startswith("tls/") for endpoint in endpoints):
            raise click.UsageError("an endpoint tls/... needs --ca, --certificate and --certificate-key")
        return None
    if not (ca and certificate and certificate_key):
        raise click.UsageError("--ca, --certificate and --certificate-key must be given together")
    files = TlsFiles(ca, certificate, certificate_key)
    if faults := tls_faults(files):
        raise click.UsageError("\n".join(faults))
    return files
