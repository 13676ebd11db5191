"""Results and certificates in JSON that somebody changed: as a prior, and as what a certificate is made of."""

from __future__ import annotations

import copy
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from agent.config.earlier import EarlierError, read_earlier
from agent.report.material import MaterialError, gather
from calib.model import PARAMETERS

S, Q, K = np.diag([102.3, 98.4, 95.1]), np.array([21.0, -33.0, 14.0]), 2.0
U = np.linspace(0.1, 0.3, len(PARAMETERS))


def parts(values: np.ndarray) -> dict[str, Any]:
    return {"sensitivity": values[:9].reshape(3, 3).tolist(), "offset": values[9:].tolist()}


RESULT: dict[str, Any] = {
    **parts(np.append(S, Q)),
    "standard_uncertainty": parts(U),
    "expanded_uncertainty": parts(K * U) | {"coverage_factor": K},
    "covariance": np.diag(U**2).tolist(),
    "determined": parts(np.ones(12, dtype=bool)),
    "status": "valid",
}


def written(path: Path, text: str) -> Path:
    path.write_text(text)
    return path


def changed(*names: str | int, to: object) -> Callable[[], str]:
    """The result with another value at this place."""

    def text() -> str:
        result = copy.deepcopy(RESULT)
        inner: Any = result
        for name in names[:-1]:
            inner = inner[name]
        inner[names[-1]] = to
        return json.dumps(result)

    return text


def test_an_honest_result_is_read(tmp_path: Path) -> None:
    path = written(tmp_path / "result.json", json.dumps(RESULT))
    values, covariance = read_earlier(path)
    assert values.tolist() == np.append(S, Q).tolist()
    assert covariance.tolist() == np.diag(U**2).tolist()
    assert gather([path], None).results[0].values.tolist() == values.tolist()


BOTH = {
    "a key twice": (lambda: json.dumps(RESULT)[:-1] + ', "offset": [0, 0, 0]}', "the key 'offset' is there twice"),
    "NaN": (changed("sensitivity", 0, 0, to=float("nan")), "NaN is no number of JSON"),
    "infinite": (changed("sensitivity", 0, 0, to=float("inf")), "Infinity is no number of JSON"),
    "beyond the largest number": (lambda: json.dumps(RESULT).replace("102.3", "1e400"), "larger than 1e"),
    "too large to square": (changed("sensitivity", 0, 0, to=1e300), "larger than 1e"),
    "a text": (changed("sensitivity", 0, 0, to="102.3"), "sensitivity.* must "),
    "nested": (lambda: '{"a":' * 100_000, "nested too deeply"),
    "a list": (lambda: "[]", "neither a result|not a JSON object"),
}  # fmt: skip


@pytest.mark.parametrize("kind", BOTH)
def test_what_two_readers_could_read_in_two_ways(kind: str, tmp_path: Path) -> None:
    make, told = BOTH[kind]
    path = written(tmp_path / "result.json", make())
    with pytest.raises(EarlierError, match=told):
        read_earlier(path)
    with pytest.raises(MaterialError, match=told):
        gather([path], None)


def test_a_covariance_that_is_not_symmetric(tmp_path: Path) -> None:
    path = written(tmp_path / "result.json", changed("covariance", 0, 1, to=1e-3)())
    with pytest.raises(EarlierError, match="the covariance is not symmetric"):
        read_earlier(path)


@pytest.mark.parametrize(
    ("place", "to", "told"),
    [
        (("standard_uncertainty", "sensitivity", 0, 0), -0.1, "standard_uncertainty: -0.1 is negative"),
        (("expanded_uncertainty", "sensitivity", 0, 0), 1e-9, "1e-09 for Sxx, .* give 0.2; do not edit"),
        (("expanded_uncertainty", "coverage_factor"), -2.0, "0.2 for Sxx, .* give -0.2; do not edit"),
        (("expanded_uncertainty", "coverage_factor"), 1.99, "0.2 for Sxx, .* give 0.199; do not edit"),
        (("covariance", 0, 0), 0.0, "covariance: 0 for Sxx, .* give 0.01; do not edit"),
    ],
)  # fmt: skip
def test_uncertainties_that_do_not_belong_together(
    place: tuple[str | int, ...], to: float, told: str, tmp_path: Path
) -> None:
    with pytest.raises(MaterialError, match=told):
        gather([written(tmp_path / "result.json", changed(*place, to=to)())], None)
