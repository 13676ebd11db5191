"""Checks of the key that signs recordings: is it apart from the data, and who can use it?"""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

from agent.config import Config
from agent.config.key_file import SERVICE_USER, service_uid
from agent.delivery.history import FILE_NAME
from agent.setup.finding import Finding


def signing_key_findings(config: Config, data_dir: Path | None = None) -> Iterator[Finding]:
    """What is wrong with the place and the owner of the signing key; `check` names what makes a key unusable.

    `data_dir`: where the agent will keep its data; a directory with a store counts as one in any case.
    """
    key = config.recording.signing_key
    if key is None:
        yield Finding(
            "signing key", "advice", "recordings are not signed: nobody can prove who made them",
            "state recording.signing_key, as `fieldcal init` does",
        )  # fmt: skip
        return
    holder = next((path for path in key.resolve().parents if _holds_data(path, data_dir)), None)
    if holder is not None:
        yield Finding(
            "signing key", "advice", f"recording.signing_key: {key} is in the data directory {holder}: who gets the "
            "data gets the key with them, and can sign as this gateway",
            "move the key to another directory, and state the new place; make a new key if the data were ever copied",
        )  # fmt: skip
    if owner := _other_owner(key):
        yield Finding(
            "signing key", "advice", f"recording.signing_key: {key} belongs to the user {owner}",
            "give it to the user that runs the agent (chown); as a service this is "
            f"{SERVICE_USER}: sudo chown {SERVICE_USER} {key}",
        )  # fmt: skip
    if holder is None and not owner:
        yield Finding("signing key", "good", f"{key} is outside the data directory, and its owner's alone")


def signing_key_warnings(config: Config, data_dir: Path | None = None) -> Iterator[str]:
    """The advice of `signing_key_findings` about a key that is stated, each in one line."""
    for finding in signing_key_findings(config, data_dir) if config.recording.signing_key else ():
        if finding.verdict != "good":
            yield f"{finding.says}; {finding.remedy}"


def _holds_data(directory: Path, data_dir: Path | None) -> bool:
    return (directory / FILE_NAME).exists() or (data_dir is not None and directory == data_dir.resolve())


def _other_owner(key: Path) -> str:
    """The owner of a key that the agent's user should own and does not; "" where all is well.

    The agent's user is who runs this; for root it is the user of the service, if the machine has it.
    """
    import pwd

    wanted = os.geteuid() or service_uid() or 0
    uid = key.stat().st_uid
    if uid == wanted:
        return ""
    with suppress(KeyError):
        return pwd.getpwuid(uid).pw_name
    return str(uid)
