"""The measured tables of README and docs: the command beside a table exists and writes its columns, and figures of
simulations come out again.

A table with seeds is simulated again here, whole lines where a line takes a second or two, otherwise some of its runs,
whose spread must contain the figure. Figures of time and memory belong to a machine, so of these tables only columns
and command are compared.
"""

from __future__ import annotations

import ast
import importlib.util
import re
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from scipy import stats

from benchmarks import disturbed, drift_test, guided, one_frequency, site, torture, torture_shm
from calib.drift.false_alarms import false_alarm_rate
from calib.drift.onsets import FEWEST, SPAN

ROOT = Path(__file__).parents[2]
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").glob("*.md"))]
PART = re.compile(r"<!-- ([^>]*): begin -->\n(.*?)<!-- \1: end -->", re.DOTALL)
COMMAND = re.compile(r"python -m ((?:benchmarks|tests|docs)[\w.]*)((?: +[\w.-]+)*)")
HEADER = re.compile(r"^(\| .*\|)\n\| ---", re.MULTILINE)
NUMBER = re.compile(r"\d+(?:\.\d+)?(?:e[+-]?\d+)?")
LEVEL = 1e-6  # probability that a right figure fails a test of some of its runs
# The module whose output a part is, where it is not the one that calls `write_part` with the name.
ELSEWHERE = {
    "mpu9150": "agent.calibrate.printing", "imports": "docs.images.import_graph", "worked": "docs.worked_budget",
    "worked block": "docs.worked_block", "drawn structures": "benchmarks.online.drawn_structures",
    "transitions": "",  # a table of rules, which tests/properties/test_gate.py compares
    "site-runs": "benchmarks.site", "site-large": "benchmarks.site",
    **dict.fromkeys(("table", "known", "skirts", "inside"), "benchmarks.response"), "walks": "benchmarks.walks",
    **{f"site-watch {name}": "benchmarks.site_watch"
       for name in ("8", "8 sound", "30", "30 sound", "200", "traffic", "worlds", "cost", "kept", "year")},
    "faults": "tests.faults.outcome", "soak-day": "benchmarks.soak", "soak-hour": "benchmarks.soak",
    **{name: f"benchmarks.online.{name}" for name in
       ("agreement", "bench", "bridge", "chip", "cost", "coverage", "day", "filters", "harm", "lorries",
        "references", "temperature", "touched", "year")},
}  # fmt: skip


@cache
def parts() -> dict[str, str]:
    """All parts between markers, by name."""
    return {name: text for page in PAGES for name, text in PART.findall(page.read_text("utf-8"))}


@cache
def source(module: str) -> str:
    found = importlib.util.find_spec(module)
    assert found is not None, module
    assert found.origin is not None, module
    return Path(found.origin).read_text("utf-8")


def written(module: str) -> set[str]:
    """Names with which a module calls `write_part`."""
    calls = [node for node in ast.walk(ast.parse(source(module))) if isinstance(node, ast.Call)]
    first = [call.args[0] for call in calls if getattr(call.func, "id", "") == "write_part" and call.args]
    return {
        node.value for arg in first for node in ast.walk(arg)
        if isinstance(node, ast.Constant) and isinstance(node.value, str)
    }  # fmt: skip


@cache
def cells(module: str) -> list[re.Pattern[str]]:
    """What each cell of a table may be that this module writes: its texts, with anything where a value is put in."""
    found = []
    for node in ast.walk(ast.parse(source(module))):
        pieces = node.values if isinstance(node, ast.JoinedStr) else [node] if isinstance(node, ast.Constant) else []
        text = "".join(
            re.escape(p.value) if isinstance(p, ast.Constant) and isinstance(p.value, str) else ".+" for p in pieces
        )
        for cell in re.split(r"\\\||\\\n", text):
            pattern = cell.replace(r"\ ", " ").strip()
            if pattern.replace(".+", "").strip():  # a cell that is nothing but a value tells nothing
                found.append(re.compile(pattern))
    return found


@cache
def writers() -> dict[str, str]:
    """The module that writes each part."""
    modules = [f"benchmarks.{path.stem}" for path in (ROOT / "benchmarks").glob("*.py") if path.stem != "__main__"]
    return {name: module for module in modules for name in written(module)} | ELSEWHERE


@pytest.mark.slow
def test_every_part_has_a_writer_and_every_writer_a_part() -> None:
    assert set(writers()) == set(parts())


@pytest.mark.slow
@pytest.mark.parametrize("name", sorted(name for name in parts() if ELSEWHERE.get(name, "benchmarks")))
def test_the_columns_are_those_that_the_command_writes(name: str) -> None:
    module = writers()[name]
    known = [*cells(module), *(cells("benchmarks.online.pages") if module.startswith("benchmarks.online") else ())]
    headers = HEADER.findall(parts()[name])
    strange = [
        cell for header in headers for cell in header.strip("| ").split(" | ")
        if cell and not any(each.fullmatch(cell.strip()) for each in known)
    ]  # fmt: skip
    assert strange == [], f"{module} writes no such column: run it with --write"


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_named_modules_exist_and_have_the_options(page: Path) -> None:
    wrong = []
    for module, words in COMMAND.findall(page.read_text("utf-8").replace("\n", " ")):
        found = importlib.util.find_spec(module)
        if found is None:
            wrong.append(module)
            continue
        main = source(f"{module}.pages") if module == "benchmarks.online" else source(module)
        wrong += [f"{module} {word}" for word in words.split() if word.startswith("--") and f'"{word}"' not in main]
    assert wrong == []


def line_of(name: str, begin: str) -> str:
    """The line of a part that begins so."""
    return next(line for line in parts()[name].splitlines() if line.startswith(begin))


def assert_same(shown: str, made: str) -> None:
    """The same text and counts, with decimals that differ by one in the last digit at most, as on another CPU."""
    assert NUMBER.sub("#", shown) == NUMBER.sub("#", made)
    for old, new in zip(NUMBER.findall(shown), NUMBER.findall(made), strict=True):
        mantissa, _, power = old.partition("e")
        step = 10.0 ** (int(power or 0) - len(mantissa.partition(".")[2]))
        allowed = 1.001 * step if {".", "e"} & set(old) else 0.0
        assert abs(float(old) - float(new)) <= allowed, f"{shown}\n{made}"


@pytest.mark.thorough
def test_what_the_guide_says_beforehand() -> None:
    for line in guided.outlooks()[2:]:
        assert_same(line_of("guided", line[: line.index("|", 2) + 1]), line)


@pytest.mark.thorough
def test_what_the_best_test_of_a_site_reaches() -> None:
    for line in site.bounds():
        assert_same(line_of("site-runs", line[: line.rindex("|", 0, -1)]), line)


@pytest.mark.thorough
def test_disturbances(monkeypatch: pytest.MonkeyPatch) -> None:
    """The first lines of slow motion; the others take longer."""
    monkeypatch.setattr(disturbed, "BANDS_HZ", disturbed.BANDS_HZ[:1])
    monkeypatch.setattr(disturbed, "KINDS", dict([*disturbed.KINDS.items()][:3]))
    runs = int(re.findall(r"(\d+) runs a line", parts()["disturbed"])[0])
    for line in disturbed.table(runs)[2:]:
        assert_same(line_of("disturbed", line[: line.index("|", line.index("|", 1) + 1) + 1]), line)


@pytest.mark.thorough
def test_the_delay_of_the_drift_test() -> None:
    page = (ROOT / "docs/drift.md").read_text("utf-8")
    for name in ("step of 30 sigma", "step of 3 sigma", "step of 1 sigma", "ramp of 0.05 sigma a window"):
        tests = drift_test.Glr(), drift_test.Cusum(1.0), drift_test.Cusum(0.25)
        means = [drift_test.delays(test, drift_test.CHANGES[name]).mean() for test in tests]
        shown = next(line for line in page.splitlines() if line.startswith(f"| {name} |"))
        assert_same(shown, f"| {name} | {' | '.join(f'{mean:.1f}' for mean in means)} |")


@pytest.mark.thorough
def test_the_false_alarms_of_the_drift_test() -> None:
    page, windows = (ROOT / "docs/drift.md").read_text("utf-8"), 1_200_000
    expected = windows * false_alarm_rate(8.0, FEWEST, SPAN)
    made = f"| {8:.2f} | {windows:.3g} | {drift_test.false_alarms(8.0, windows)} | {expected:.0f} |"
    assert_same(next(line for line in page.splitlines() if line.startswith("| 8.00 |")), made)


def assert_rms(shown: float, errors: np.ndarray) -> None:
    """The root mean square of these few errors may be that of all, which is shown."""
    n, rms = errors.size, float(np.sqrt(np.mean(errors**2)))
    low, high = np.sqrt(stats.chi2.ppf([LEVEL / 2, 1 - LEVEL / 2], n) / n)
    assert low * shown < rms < high * shown, f"{rms:.3g} of {n}, {shown:g} of all"


def figures(name: str, begin: str) -> list[list[float]]:
    """The numbers of the cells of a line."""
    line = line_of(name, begin)
    return [[float(number) for number in NUMBER.findall(cell)] for cell in line.split(" | ")[1:]]


@pytest.mark.thorough
@pytest.mark.parametrize("row", ["sensor lags by 5 ms", "offset differs by 0.05", "all together"])
def test_plain_method_3_against_the_adjustment(row: str) -> None:
    number = next(k for k, each in enumerate(torture.ROWS) if each.name.startswith(row))
    found = [torture.one((number, index)) for index in range(10)]
    errors, u = (np.array([each[k] for each in found]) for k in (1, 2))
    _, _, adjusted, bound, *_ = figures("torture", f"| {row}")
    for some, k, scale in ((torture.MAIN, 0, 100.0), (torture.TRANSVERSE, 1, 100.0), (torture.OFFSET, 2, 1e3)):
        worst = scale * np.sqrt(np.mean(u**2, axis=0))[some].max()
        assert worst == pytest.approx(bound[k], rel=0.25, abs=0.0006 * scale / 100.0), "the posterior u hardly varies"
        column = errors[:, some[int(np.argmax(np.mean(errors[:, some] ** 2, axis=0)))]]
        assert_rms(adjusted[k], scale * column)


@pytest.mark.thorough
def test_a_noisy_reference_on_a_structure() -> None:
    found = [torture_shm.one(seed) for seed in range(1)]
    naive, errors, u, _ = (np.array(each) for each in zip(*found, strict=True))
    lost = -100.0 * np.mean(naive[:, [0, 4, 8]])
    assert lost == pytest.approx(figures("torture_shm", "| main sensitivities, mean loss")[0][0], rel=0.1)
    _, rms, stated = figures("torture_shm", "| RMS an element")
    assert 100.0 * np.sqrt(np.mean(u**2)) == pytest.approx(stated[0], rel=0.1)
    assert_rms(float(np.mean(rms)), 100.0 * errors.ravel())


@pytest.mark.thorough
@pytest.mark.parametrize("line", [0, 2])
def test_one_frequency(line: int) -> None:
    motion_hz, corner_hz, order = one_frequency.LINES[line]
    found = [one_frequency.one((motion_hz, corner_hz, order, seed)) for seed in range(6)]
    told = [each for each in found if each is not None]
    assert len(told) == len(found)
    away, u, _ = (np.array([each[k] for each in told]) for k in range(3))
    name = f"order {order} at {corner_hz:g} Hz" if corner_hz else "none"
    shown = figures("one frequency", f"| {motion_hz:g} | {name} |")
    assert 100.0 * u[:, one_frequency.MAIN].mean() == pytest.approx(shown[2][0], rel=0.1)
    z = away / u
    for some, k in ((one_frequency.MAIN, 3), (one_frequency.OFFSET, 4)):
        per_run = np.sqrt(np.mean(z[:, some] ** 2, axis=1))  # within a run the three are not independent
        assert_rms(shown[k][0], per_run)


def test_a_stale_figure_is_seen() -> None:
    assert_same("| a | 0.0351 |", "| a | 0.0352 |")
    assert_same("| 14 | 1e+06 |", "| 14 | 1e+06 |")
    with pytest.raises(AssertionError):
        assert_same("| 14 |", "| 13 |")
    for made in ("| a | 0.0353 |", "| b | 0.0351 |", "| a | 0.0351 | 1 |"):
        with pytest.raises(AssertionError):
            assert_same("| a | 0.0351 |", made)
    with pytest.raises(AssertionError):
        assert_rms(1.0, np.full(20, 3.0))
