"""Reading of the sqlite3 storage of rosbag2, read-only.

The database has no checksums. A damaged page makes a query fail part of the way: the pass then
continues behind it and counts the rows that it skips.
"""

from __future__ import annotations

import sqlite3
from collections.abc import Iterator
from pathlib import Path

from avsreplay.errors import UnreadableInput
from avsreplay.log.bytes_io import ZSTD_MAGIC, BadMessage, shown
from avsreplay.log.index import Recording, Sink, canonical_type
from avsreplay.log.options import Loss

# ValueError: an error message of sqlite may contain bytes that are not UTF-8.
_SQLITE = (sqlite3.Error, OverflowError, ValueError)
_HEADER_BYTES = 64  # the first bytes of a cloud message contain its header stamp
_SINGLE_STEPS = 4096  # rows tried one by one behind a damaged page before the stride doubles
_COLUMNS_QUERY = "SELECT * FROM pragma_table_xinfo(?)"  # the last value of a column: whether hidden
_MAX_ROW_ID = 1 << 62  # used if the last id is unknown: the stride doubles, so few steps are needed


class Db3File(Recording):
    """One sqlite3 file of a ROS 2 bag, indexed on construction."""

    kind = "ros2 bag"
    profile = "ros2"

    def __init__(self, path: Path, limit: int, sinks: dict[str, Sink] | None = None) -> None:
        """Open and index the database.

        Args:
            path: the file.
            limit: largest message that is read [bytes].
            sinks: called with every message of a topic during the pass.

        Raises:
            UnreadableInput: the file does not exist or is not the database of a bag.
        """
        super().__init__(path, limit, sinks)
        self._topics: dict[int, str] = {}
        self._db = _connected(path, limit)
        try:
            self._survey()
        except _SQLITE as error:
            self._db.close()
            raise _unreadable(path, error) from None

    def _stored(self, topic: str, place: int) -> bytes | memoryview:
        """Return a message as it is stored. Raises BadMessage if it cannot be read."""
        row_id = self._table.clouds(topic).offset[place]
        try:
            row = self._db.execute("SELECT data FROM messages WHERE id = ?", (row_id,)).fetchone()
        except _SQLITE as error:
            raise BadMessage(f"the database is damaged: {error}") from None
        if row is None or not isinstance(row[0], bytes):
            raise BadMessage("the message is no longer in the database")
        return row[0]

    def close(self) -> None:
        """Close the database."""
        self._db.close()

    def _survey(self) -> None:
        for row_id, name, kind, encoding in self._db.execute(
            "SELECT id, name, type, serialization_format FROM topics ORDER BY id"
        ):
            self._topics[int(row_id)] = str(name)
            self._table.declare(str(name), canonical_type(str(kind)), str(encoding))
        last = self._last()
        lost = skipped = 0
        for row in self._rows(last):
            if row is None:
                skipped += 1
            elif not self._take(row):
                lost += 1
        if skipped or lost:
            what = (
                "the database is damaged"
                if skipped
                else "messages without a topic, a time or bytes"
            )
            self.losses.append(Loss(what, 0, 0, messages=lost or None, file=self.path.name))

    def _last(self) -> int:
        try:
            row = self._db.execute("SELECT max(id) FROM messages").fetchone()
        except (sqlite3.DatabaseError, UnicodeDecodeError):
            return _MAX_ROW_ID
        return int(row[0]) if row and row[0] is not None else 0

    def _rows(self, last: int) -> Iterator[tuple[object, ...] | None]:
        """Yield the messages by id; None for a range that cannot be read."""
        query = (
            "SELECT id, topic_id, timestamp, substr(data, 1, ?) FROM messages WHERE id > ? AND id"
            " <= ? ORDER BY id"
        )
        at, failures = -1, 0
        while at < last:
            done = at
            try:
                for row in self._db.execute(query, (_HEADER_BYTES, at, last)):
                    yield row
                    done = max(done, row[0] if isinstance(row[0], int) else 0)
                return
            except (sqlite3.DatabaseError, UnicodeDecodeError):
                yield None
                failures = 1 if done > at else failures + 1
                at = done + (
                    1 if failures <= _SINGLE_STEPS else 1 << min(failures - _SINGLE_STEPS, 62)
                )

    def _take(self, row: tuple[object, ...]) -> bool:
        row_id, topic_id, log_ns, head = row
        if not (isinstance(row_id, int) and isinstance(topic_id, int) and isinstance(log_ns, int)):
            return False
        topic = self._topics.get(topic_id)
        if topic is None or not isinstance(head, bytes):
            return False
        payload = memoryview(head)
        if self._table.wants(topic) or head.startswith(ZSTD_MAGIC):
            whole = self._db.execute(
                "SELECT data FROM messages WHERE id = ?", (row_id,)
            ).fetchone()[0]
            payload = memoryview(whole if isinstance(whole, bytes) else b"")
        self._table.add(topic, (max(log_ns, 0), max(log_ns, 0)), payload, (0, row_id))
        return True


def _connected(path: Path, limit: int) -> sqlite3.Connection:
    # The write-ahead log beside the file holds messages of a recorder that was killed: sqlite must
    # read it.
    alone = not path.with_name(path.name + "-wal").exists()
    uri = f"{path.resolve().as_uri()}?mode=ro" + ("&immutable=1" if alone else "")
    try:
        db = sqlite3.connect(uri, uri=True, check_same_thread=False)
        db.text_factory = lambda raw: raw.decode("utf-8", "backslashreplace")
        db.execute("PRAGMA trusted_schema = OFF")
        db.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, limit)
        # A virtual table has no pages of its own; a hidden column is computed when it is read.
        found = {
            str(name): not any(column[6] for column in db.execute(_COLUMNS_QUERY, (name,)))
            for (name,) in db.execute(
                "SELECT name FROM sqlite_master WHERE type = 'table' AND rootpage > 0"
            ).fetchall()
        }
    except _SQLITE as error:
        raise _unreadable(path, error) from None
    for name in ("topics", "messages"):
        if not found.get(name):
            db.close()
            raise UnreadableInput(
                f"a database without the table '{name}' of stored values",
                where=shown(path),
                hint="give a ROS 2 bag",
            )
    return db


def _unreadable(path: Path, error: Exception) -> UnreadableInput:
    hint = "the sqlite3 program's .recover may save part of it"
    return UnreadableInput(
        f"not a readable ROS 2 bag: {shown(error)}", where=shown(path), hint=hint
    )
