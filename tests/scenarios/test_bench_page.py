"""A session of `fieldcal bench` on the page of the monitor: what the terminal says, from begin to certificate."""

from __future__ import annotations

import hashlib
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.unit.browser import Watched, chromium, needs_chromium
from tests.unit.zenoh_site import Site, wait_for

pytest.importorskip("starlette", reason="the extra monitor is not installed")
pytest.importorskip("uvicorn", reason="the extra monitor is not installed")
pytest.importorskip("argon2", reason="the extra monitor is not installed")
from tests.scenarios.bench_page import RECORD, VIEW, session
from tests.scenarios.fleet_page import axe_faults
from tests.scenarios.processes import ROOT
from tests.unit.monitor_site import Monitor

pytestmark = needs_chromium
SILENT_MS = 30_000
# A busy machine delays or loses samples, and both say so.
WARNED = re.compile(r"^  (knocks: .*|.* does not look like .*|\w+: \d+ \w+ dropped, .*)$", re.MULTILINE)


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    with chromium() as opened:
        yield opened


def rows(page: Any, caption: str) -> list[list[str]]:
    """The cells of a table of the page."""
    table = page.get_by_role("region", name=caption, exact=True).locator("tbody tr")
    return [row.locator("td").all_inner_texts() for row in table.all()]


@pytest.mark.thorough
@pytest.mark.slow
def test_the_page_shows_what_the_terminal_says(site: Site, tmp_path: Path, browser: Any) -> None:
    monitor = Monitor(site.endpoint, tmp_path / "monitor")
    try:
        watched = Watched(browser, monitor.address, viewport={"width": 1280, "height": 900})
        page = watched.open()
        page.get_by_role("link", name="Bench").press("Enter")  # by the keyboard
        page.get_by_text("No session is known").wait_for()
        page.goto(f"http://{monitor.address}/{VIEW}")
        page.evaluate(RECORD)
        asked: list[str] = []

        def at_question(told: str) -> None:
            asked.append(told)
            shown = page.locator("#bench-now").inner_text()
            for found in re.findall(r"^stop \d: .*|it tells most of .*|U will be [^;\n]*(?=;|$)", told, re.MULTILINE):
                assert found.lower() in shown.lower()
            if "does not look like" in told:
                warned = WARNED.findall("".join(asked))
                texts = page.locator("#bench-warnings li").all_inner_texts()
                assert [re.sub(r"^Stop [12]: ", "", text) for text in texts] == warned[::-1]  # the newest first
                assert texts[0].startswith("Stop 2: ")
                assert axe_faults(page) == []
            if (taken := re.search(r"stop 1, (.*): U is now", told)) is not None:  # the page told U in each second
                stay = re.compile(rf"At {taken[1]}[2-9] s of 4 to 60 s; U will be \d")
                assert any(map(stay.match, page.evaluate("() => window.seen")))

        status, told = session(site, tmp_path / "bench", page, at_question)
        assert status == 0, told
        assert len(asked) == 4
        page.get_by_role("heading", name="Result", exact=True).wait_for()
        now = re.findall(r"stop (\d), (.*): U is now (.* %) \(main\), (.* %) \(transverse\)", told)
        assert [tuple(row) for row in rows(page, "Positions that are used")] == now
        assert rows(page, "U so far") == [
            ["main", now[-1][2], "", "0.5 %", "yes"], ["transverse", now[-1][3], "", "1 %", "yes"]
        ]  # fmt: skip
        printed = [re.split(r"\s{2,}", line.strip()) for line in told.splitlines() if re.match(r"  [xyz] .* ± ", line)]
        assert [[re.sub(r"\s+", " ", cell) for cell in row] for row in printed] == rows(page, "S and Q with U")
        certificate = sorted((tmp_path / "bench" / "certificate").iterdir())
        assert {"certificate.pdf", "certificate.xml"} <= {path.name for path in certificate}
        files = [tmp_path / "bench" / "result.json", *certificate]
        assert rows(page, "Files") == [
            [str(f.relative_to(tmp_path)), hashlib.sha256(f.read_bytes()).hexdigest()] for f in files
        ]
        assert page.locator("#bench-silent").inner_text() == ""
        assert page.locator("#bench-plot .uplot").count() == 1
        assert axe_faults(page) == []
        saved = monitor.get("bench.csv?site=virtual&gateway=bench").splitlines()
        assert saved[0] == "stop,position,u_main_pct,u_transverse_pct"
        assert [line.split(",")[1] for line in saved[1:]] == [row[1] for row in now]
        page.set_viewport_size({"width": 390, "height": 800})  # a phone: nothing is cut but wide tables, which scroll
        assert page.evaluate("() => document.documentElement.scrollWidth") <= 390
        page.emulate_media(color_scheme="dark")
        page.wait_for_function("() => getComputedStyle(document.body).backgroundColor === 'rgb(15, 21, 27)'")
        assert axe_faults(page) == []
        watched.close()  # no request to outside, no error
    finally:
        monitor.stop()


@pytest.mark.nightly
def test_a_killed_program_is_shown_as_silent(site: Site, tmp_path: Path, browser: Any) -> None:
    monitor = Monitor(site.endpoint, tmp_path / "monitor")
    command = [sys.executable, "-m", "agent", "bench", "-o", str(tmp_path / "out"), "--virtual", "gravity"]
    program = subprocess.Popen(
        [*command, "--connect", site.endpoint], cwd=ROOT, stdin=subprocess.PIPE, stdout=subprocess.DEVNULL,
    )  # fmt: skip
    try:
        watched = Watched(browser, monitor.address)
        page = watched.open("#view=bench")  # of one session alone, its name is not needed
        page.get_by_text("Stop 1: put the sensor on a level table").wait_for()
        assert page.locator("#bench-silent").inner_text() == ""
        helpers = Path(f"/proc/{program.pid}/task/{program.pid}/children").read_text().split()
        program.kill()
        program.wait()
        page.get_by_text("The program is silent").wait_for(timeout=SILENT_MS)
        assert helpers
        wait_for(lambda: not any(Path(f"/proc/{pid}").exists() for pid in helpers))  # none is left behind
        watched.close()
    finally:
        program.kill()
        program.communicate()
        monitor.stop()
