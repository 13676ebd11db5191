"""The options by which a command takes its certificates."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import click

from agent.config.tls import TlsFiles, tls_faults

_FILE = click.Path(exists=True, dir_okay=False)


def tls_options(command: Callable[..., Any]) -> Callable[..., Any]:
    """Adds `--ca`, `--certificate` and `--certificate-key`; `tls_files` takes their values."""
    for name, help_text in (
        ("--certificate-key", "The certificate's private key."),
        ("--certificate", "Who we are: PEM, see `fieldcal keys`."),
        ("--ca", "For endpoints tls/..: the authority that is trusted, PEM."),
    ):
        command = click.option(name, type=_FILE, metavar="F", help=help_text)(command)
    return command


def tls_files(
    endpoints: tuple[str, ...], ca: str | None, certificate: str | None, certificate_key: str | None
) -> TlsFiles | None:
    """The files of the options, None where there are none. Raises click.UsageError where they do not fit together."""
    given = (ca, certificate, certificate_key)
    if not any(given):
        if any(endpoint.startswith("tls/") for endpoint in endpoints):
            raise click.UsageError("an endpoint tls/.. needs --ca, --certificate and --certificate-key")
        return None
    if not (ca and certificate and certificate_key):
        raise click.UsageError("--ca, --certificate and --certificate-key go together")
    files = TlsFiles(ca, certificate, certificate_key)
    if faults := tls_faults(files):
        raise click.UsageError("\n".join(faults))
    return files
