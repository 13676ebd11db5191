"""The name or address of another machine, as an option of a driver or a setting states it."""

from __future__ import annotations

import re
from typing import Annotated

from pydantic import AfterValidator

_HOST = re.compile(r"[^\s/\x00]{1,255}")


def _host(value: str) -> str:
    with_port = value.count(":") == 1  # an IPv6 address has more
    if not _HOST.fullmatch(value) or with_port:
        raise ValueError("give the name or address alone, as in broker.example.org; the port is a setting of its own")
    return value


Host = Annotated[str, AfterValidator(_host)]
