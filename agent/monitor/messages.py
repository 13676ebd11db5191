"""Sends notices: as JSON to a webhook, or by mail. Targets come from the configuration alone."""

from __future__ import annotations

import re
import smtplib
import ssl
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from email.message import EmailMessage
from email.utils import make_msgid
from typing import Any
from urllib.error import HTTPError, URLError
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
        return _one_line(f"{self.subject}: {self.text}")


class SomeRefusedError(Exception):
    """The mail server has taken a mail for some recipients only: these must not get it again."""


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
        raise OSError(f"it answers {error.code}") from None


def message_of(email: Email, notices: Sequence[Notice]) -> EmailMessage:
    """The mail, of now. Texts of the bus are in the body alone, the name of the first subject in the header too."""
    message = EmailMessage()
    count = len(notices)
    message["Subject"] = _one_line(
        f"fieldcal: {count} notice{'s' if count > 1 else ''}, {notices[0].kind} of {notices[0].subject}"
    )
    message["From"], message["To"] = email.sender, ", ".join(email.recipients)
    message["Date"] = datetime.now(UTC)
    message["Message-ID"] = make_msgid(domain=email.sender.rpartition("@")[2])
    message["Auto-Submitted"] = "auto-generated"  # RFC 3834: no program answers it
    message.set_content(text_of(notices) + "\n")
    return message


def mail(email: Email, notices: Sequence[Notice]) -> None:
    """Send a mail. Raises OSError, ValueError or SMTPException where it is not taken, SomeRefusedError where it is
    taken for some recipients only.
    """
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
        try:
            refused = server.send_message(message_of(email, notices))
        except smtplib.SMTPRecipientsRefused as error:
            raise OSError(f"no recipient is accepted: {_answers(error.recipients)}") from None
    if refused:
        raise SomeRefusedError(f"these recipients are not accepted, the others have it: {_answers(refused)}")


def fault_of(error: Exception) -> str:
    """In words why something was not sent."""
    if isinstance(error, smtplib.SMTPResponseException):
        return f"the server answers {_answer(error.smtp_code, error.smtp_error)}"
    cause = error.reason if isinstance(error, URLError) else error
    if isinstance(cause, ssl.SSLCertVerificationError):
        return (
            f"the certificate of the server is not accepted ({cause.verify_message}); if an authority of your own made "
            "it, name the file of this authority in the environment variable SSL_CERT_FILE of the monitor"
        )
    return str(cause) or type(cause).__name__


def _one_line(text: str) -> str:
    return _CONTROL.sub("\ufffd", text)


def _answer(code: int, words: bytes | str) -> str:
    return _one_line(f"{code} {words.decode(errors='replace') if isinstance(words, bytes) else words}")


def _answers(refused: Mapping[str, tuple[int, bytes]]) -> str:
    return ", ".join(f"{address} ({_answer(*answer)})" for address, answer in refused.items())
