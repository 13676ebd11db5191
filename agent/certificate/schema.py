"""Checks a DCC against the schemas of PTB, which the user has. Nothing is fetched. It needs the extra `dcc`."""

from __future__ import annotations

from pathlib import Path

from agent.terminal.text import one_line

SI_NAMESPACE, SI_FILE = "https://ptb.de/si", "SI_Format.xsd"
SIGNATURE_NAMESPACE, SIGNATURE_FILE = "http://www.w3.org/2000/09/xmldsig#", "schemas/DSIG/xmldsig-core-schema.xsd"
MOST_FAULTS = 5


class SchemaError(Exception):
    """The XML is not valid by the schema, or the schema cannot be used. The message names the file and the remedy."""


def check_schema(xml: bytes, xsd: Path) -> None:
    """Raises SchemaError with the first faults where the XML is not valid, or where the schema cannot be read."""
    try:
        import xmlschema
    except ImportError:
        raise SchemaError("--xsd needs xmlschema; install it with: fieldcal extras --install dcc") from None
    # The schema names its parts by addresses on the network. The files beside it are taken instead.
    own = Path(xmlschema.__file__).parent / SIGNATURE_FILE
    places = [(SI_NAMESPACE, str((xsd.parent / SI_FILE).resolve())), (SIGNATURE_NAMESPACE, str(own))]
    if not (xsd.parent / SI_FILE).is_file():
        raise SchemaError(f"--xsd {xsd}: {SI_FILE} must be beside it; PTB has it at https://ptb.de/si")
    try:
        schema = xmlschema.XMLSchema(str(xsd.resolve()), locations=places, allow="local", defuse="always")
    except (xmlschema.XMLSchemaException, OSError, ValueError, SyntaxError) as error:
        raise SchemaError(f"--xsd {xsd}: cannot be read: {one_line(str(error))[:200]}") from None
    faults = [
        f"{fault.path}: {fault.reason}" for _, fault in zip(range(MOST_FAULTS), schema.iter_errors(xml), strict=False)
    ]
    if faults:
        raise SchemaError(f"--xsd {xsd}: the DCC is not valid: {one_line('; '.join(faults))}")
