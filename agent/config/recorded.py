"""The configuration in a recording, also in one that an older version of the program wrote."""

from __future__ import annotations

import json
import re
from typing import Any

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
        raw: dict[str, Any] = json.loads(text)
    except RecursionError:
        raise ValueError("its tables or lists are nested too deep to be read") from None
    if too_large := size_faults(raw):
        raise ValueError(f"{'.'.join(map(str, too_large[0][0]))} {too_large[0][1]}".strip())
    for channel in raw["channels"]:
        if (per_root_day := channel["process"].pop("reference_pct", None)) is not None:
            certificate = channel["certificate"]
            certificate["stability_pct"] = per_root_day * YEAR_DAYS**0.5
            if not DATE.fullmatch(certificate["calibrated"]):
                certificate["calibrated"] = ""
    return Config.model_validate(raw)
