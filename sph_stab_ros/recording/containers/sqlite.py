# Copyright 2026 The sph_stab_ros developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The SQLite files of rosbag2, read as they are: nothing beside them is used or written."""

from collections import Counter
from collections.abc import Collection, Iterator
from contextlib import closing
from pathlib import Path
import re
import sqlite3
import sys

from sph_stab_ros.recording.containers.records import Channel, Message

MAGIC = b'SQLite format 3\0'
# So many rows in a row that cannot be read, and no more is tried.
MOST_LOST_ROWS = 10_000
# How many operations of SQLite's machine a file may take, for each of its bytes and besides.
OPERATIONS_FOR_EACH, STRIDE, LEAST_STRIDES = 100, 10**5, 500
LEAST_LIMIT = 10**6
COMPUTED = re.compile(r'\W*create\W+(view|virtual)', re.IGNORECASE)


class SqliteFile:
    """A rosbag2 SQLite file, read in the order of recording."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.known: dict[int, Channel] = {}

    def channels(self) -> Collection[Channel]:
        """Return the channels that have been met so far."""
        return self.known.values()

    def index(self) -> Counter[Channel] | None:
        """Return the number of messages of each channel, or None where that needs a scan."""
        try:
            with closing(self._open()) as database:
                counts: Counter[Channel] = Counter(dict.fromkeys(self.known.values(), 0))
                for number, count in database.execute(
                        'SELECT topic_id, count(*) FROM messages GROUP BY topic_id'):
                    counts[self.known[number]] += count
        except (sqlite3.DatabaseError, LookupError, ValueError):
            return None
        return counts

    def scan(self, damage: list[str], topics: Collection[str] | None = None
             ) -> Iterator[Message]:
        """Yield the messages; rows that cannot be read are passed over, one by one."""
        try:
            database = self._open()
        except sqlite3.DatabaseError as error:
            damage.append(str(error))
            return
        wanted = [number for number, channel in self.known.items()
                  if topics is None or channel.topic in topics]
        # Every row is visited, so that it is known which one cannot be read.
        query = ('SELECT id, topic_id, timestamp, '
                 f'CASE WHEN topic_id IN ({",".join(map(str, wanted))}) THEN data END '
                 'FROM messages WHERE id > ? ORDER BY id')
        last = lost = 0
        with closing(database):
            while lost < MOST_LOST_ROWS:
                try:
                    for row, number, received_ns, data in database.execute(query, (last,)):
                        if type(row) is not int or row <= last:
                            raise ValueError('the rows are out of order')
                        last, lost = row, 0
                        if isinstance(data, bytes) and isinstance(received_ns, int):
                            yield self.known[number], received_ns, data
                        elif number not in self.known or data is not None:
                            damage.append(f'row {last}')
                    return
                except (sqlite3.DatabaseError, OverflowError, ValueError) as error:
                    last, lost = last + 1, lost + 1
                    damage.append(f'row {last}: {error}')

    def _open(self) -> sqlite3.Connection:
        """Open the database and read its topics."""
        database = sqlite3.connect(f'{self.path.absolute().as_uri()}?immutable=1', uri=True)
        try:
            # Without it SQLite refuses a file shorter than its header says.
            database.execute('PRAGMA writable_schema=ON')
            self._refuse_what_is_made_up(database)
            # Whatever comes out of damaged pages.
            self.known = {
                number: Channel(topic, msgtype, 'cdr')
                for number, topic, msgtype in database.execute(
                    'SELECT id, name, type FROM topics')
                if (type(number), type(topic), type(msgtype)) == (int, str, str)}
        except BaseException:
            database.close()
            raise
        return database

    def _refuse_what_is_made_up(self, database: sqlite3.Connection) -> None:
        """Raise DatabaseError where rows or values are computed, without end perhaps."""
        size = self.path.stat().st_size
        if sys.version_info >= (3, 11):
            database.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, max(size, LEAST_LIMIT))
        left = iter(range(OPERATIONS_FOR_EACH * size // STRIDE + LEAST_STRIDES))
        database.set_progress_handler(lambda: next(left, None) is None, STRIDE)
        if any(COMPUTED.match(sql) for sql, in database.execute(
                'SELECT sql FROM sqlite_master') if isinstance(sql, str)):
            raise sqlite3.DatabaseError('views or virtual tables')
        for table in ('topics', 'messages'):
            if any(hidden for *_, hidden in database.execute(f'PRAGMA table_xinfo({table})')):
                raise sqlite3.DatabaseError('columns that are computed')
