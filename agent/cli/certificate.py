"""`fieldcal certificate`: a calibration certificate as PDF, HTML, DCC XML and JSON. It needs the extra `report`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import click

from agent.cli.data_dir import DATA_DIR, files_or
from agent.config.key_file import KeyFileError, load_private_key
from agent.config.reading import ConfigError
from agent.config.whole_files import status_of, write_whole
from agent.terminal.text import say

_FILE = click.Path(path_type=Path, dir_okay=False)


@click.command()
@click.argument("inputs", nargs=-1, type=click.Path(path_type=Path), metavar="[INPUT...]")
@click.option("--stated", type=_FILE, metavar="certificate.toml",
              help="What only people know: organisation, customer, serial numbers, dates.")  # fmt: skip
@click.option("--state", "entries", multiple=True, metavar="ENTRY=VALUE",
              help="One of these statements, as customer.city=Pescara; repeat it for more.")  # fmt: skip
@DATA_DIR
@click.option("-o", "--output", type=click.Path(path_type=Path, file_okay=False), required=True, metavar="DIR",
              help="Directory for certificate.pdf, .html, .xml and .json.")  # fmt: skip
@click.option("--key", type=_FILE, help="Ed25519 private key (PEM) that signs the certificate.")
@click.option("--x509-key", type=_FILE, help="RSA or EC private key (PEM) that signs the certificate's files as CMS.")
@click.option("--x509-certificate", type=_FILE, help="Its X.509 certificate (PEM), then those of the authorities.")
@click.option("--xsd", type=_FILE, help="dcc.xsd of PTB, with SI_Format.xsd beside it: the XML is checked against it.")
@click.option("--sensor", metavar="NAME", help="The sensor, if the input has several.")
def certificate(inputs: tuple[Path, ...], data_dir: Path | None, output: Path, **options: Any) -> int:
    """Make a calibration certificate.

    --stated names the file with what only people know, such as examples/certificate.toml; docs/certificate.md explains
    each entry. Entries that are in neither --stated nor --state are asked on a terminal. What is not only in a file is
    kept in DIR/certificate.toml: give it as --stated the next time.

    INPUT is RESULT.json of `fieldcal calibrate --json RESULT.json`, or a recording (several of one sensor are read one
    after the other). Of --data-dir the calibration in force is certified.

    Exit status 3 if the data were refused: then there is no certificate. 2 if the input cannot be used.
    """
    return make(files_or(data_dir, inputs, "INPUT"), output, CertificateOptions(**options))


@dataclass(frozen=True, kw_only=True)
class CertificateOptions:
    """The values of the options."""

    stated: Path | None
    entries: Sequence[str] = ()
    key: Path | None = None
    x509_key: Path | None = None
    x509_certificate: Path | None = None
    xsd: Path | None = None
    sensor: str | None = None

    @property
    def x509(self) -> tuple[Path, Path] | None:
        """Key and certificate. Raises click.UsageError where one of them is missing."""
        if (self.x509_key is None) != (self.x509_certificate is None):
            raise click.UsageError("--x509-key and --x509-certificate must be given together")
        return (self.x509_key, self.x509_certificate) if self.x509_key and self.x509_certificate else None


def make(inputs: Sequence[Path], output: Path, options: CertificateOptions) -> int:
    """Make a certificate of `inputs` in the directory `output`, and say so; the exit status of the command."""
    stated, x509_files = options.stated, options.x509
    if not drawable():
        return 1
    from agent.certificate.content import CertificateError
    from agent.certificate.making import certificate_of
    from agent.certificate.schema import SchemaError
    from agent.certificate.stating import gather_statements
    from agent.certificate.writing import write
    from agent.certificate.x509 import X509Signer
    from agent.report.material import MaterialError, gather
    from agent.report.writing import left_over
    from agent.setup.asking import Interview

    try:
        private = None if options.key is None else load_private_key(options.key)
        x509 = X509Signer.load(*x509_files) if x509_files else None
        material = gather(inputs, options.sensor)
        if len(material.results) > 1:
            raise MaterialError("a certificate is of one result; give one RESULT.json")
        if material.results[0].refused:
            return _say_refusal(material.results[0].reasons)
        told, text = gather_statements(stated, options.entries, Interview())
        beside = Path() if stated is None else stated.parent
        made = certificate_of(material, told, beside, left_over(material))
        written = write(made, output, private, options.xsd, x509)
        written += _keep_statements(text, output / "certificate.toml", stated)
    except (ConfigError, KeyFileError, MaterialError, SchemaError, CertificateError, OSError) as error:
        for line in _fault_lines(
            error, f"{stated or '--state'}: " if isinstance(error, CertificateError) else "", output
        ):
            say(f"fieldcal certificate: {line}", err=True)
        return status_of(error)
    for notice in material.notices:
        say(f"fieldcal certificate: {notice}", err=True)
    for warning in made.result.warnings:
        say(f"fieldcal certificate: a warning of the certificate: {warning}", err=True)
    for path in written:
        say(str(path))
    return 0


def _say_refusal(reasons: Sequence[str]) -> int:
    for reason in reasons:
        say(f"refused: {reason}", err=True)
    return 3


def _fault_lines(error: Exception, place: str, output: Path) -> list[str]:
    if isinstance(error, OSError):
        return [f"{error.filename or output}: {error.strerror}"]
    return [f"{place}{error}"] if place else str(error).splitlines()


def drawable() -> bool:
    """Whether matplotlib is installed, which draws the PDF; if not, say what installs it."""
    try:
        import matplotlib  # noqa: F401 - imported to check for it before any other work
    except ImportError:
        told = "the PDF needs matplotlib; install it with: fieldcal extras --install report"
        say(f"fieldcal certificate: {told}", err=True)
        return False
    return True


def _keep_statements(text: str, path: Path, stated: Path | None) -> list[Path]:
    """Write the statements into the directory of the certificate, but not over the file that states the others."""
    if not text or (stated is not None and stated.resolve() == path.resolve()):
        return []
    write_whole(path, text.encode())
    return [path]
