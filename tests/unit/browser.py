"""Debian's chromium, driven by Playwright; tests that need it are skipped where one of them is missing."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import pytest

CHROMIUM = shutil.which("chromium")
needs_chromium = pytest.mark.skipif(CHROMIUM is None, reason="needs Debian's chromium")


@contextmanager
def chromium() -> Iterator[Any]:
    """A browser of Playwright."""
    playwright = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
    with playwright.sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        yield browser
        browser.close()


class Watched:
    """A page of which all requests and errors are noted."""

    def __init__(self, browser: Any, address: str, **options: Any) -> None:
        self.address = address
        self.context = browser.new_context(**options)
        self.page = self.context.new_page()
        self.page.set_default_timeout(60_000)  # ms; what a test waits for comes late on a busy machine
        self.asked: list[str] = []
        self.errors: list[str] = []
        self.page.on("request", lambda request: self.asked.append(request.url))
        self.page.on("pageerror", lambda error: self.errors.append(str(error)))
        self.page.on("dialog", lambda dialog: self.errors.append(f"dialog {dialog.message}"))
        self.page.on("console", self._heard)

    def _heard(self, message: Any) -> None:
        # The answers 401 and 503 are looked for by the tests themselves; the browser writes them to the console too.
        if message.type == "error" and "Failed to load resource" not in message.text:
            self.errors.append(message.text)

    def open(self, view: str = "") -> Any:
        """Go to a view."""
        self.page.goto(f"http://{self.address}/{view}")
        return self.page

    def close(self) -> None:
        """Close it. Fails where the page asked another machine, or had an error."""
        self.context.close()
        own = f"http://{self.address}/"
        assert [url for url in self.asked if not url.startswith((own, f"blob:{own[:-1]}"))] == []
        assert not self.errors, self.errors
