"""The files that a connection to an MQTT broker needs: password, authorities, certificate and key."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from agent.config.files import read_private_file
from agent.config.key_file import KeyFileError, read_key_file, read_private_key
from agent.config.sinks import HOST_ALONE, Mqtt, MqttTls

if TYPE_CHECKING:
    import ssl

LARGEST_PASSWORD = 4096  # bytes of its file


def broker_faults(settings: Mqtt) -> Iterator[tuple[str, str]]:
    """What lets no connection come about: (setting within `mqtt`, what is wrong). Recordings of earlier versions may
    have such a host, so the section itself takes it."""
    from importlib.util import find_spec

    if find_spec("paho") is None:
        yield "enabled", "the MQTT library is missing; `fieldcal extras --install mqtt` installs it"
    if settings.host.count(":") == 1:  # an IPv6 address has more
        yield "host", HOST_ALONE
    if settings.password_file is not None:
        try:
            read_password(settings.password_file)
        except KeyFileError as error:
            yield "password_file", str(error)
    if settings.tls is not None:
        try:
            tls_context(settings.tls)
        except KeyFileError as error:
            yield "tls", str(error)


def broker_warning(settings: Mqtt) -> str:
    """What is not good about the settings; "" where all is."""
    here = settings.host == "localhost" or settings.host.startswith("127.") or settings.host == "::1"
    if not settings.enabled or settings.password_file is None or settings.tls is not None or here:
        return ""
    return f"the password goes to {settings.host} not encrypted; add [mqtt.tls]"


def read_password(path: Path) -> str:
    """The first line of the file. Raises KeyFileError, also where another user may read or write the file."""
    try:
        data, exposed = read_private_file(path, LARGEST_PASSWORD)
        password = data.decode().partition("\n")[0].rstrip("\r")
    except OSError as error:
        raise KeyFileError(f"{path}: cannot be read: {error.strerror}") from None
    except UnicodeDecodeError:
        raise KeyFileError(f"{path}: the password is not UTF-8; write the file anew") from None
    if exposed:
        raise KeyFileError(f"{path}: {exposed}")
    if not password:
        raise KeyFileError(f"{path}: the first line is empty; write the password there")
    return password


def tls_context(files: MqttTls) -> ssl.SSLContext:
    """The context of a connection that trusts the authorities in `files.ca` alone. Raises KeyFileError."""
    import ssl

    try:
        context = ssl.create_default_context(cadata=read_key_file(files.ca).decode("ascii", "replace"))
    except ssl.SSLError:
        raise KeyFileError(f"{files.ca}: no certificates in PEM; give those of the broker's authority") from None
    if files.certificate is not None and files.key is not None:
        read_private_key(files.key)
        try:
            context.load_cert_chain(files.certificate, files.key)
        except (OSError, ssl.SSLError) as error:
            raise KeyFileError(
                f"{files.certificate}: not a certificate in PEM that belongs to the key {files.key} "
                f"({error.strerror or error})"
            ) from None
    return context
