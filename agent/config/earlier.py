"""Reads S, Q and their covariance of an earlier calibration: a result, a certificate in JSON, or a DCC of ours in XML.

XML is read without document types and entities: nothing in it can name another file, and nothing in it expands.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from agent.config.files import read_file
from agent.config.strict_json import strict
from agent.config.xml import XmlError, check_xml
from calib.model import PARAMETERS, Array

if TYPE_CHECKING:
    from xml.etree.ElementTree import Element

LARGEST = 64 << 20  # bytes; a result lists all its windows, each with 0.3 kB
DCC, SI = "https://ptb.de/dcc", "https://ptb.de/si"  # namespaces
PARAMETER_LIST, COVARIANCE = "fieldcal_parameters", "fieldcal_covariance"  # refType of what is ours in a DCC
LARGEST_VALUE = 1e60  # of a sensitivity, an offset or a variance; products of several of them stay finite
ASYMMETRIC = 1e-6  # relative to the standard uncertainties; values are written with more digits
TINY = np.finfo(float).tiny
MAIN = [0, 4, 8]  # places of the main sensitivities among the parameters


class EarlierError(Exception):
    """The file does not say S and Q. The message names the file, the reason and the remedy."""


def read_earlier(path: Path, *, joint: bool = False) -> tuple[Array, Array]:
    """S row by row and Q (12,), and their covariance (12, 12); NaN where nothing is known. Raises EarlierError.

    `joint`: with what a result knows of combinations of elements of S, of which single ones are not known.
    """
    try:
        data = read_file(path, LARGEST)
        is_xml = data.lstrip(b"\xef\xbb\xbf \t\r\n").startswith(b"<")
        return _checked(*(_from_xml(data) if is_xml else _from_json(data, joint)))
    except OSError as error:
        raise EarlierError(f"{path}: {error.strerror}") from None
    except _OtherXmlError as error:
        raise EarlierError(f"{path}: {error}") from None
    except (ValueError, KeyError, TypeError, AttributeError, OverflowError, RecursionError) as error:
        raise EarlierError(
            f"{path}: the file is neither a result of `fieldcal calibrate --json -` "
            f"nor a certificate of `fieldcal certificate`: {error}"
        ) from None


def identity_in(path: Path) -> tuple[str, str]:
    """Serial number of the calibrated instrument and last day of its calibration; "" where the file states none.

    Only for a file that `read_earlier` read. Raises OSError.
    """
    data = read_file(path, LARGEST)
    if data.lstrip(b"\xef\xbb\xbf \t\r\n").startswith(b"<"):
        root = _parsed(data)
        item = "/".join(f"{{{DCC}}}{tag}" for tag in ("item", "identifications", "identification", "value"))
        return root.findtext(f".//{item}") or "", root.findtext(f".//{{{DCC}}}endPerformanceDate") or ""
    told = json.loads(data)
    return _text(told, "instrument", "serial_number"), _text(told, "dates", "ended")


def _text(told: Any, *names: str) -> str:
    """A text among the statements of a certificate in JSON."""
    for name in ("certificate", "stated", *names):
        told = told.get(name, "") if isinstance(told, dict) else ""
    return told if isinstance(told, str) else ""


class _OtherXmlError(Exception):
    """XML without S and Q as this program writes them."""


def _from_json(data: bytes, joint: bool) -> tuple[Array, Array]:
    told: dict[str, Any] = strict(data)
    if "certificate" in told:
        told = told["certificate"]["result"]
    if joint:
        told = told.get("joint") or told
    S, Q, covariance = (_numbers(told, name) for name in ("sensitivity", "offset", "covariance"))
    if (S.shape, Q.shape, covariance.shape) != ((3, 3), (3,), (12, 12)):
        raise ValueError("sensitivity must have 3 x 3 numbers, offset 3 and covariance 12 x 12")
    return np.append(S.ravel(), Q), covariance


def _numbers(told: dict[str, Any], name: str) -> Array:
    """Numbers, and NaN for null; texts and booleans are none. Raises ValueError."""
    values = np.array(told[name], dtype=object)
    if not all(value is None or type(value) in (int, float) for value in values.ravel()):
        raise ValueError(f"{name} must have numbers or null alone")
    return values.astype(float)


def _checked(values: Array, covariance: Array) -> tuple[Array, Array]:
    """The same. Raises ValueError where they are no values with a covariance."""
    if np.nanmax(np.abs(np.append(values, covariance)), initial=0.0) > LARGEST_VALUE:
        raise ValueError(f"a value is larger than {LARGEST_VALUE:g}")
    u = np.sqrt(np.abs(np.diag(covariance)))
    if np.nanmax(np.abs(covariance - covariance.T) / np.maximum(np.outer(u, u), TINY), initial=0.0) > ASYMMETRIC:
        raise ValueError("the covariance is not symmetric")
    return values, covariance


def _parsed(data: bytes) -> Element:
    from xml.etree import ElementTree  # few configurations name a certificate in XML

    try:
        return ElementTree.fromstring(check_xml(data))
    except (XmlError, ElementTree.ParseError) as error:
        raise _OtherXmlError(f"{error}" if isinstance(error, XmlError) else f"the XML is broken: {error}") from None


def _from_xml(data: bytes) -> tuple[Array, Array]:
    root = _parsed(data)
    if root.tag != f"{{{DCC}}}digitalCalibrationCertificate":
        raise _OtherXmlError("the XML is no digital calibration certificate (DCC)")
    quantity = root.find(f".//{{{DCC}}}quantity[@refType='{COVARIANCE}']/{{{SI}}}realListXMLList")
    if quantity is None:
        raise _OtherXmlError(
            f"the DCC has no quantity with refType {COVARIANCE}, so it is not from `fieldcal certificate`; "
            "state its sensitivity and uncertainty by hand (calibrate: --nominal; configuration: prior or certificate)"
        )
    labels = (quantity.findtext(f"{{{SI}}}labelXMLList") or "").split()
    columns = quantity.findall(f".//{{{SI}}}column")
    told = [[float(entry.text or "") for entry in column.iter(f"{{{SI}}}value")] for column in columns]
    read = np.array((quantity.findtext(f"{{{SI}}}valueXMLList") or "").split(), dtype=float)
    if len(set(labels)) != len(labels) or read.shape != (len(labels),) or np.shape(told) != (len(labels), len(labels)):
        raise _OtherXmlError(f"{COVARIANCE}: there must be as many values, columns and rows as labels, each label once")
    places = [PARAMETERS.index(label) for label in labels]
    values, covariance = np.full(12, np.nan), np.full((12, 12), np.nan)
    values[places] = read
    covariance[np.ix_(places, places)] = np.transpose(told)
    return values, covariance
