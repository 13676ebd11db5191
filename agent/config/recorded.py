"""The configuration in a recording, also in one that an older version of the program wrote."""

from __future__ import annotations

import json
import re
from typing import Any

from pydantic import ValidationError

from agent.config.size import size_faults
from agent.config.whole import Config
from calib.estimate.quantities import YEAR_DAYS

DATE = re.compile(r"\d{4}-\d{2}-\d{2}")


def recorded_config(text: str) -> Config:
    """The configuration from its JSON text. Raises ValueError if it is none.

    Before version 0.2 the drift of the reference was `process.reference_pct`, per square-root day, and
    `certificate.calibrated` was any text: what is no date counts as not stated.
    """
    try:
        raw: Any = json.loads(text)
    except RecursionError:
        raise ValueError("its tables or lists are nested too deep to be read") from None
    if too_large := size_faults(raw):
        raise ValueError(f"{'.'.join(map(str, too_large[0][0]))} {too_large[0][1]}".strip())
    if not isinstance(raw, dict):
        raise ValueError("the configuration is no table")
    channels = raw.get("channels")
    for channel in channels if isinstance(channels, list) else ():
        _renew(channel)
    try:
        return Config.model_validate(raw)
    except ValidationError as error:
        first = error.errors()[0]
        raise ValueError(f"{'.'.join(map(str, first['loc']))}: {first['msg']}".removeprefix(": ")) from None


def _renew(channel: object) -> None:
    """Change what version 0.1 wrote into what is written today. What is no table is left to the validation."""
    process, certificate = (
        channel.get(name) if isinstance(channel, dict) else None for name in ("process", "certificate")
    )
    if not isinstance(process, dict) or not isinstance(certificate, dict) or "reference_pct" not in process:
        return
    per_root_day = process.pop("reference_pct")
    certificate["stability_pct"] = per_root_day * YEAR_DAYS**0.5 if isinstance(per_root_day, float | int) else None
    if not DATE.fullmatch(str(certificate.get("calibrated"))):
        certificate["calibrated"] = ""
