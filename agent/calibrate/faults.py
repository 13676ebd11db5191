"""Tells faults that `calib` found in the words of the command line: lines of files, and options with two dashes."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import click

from agent.reading.source import TableError
from calib.recorded.errors import InputError, OptionError, UnitError


@contextmanager
def as_table_error(place: Callable[[int], str] = "row {}".format) -> Iterator[None]:
    """Raise InputError as TableError, and OptionError as click.UsageError. `place` names the row of a file."""
    try:
        yield
    except OptionError as error:
        raise click.UsageError(with_dashes(str(error))) from None
    except UnitError as error:
        names = ",".join(f"{axis}=NAME:{error.unit or 'UNIT'}" for axis in "xyz")
        exchange = "" if error.unit else "exchange them, or "
        error.remedy = f"{exchange}state the unit with --reference-columns time=NAME,{names}"
        raise TableError(with_dashes(str(error))) from None
    except InputError as error:
        raise TableError(with_dashes(error.message(place))) from None


def with_dashes(text: str) -> str:
    """`u_angle_deg` as --u-angle-deg."""
    return re.sub(r"`(\w+)`", lambda found: "--" + found[1].replace("_", "-"), text)
