"""Bags of rosbag2 in SQLite (.db3), by the standard library.

The tables are those of rosbag2_storage_sqlite3 (ros2/rosbag2). `message_definitions` is there from ROS 2 Iron on.
"""

from __future__ import annotations

import sqlite3
from collections.abc import Iterator
from contextlib import closing
from urllib.parse import quote

from agent.reading.bag import MOST_DEFINITION, Bag, BagChannel, BagMessage
from agent.reading.source import TableError

LONGEST = 1 << 27  # bytes of a message


class SqliteBag(Bag):
    """A bag in SQLite."""

    def messages(self) -> Iterator[BagMessage]:
        """Yield the messages in the order in which they were written. Raises TableError."""
        self.said, unknown, count = [], 0, 0
        self._say_log()
        # The name is quoted: a ? or # in it would name another file. Nothing beside the file is read or written.
        name = f"file:{quote(str(self.path.absolute()))}?mode=ro&immutable=1"
        try:
            with closing(sqlite3.connect(name, uri=True)) as file:
                self._declare_topics(file)
                for number, time_ns, data in self._rows(file):
                    count += 1
                    if number in self.channels and isinstance(time_ns, int) and isinstance(data, bytes):
                        yield BagMessage(number, time_ns, time_ns, data)
                    else:
                        unknown += 1
        except (sqlite3.Error, OverflowError) as error:
            if not count:
                raise TableError(
                    f"{self.path}: the file cannot be read: {error}; save what is whole with "
                    f"`sqlite3 {self.path.name} .recover`, or record it anew"
                ) from None
            self.said.append(f"{self.path}: the file is cut or damaged; it is read up to message {count} ({error})")
        self.undeclared(unknown)

    def _say_log(self) -> None:
        """Say that SQLite left messages in a file beside, as after a power cut."""
        log = self.path.with_name(self.path.name + "-wal")
        if log.is_file() and log.stat().st_size:
            self.said.append(
                f"{self.path}: its newest messages are in {log.name}, which is not read; to have them too, run "
                f"`sqlite3 {self.path.name} 'PRAGMA wal_checkpoint'` on copies of both files"
            )

    def _declare_topics(self, file: sqlite3.Connection) -> None:
        """Keep the topics as channels, with the definitions of their types. Raises sqlite3.Error, TableError."""
        file.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, LONGEST)
        file.execute("PRAGMA trusted_schema = OFF")
        file.execute("PRAGMA writable_schema = ON")  # otherwise SQLite reads nothing of a file that is cut
        file.text_factory = lambda text: text[:MOST_DEFINITION].decode("utf-8", "replace")
        tables = {name for (name,) in file.execute("SELECT name FROM sqlite_master WHERE type = 'table'")}
        if not {"topics", "messages"} <= tables:
            raise TableError(f"{self.path}: the database has no tables topics and messages; give a .db3 of rosbag2")
        known: dict[str, tuple[str, str]] = {}
        if "message_definitions" in tables:
            rows = file.execute("SELECT topic_type, encoding, encoded_message_definition FROM message_definitions")
            known = {str(kind): (str(language), str(text)) for kind, language, text in rows}
        for number, topic, kind, serial in file.execute("SELECT id, name, type, serialization_format FROM topics"):
            language, definition = known.get(str(kind), ("ros2msg", ""))
            self.declare(number, BagChannel(str(topic), str(kind), language, definition, str(serial)))

    def _rows(self, file: sqlite3.Connection) -> Iterator[tuple[int, int, bytes]]:
        """Yield the rows of the messages. Raises sqlite3.Error at a cut, TableError where the file cannot hold them."""
        left, last = self.path.stat().st_size, 0
        rows = file.execute("SELECT rowid, topic_id, timestamp, data FROM messages NOT INDEXED")
        for row, number, time_ns, data in rows:
            left -= 1 + (len(data) if isinstance(data, bytes) else 0)
            if left < 0:
                raise TableError(
                    f"{self.path}: the messages have more bytes than the file; it is damaged or hostile: record it anew"
                )
            if row <= last:  # the part of a page that is missing reads as zeros
                raise sqlite3.DatabaseError("the next one is not there")
            last = row
            yield number, time_ns, data
