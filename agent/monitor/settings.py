"""The configuration of the monitor (`fieldcal monitor --config F`): the plan of the structure, and who gets notices."""

from __future__ import annotations

from collections.abc import Mapping
from email.headerregistry import Address
from pathlib import Path
from typing import Annotated, Literal
from urllib.parse import urlsplit

from pydantic import AfterValidator, Field

from agent.config.files import read_private_file
from agent.config.reading import ConfigError, load_model
from agent.config.section import Section
from agent.delivery.keys import CHUNK
from agent.monitor.summaries import FULL_DAYS

PICTURES = {".png": "image/png", ".jpg": "image/jpeg", ".jpeg": "image/jpeg", ".webp": "image/webp"}
LARGEST_SECRET = 4096
Fraction = Annotated[float, Field(ge=0, le=1)]


def _picture(path: Path) -> Path:
    if path.suffix.lower() not in PICTURES:
        raise ValueError(f"a picture is a file {', '.join(PICTURES)}")
    return path


def _url(url: str) -> str:
    parts = urlsplit(url)
    if parts.scheme not in ("https", "http") or not parts.hostname or parts.username or not url.isprintable():
        raise ValueError("a webhook is https://HOST/PATH or http://HOST/PATH, without a user")
    return url


def _mail_address(text: str) -> str:
    try:
        address = Address(addr_spec=text)
    except ValueError:
        address = None
    if address is None or not address.domain or not text.isprintable():
        raise ValueError("not a mail address, such as operator@example.org")
    return text


MailAddress = Annotated[str, AfterValidator(_mail_address)]


class FloorPlan(Section):
    """A picture, and where sensors (`<site>/<gateway>/<sensor>`) are on it: fractions of its width and height."""

    picture: Annotated[Path, AfterValidator(_picture)]
    positions: Mapping[str, tuple[Fraction, Fraction]]


class Email(Section):
    """A mail server and who writes to whom. `password_file`: its first line is the password of `user`."""

    host: Annotated[str, Field(min_length=1)]
    port: Annotated[int, Field(ge=1, le=65535)] = 587
    security: Literal["starttls", "tls", "none"] = "starttls"
    user: str = ""
    password_file: Path | None = None
    sender: MailAddress
    recipients: Annotated[tuple[MailAddress, ...], Field(min_length=1, max_length=100)]


class Notices(Section):
    """Who is told of drift verdicts, of what a site suspects, of a status that needs a person, of silent gateways and
    of certificates that end.
    """

    silent_s: Annotated[
        float, Field(ge=1, le=1e7, description="a gateway is told after it was off the bus for so long")
    ] = 600.0
    certificate_days: Annotated[float, Field(ge=1, le=3650, description="a certificate is told so long before")] = 30.0
    webhooks: Annotated[tuple[Annotated[str, AfterValidator(_url)], ...], Field(max_length=20)] = ()
    email: Email | None = None


def _database_url(url: str) -> str:
    try:
        parts = urlsplit(url)
    except ValueError:
        parts = urlsplit("")
    if parts.scheme != "postgresql" or not parts.path.strip("/") or not url.isprintable():
        raise ValueError("a database is postgresql://USER@HOST:PORT/NAME")
    return url


class DatabaseSettings(Section):
    """Where results are kept, and for how long in full. Without `url`: in the file `monitor.sqlite` of the data."""

    url: Annotated[str, AfterValidator(_database_url)] | None = None
    full_days: Annotated[
        int, Field(ge=1, le=3650, description="days of full results; older ones are summarised by the hour")
    ] = FULL_DAYS


def _name(text: str) -> str:
    if len(parts := text.split("/")) not in (2, 3) or not all(map(CHUNK.fullmatch, parts)):
        raise ValueError("a gateway is SITE/GATEWAY, a sensor SITE/GATEWAY/SENSOR")
    return text


class FleetSettings(Section):
    """What was taken down: nobody is told that it is silent. It is as any other when it is heard again."""

    retired: Annotated[tuple[Annotated[str, AfterValidator(_name)], ...], Field(max_length=10_000)] = ()


class MonitorSettings(Section):
    """The whole file."""

    fleet: FleetSettings = FleetSettings()
    database: DatabaseSettings = DatabaseSettings()
    plan: FloorPlan | None = None
    notices: Notices | None = None


def load_settings(path: Path) -> MonitorSettings:
    """Read the file. Names of files in it are relative to it. Raises ConfigError with all faults."""
    settings = load_model(path, MonitorSettings)
    faults, plan, notices = [], settings.plan, settings.notices
    url = urlsplit(settings.database.url or "")
    if url.password is not None or "password" in url.query:
        faults.append(f"{path}: database.url: a password does not belong here; give it by PGPASSFILE or PGPASSWORD")
    if plan is not None:
        plan = plan.model_copy(update={"picture": path.parent / plan.picture})
        if not plan.picture.is_file():
            faults.append(f"{path}: plan.picture: there is no file {plan.picture}")
    if notices is not None and notices.email is not None and notices.email.password_file is not None:
        email = notices.email.model_copy(update={"password_file": path.parent / notices.email.password_file})
        notices = notices.model_copy(update={"email": email})
        try:
            password_of(email)
        except OSError as error:
            faults.append(f"{path}: notices.email.password_file: {error.filename or ''} {error.strerror or error}")
    if faults:
        raise ConfigError(faults)
    return settings.model_copy(update={"plan": plan, "notices": notices})


def password_of(email: Email) -> str:
    """The password of the user of a mail server. Raises OSError, also where other users can read its file."""
    if email.password_file is None:
        return ""
    data, exposed = read_private_file(email.password_file, LARGEST_SECRET)
    if exposed:
        raise OSError(f"{email.password_file}: {exposed}")
    return data.decode(errors="replace").split("\n", 1)[0]
