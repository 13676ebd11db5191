"""Sends notices: as JSON to a webhook, or by mail. Targets come from the configuration alone."""

from __future__ import annotations

import re
import smtplib
import ssl
from collections.abc import Sequence
from email.message import EmailMessage
from typing import Any
from urllib.error import HTTPError
from urllib.request import HTTPRedirectHandler, Request, build_opener

import msgspec

from agent.monitor.settings import Email, password_of

TIMEOUT_S = 10.0
SHOWN = 50  # notices in one message; the others are counted
_CONTROL = re.compile(r"[\x00-\x1f\x7f-\x9f\u061c\u200e\u200f\u2028-\u202e\u2066-\u2069]")


class Notice(msgspec.Struct, frozen=True):
    """One thing to know. `kind`: status, drift, watch, gateway or certificate; `subject`: of which."""

    kind: str
    subject: str
    text: str

    @property
    def line(self) -> str:
        """One line of text, whatever the bus has sent."""
        return _CONTROL.sub("\ufffd", f"{self.subject}: {self.text}")


class _NoRedirect(HTTPRedirectHandler):
    """A redirection would lead to a target that no configuration names."""

    def redirect_request(self, *_: Any, **__: Any) -> None:
        return None


def text_of(notices: Sequence[Notice]) -> str:
    """The notices, one a line."""
    lines = [notice.line for notice in notices[:SHOWN]]
    more = len(notices) - SHOWN
    return "\n".join(lines + ([f"and {more} more"] if more > 0 else []))


def post(url: str, notices: Sequence[Notice]) -> None:
    """POST JSON: `text`, and `notices`, a list of `kind`, `subject` and `text`.

    Raises OSError where it is not taken.
    """
    body = msgspec.json.encode({"text": text_of(notices), "notices": notices[:SHOWN]})
    request = Request(url, body, {"Content-Type": "application/json", "User-Agent": "fieldcal"}, method="POST")
    try:
        build_opener(_NoRedirect).open(request, timeout=TIMEOUT_S).close()
    except HTTPError as error:
        error.close()
        raise OSError(f"the webhook at {request.host} answers {error.code}") from None


def message_of(email: Email, notices: Sequence[Notice]) -> EmailMessage:
    """The mail. What the bus sent is in the body alone; a header with a line break raises ValueError."""
    message = EmailMessage()
    count = len(notices)
    message["Subject"] = (
        f"fieldcal: {count} notice{'s' if count > 1 else ''}, {notices[0].kind} of {notices[0].subject}"
    )
    message["From"], message["To"] = email.sender, ", ".join(email.recipients)
    message.set_content(text_of(notices) + "\n")
    return message


def mail(email: Email, notices: Sequence[Notice]) -> None:
    """Send a mail. Raises OSError, ValueError or SMTPException where it is not taken."""
    context = ssl.create_default_context()
    opened = (
        smtplib.SMTP_SSL(email.host, email.port, timeout=TIMEOUT_S, context=context)
        if email.security == "tls"
        else smtplib.SMTP(email.host, email.port, timeout=TIMEOUT_S)
    )
    with opened as server:
        if email.security == "starttls":
            server.starttls(context=context)
        if email.user:
            server.login(email.user, password_of(email))
        server.send_message(message_of(email, notices))
