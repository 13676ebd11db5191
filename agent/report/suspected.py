"""A calibration in a report with what the other sensors of its site suspect: the value stays, U holds the change."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import msgspec
import numpy as np

from agent.report.material import Material
from agent.report.result import CalibrationResult, parse, plain
from agent.site_watch.suspicion import SOURCE, Suspicion


def suspect(material: Material, suspicion: Suspicion | None) -> None:
    """Enlarge U of each result by the suspected change of its sensor, unless the calibration was made after it."""
    if suspicion is None:
        material.notices.append("the verdicts of the site suspect nothing of this sensor")
        return
    made = [update.date_utc_ns for update in material.history[-1:]]
    if made and not suspicion.holds_of(made[0]):
        material.notices.append(f"the calibration was made after the suspected change, so U stays: {suspicion.text}")
        return
    material.notices.append(f"suspected by the other sensors of the site: {suspicion.text}. U holds this change")
    material.results = [replace(_enlarged(result, suspicion), unit=result.unit) for result in material.results]


def _enlarged(result: CalibrationResult, suspicion: Suspicion) -> CalibrationResult:
    whole = np.nan_to_num(result.covariance)
    covariance = suspicion.enlarged(np.nan_to_num(result.sensitivity), whole)
    added = np.diag(covariance) - np.diag(whole)
    u = np.sqrt(np.square(result.standard_uncertainty) + added)
    U = result.coverage_factor * u
    budget = {name: list(part) for name, part in result.budget.items()}
    fields: dict[str, Any] = {
        **result.fields,
        "covariance": np.where(np.isfinite(result.covariance), covariance, np.nan),
        "standard_uncertainty": _parts(u),
        "expanded_uncertainty": {**(result.fields.get("expanded_uncertainty") or {}), **_parts(U)},
        "budget": budget | {SOURCE: list(np.sqrt(added))} if budget else {},
        "suspected": {
            **msgspec.to_builtins(suspicion),
            "in_force": {"standard_uncertainty": _parts(result.standard_uncertainty)},
        },
    }
    return parse({name: plain(value) for name, value in fields.items()}, result.label)


def _parts(values: Any) -> dict[str, Any]:
    return {"sensitivity": values[:9].reshape(3, 3), "offset": values[9:]}
