"""The options for TLS certificates that several commands have."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import wraps
from typing import Any

import click

from agent.config.tls import TlsFiles, tls_faults

_FILE = click.Path(exists=True, dir_okay=False)


@dataclass(frozen=True)
class TlsOptions:
    """The values of the options."""

    ca: str | None
    certificate: str | None
    certificate_key: str | None

    def files(self, endpoints: tuple[str, ...]) -> TlsFiles | None:
        """The files that the options name; None where no option is given.

        Raises click.UsageError where an option is missing or the files do not belong together.
        """
        if not any((self.ca, self.certificate, self.certificate_key)):
            if any(endpoint.startswith("tls/") for endpoint in endpoints):
                raise click.UsageError("an endpoint tls/... needs --ca, --certificate and --certificate-key")
            return None
        if not (self.ca and self.certificate and self.certificate_key):
            raise click.UsageError("--ca, --certificate and --certificate-key must be given together")
        files = TlsFiles(self.ca, self.certificate, self.certificate_key)
        if faults := tls_faults(files):
            raise click.UsageError("\n".join(faults))
        return files


def tls_options(run: Callable[..., int]) -> Callable[..., int]:
    """Add the options `--ca`, `--certificate` and `--certificate-key`; the command gets them as its argument `tls`."""

    @wraps(run)
    def command(*, ca: str | None, certificate: str | None, certificate_key: str | None, **options: Any) -> int:
        return run(tls=TlsOptions(ca, certificate, certificate_key), **options)

    for name, help_text in (
        ("--certificate-key", "Private key of --certificate (PEM)."),
        ("--certificate", "Certificate that is shown to the router (PEM), see `fieldcal keys`."),
        ("--ca", "Certificate of the trusted authority (PEM), for endpoints tls/..."),
    ):
        command = click.option(name, type=_FILE, metavar="F", help=help_text)(command)
    return command
