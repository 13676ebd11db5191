"""Who may log in to the fleet page: a file with the names, the rights, and the passwords as argon2 hashes.

A text file in UTF-8, one user a line; a line that begins with `#` is a comment:

    user <name> <rights, such as hold,accept,plan; or - for none> <argon2id hash>
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

from argon2 import PasswordHasher
from argon2.exceptions import InvalidHashError, VerificationError

from agent.config.files import read_private_file
from agent.delivery.keys import CHUNK
from agent.monitor.rights import RIGHTS

LARGEST = 1 << 20  # bytes of the file; thousands of users
SHORTEST_PASSWORD = 12  # characters; NIST SP 800-63B asks for 8, and for more where there is no second factor
LONGEST_PASSWORD = 200
_HASHER = PasswordHasher()  # RFC 9106, second recommended option: 64 MiB, 3 passes
# Checked in place of an unknown user's password, so that both take the same time.
_NOBODY = _HASHER.hash("no password")
_BEGIN = (
    "# Users of the fleet page. `fieldcal monitor --users F --add-user NAME` adds one; a deleted line removes one.\n"
)


class UsersError(Exception):
    """The file of users cannot be read or written, or a user cannot be added. The message names the file and line."""


@dataclass(frozen=True, slots=True)
class User:
    """A user. `verbs`: commands that the page forwards for this user, and PLAN. `hashed`: the password, by argon2id."""

    name: str
    verbs: tuple[str, ...]
    hashed: str


class Users:
    """The users in a file, which is read again when it changes. Raises UsersError where it cannot be read."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._stamp: tuple[int, ...] = ()
        self._users: dict[str, User] = {}
        self.now()

    def now(self) -> dict[str, User]:
        """The users by name, as the file is now. Raises UsersError."""
        try:
            found = os.stat(self._path)
            stamp = (found.st_ino, found.st_size, found.st_mtime_ns, found.st_mode)
            if stamp != self._stamp:
                self._users = read_users(self._path)
                self._stamp = stamp
        except OSError as error:
            raise UsersError(f"{self._path}: cannot be read: {error.strerror}") from None
        return self._users


def _text_of(path: Path) -> str:
    try:
        data, exposed = read_private_file(path, LARGEST)
        text = data.decode()
    except OSError as error:
        raise UsersError(f"{path}: cannot be read: {error.strerror}") from None
    except UnicodeDecodeError as error:
        raise UsersError(f"{path}: not a file of users: {error}") from None
    if exposed:
        raise UsersError(f"{path}: {exposed}")
    return text


def read_users(path: Path) -> dict[str, User]:
    """Read a file of users. Raises UsersError, which names the line, also where another user may read the file."""
    users: dict[str, User] = {}
    for number, line in enumerate(_text_of(path).splitlines(), start=1):
        if not line.strip() or line.startswith("#"):
            continue
        words, where = line.split(), f"{path}: line {number}"
        if len(words) != 4 or words[0] != "user" or not CHUNK.fullmatch(words[1]):
            raise UsersError(f"{where}: not `user <name> <rights> <argon2id hash>`")
        verbs = () if words[2] == "-" else tuple(words[2].split(","))
        if unknown := [verb for verb in verbs if verb not in RIGHTS]:
            raise UsersError(f"{where}: {unknown[0]!r:.40} is no right; the rights are {', '.join(RIGHTS)}")
        if words[1] in users:
            raise UsersError(f"{where}: the user {words[1]} is there twice")
        if not words[3].startswith("$argon2id$"):
            raise UsersError(f"{where}: the password of {words[1]} is no argon2id hash; add the user again")
        users[words[1]] = User(words[1], verbs, words[3])
    return users


def set_user(path: Path, name: str, verbs: tuple[str, ...], password: str) -> None:
    """Add a user to a file, which is made where it does not exist, or replace the one of this name.

    Raises UsersError.
    """
    if not CHUNK.fullmatch(name):
        raise UsersError(f"{name!r:.80} cannot be a user: 1 to 63 ASCII letters, digits, '-', '_', '.'")
    if not SHORTEST_PASSWORD <= len(password) <= LONGEST_PASSWORD:
        raise UsersError(f"a password has {SHORTEST_PASSWORD} to {LONGEST_PASSWORD} characters, not {len(password)}")
    users = read_users(path) if path.exists() else {}
    users[name] = User(name, tuple(verb for verb in RIGHTS if verb in verbs), _HASHER.hash(password))
    lines = [f"user {user.name} {','.join(user.verbs) or '-'} {user.hashed}\n" for user in users.values()]
    draft = path.with_name(f"{path.name}.new")
    try:
        draft.unlink(missing_ok=True)
        with open(os.open(draft, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "w", encoding="utf-8") as file:
            file.write(_BEGIN + "".join(lines))
            file.flush()
            os.fsync(file.fileno())
        draft.replace(path)
    except OSError as error:
        raise UsersError(f"{path}: cannot be written: {error.strerror}") from None


def password_is(user: User | None, password: str) -> bool:
    """Whether this is the password of the user. Takes 50 ms and 64 MiB, also where there is no such user (None)."""
    try:
        _HASHER.verify(user.hashed if user is not None else _NOBODY, password)
    except (VerificationError, InvalidHashError):
        return False
    return user is not None
