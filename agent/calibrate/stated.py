"""The options of `fieldcal calibrate` as `calib` takes them."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import fields
from pathlib import Path
from typing import Any

import click
import numpy as np

from agent.config.earlier import EarlierError, read_earlier
from agent.reading.source import TableError
from calib.model import Array
from calib.recorded.certificate import ReferenceCertificate
from calib.recorded.errors import OptionError
from calib.recorded.options import Options
from calib.recorded.priors import prior_of

FILES = ("prior", "reference_certificate")  # parameters that name a file with options
NAMES = {"gravity": "gravity_mps2"}  # of parameters whose option has another name


def options_of(params: Mapping[str, Any]) -> Options:
    """The options by the parameters of the command; one that is missing has its default.

    Raises TableError if a file that they name cannot be read, click.BadParameter if a rotation is none.
    """
    named = {f.name: params.get(NAMES.get(f.name, f.name)) for f in fields(Options)}
    convert: dict[str, Callable[[Any], Any]] = {
        "method": int, "static_sign": int, "rotation": _rotation, "prior": read_prior,
        "reference_certificate": _reference_certificate,
    }  # fmt: skip
    told = {name: convert[name](value) if name in convert else value
            for name, value in named.items() if value is not None}  # fmt: skip
    return Options(**told)


def read_prior(path: Path) -> tuple[Array, Array]:
    """Values and covariance from an earlier result or certificate, as `prior_of` gives them. Raises TableError."""
    try:
        return prior_of(*read_earlier(path, joint=True))
    except OptionError as error:
        raise TableError(f"{path}: {error.problem}; {error.remedy}") from None
    except EarlierError as error:
        raise TableError(str(error)) from None


def _reference_certificate(path: Path) -> ReferenceCertificate:
    """As `read_reference_certificate`, which loads pydantic and the configuration: few commands name a certificate."""
    from agent.calibrate.reference_certificate import read_reference_certificate

    return read_reference_certificate(path)


def _rotation(text: str) -> Array:
    try:
        return np.array([float(part) for part in text.split(",")]).reshape(3, 3)
    except ValueError:
        raise click.BadParameter(f"{text!r} must be nine numbers r11,r12,...,r33", param_hint="--rotation") from None
