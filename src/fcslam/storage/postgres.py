"""A PostgreSQL server: connections that are shared and replaced, tables in a schema of their own, one kind of error.

psycopg is an extra of its own, so it is imported when a server is used.
"""

import os
import socket
import threading
import time
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from itertools import islice
from typing import TYPE_CHECKING, Any, Final, TypeAlias
from urllib.parse import parse_qsl, unquote, urlencode, urlsplit, urlunsplit

from fcslam.config import one_line
from fcslam.errors import StoreError
from fcslam.storage.row_store import StoreTable, all_rows

if TYPE_CHECKING:
    import psycopg

    _Connection: TypeAlias = psycopg.Connection[tuple[Any, ...]]

RETRY_S: Final = 5.0
"""A server that is gone is looked for this long, before anything was changed."""
ANSWER_S: Final = 10.0
"""A statement that takes longer fails: the server, or the way to it, is gone. A transaction may have many."""
AT_ONCE: Final = 1000
"""Rows that are sent or fetched at once."""
LOOK_EVERY_S: Final = 1.0
"""How often connections in use are looked at."""
MOST_CONNECTIONS: Final = 8
"""Most connections of one process to the server."""


class Postgres:
    """A server, for all threads of this process.

    Raises:
        StoreError: from every method: the server cannot be used now, and nothing has changed, or at a loss of the
            connection in the last moment of a transaction perhaps all of it.
    """

    def __init__(self, url: str, name: str, answer_s: float = ANSWER_S, retry_s: float = RETRY_S) -> None:
        """Look for the server at a URL without a password (``take_password``); it shows ``name`` for this process."""
        self.url = _checked(url)
        self._name, self._answer_s, self._retry_s = name, answer_s, retry_s
        self._idle: list[_Connection] = []
        self._places = threading.Semaphore(MOST_CONNECTIONS)
        self.busy: dict[_Connection, float] = {}
        """When the newest statement of each connection in use began."""
        self._closing = threading.Event()
        with self._translated():
            self._idle.append(self._connected())
        threading.Thread(target=self._watch, name="answers of PostgreSQL", daemon=True).start()

    def close(self) -> None:
        """Close all connections that nobody uses."""
        self._closing.set()
        while self._idle:
            self._idle.pop().close()

    @contextmanager
    def connection(self, begin: str) -> Iterator["_Connection"]:
        """Use a connection alone after the statement ``begin``; what is not committed at the end is undone.

        If the connection turns out to be lost at ``begin``, another one is made.
        """
        with self._places, self._translated():
            connection = self._begun(begin)
            try:
                yield connection
            finally:
                self._give_back(connection)

    def rows(self, statement: str, values: Sequence[object] = (), schema: str = "fcslam") -> list[tuple[Any, ...]]:
        """All rows that a query of a schema finds."""
        with self.connection(f"SET search_path TO {schema}") as connection:
            found: list[tuple[Any, ...]] = PostgresTransaction(self, connection).execute(statement, values).fetchall()
        return found

    def _begun(self, begin: str) -> "_Connection":
        import psycopg

        until = time.monotonic() + self._retry_s
        while True:
            connection = None
            try:
                connection = self._idle.pop() if self._idle else self._connected()
                self.busy[connection] = time.monotonic()
                connection.execute(begin.encode())
                return connection
            except BaseException as error:
                if connection is not None:
                    self._give_back(connection)
                is_lost = isinstance(error, psycopg.OperationalError) and _is_lost(error)
                if not is_lost or time.monotonic() > until:
                    raise
                if not self._idle:
                    time.sleep(0.1)

    def _connected(self) -> "_Connection":
        import psycopg

        return psycopg.connect(
            self.url,
            autocommit=True,
            connect_timeout=3,
            application_name=f"fcslam {self._name}",
            options=f"-c statement_timeout={1e3 * self._answer_s:.0f} -c client_min_messages=error"
            f" -c idle_in_transaction_session_timeout={1e3 * self._retry_s:.0f}",
        )

    def _give_back(self, connection: "_Connection") -> None:
        from psycopg.pq import TransactionStatus

        self.busy.pop(connection, None)
        if not connection.closed and connection.info.transaction_status is not TransactionStatus.IDLE:
            with suppress(Exception):  # it is closed then
                connection.execute("ROLLBACK")
        if connection.closed or self._closing.is_set():
            connection.close()
        else:
            self._idle.append(connection)

    def _watch(self) -> None:
        """Hang up on a server that does not answer: nothing else ends the wait for one that hangs."""
        while not self._closing.wait(LOOK_EVERY_S):
            now = time.monotonic()
            for connection, since in list(self.busy.items()):
                if now > since + self._answer_s + self._retry_s:
                    with suppress(Exception), socket.socket(fileno=os.dup(connection.fileno())) as line:
                        line.shutdown(socket.SHUT_RDWR)

    @contextmanager
    def _translated(self) -> Iterator[None]:
        import psycopg

        try:
            yield
        except psycopg.Error as error:
            rights = isinstance(error, psycopg.errors.InsufficientPrivilege)
            advice = "; the role has too few rights: GRANT CREATE ON DATABASE, or name another role" if rights else ""
            raise StoreError(f"{self.url}: cannot be used ({one_line(str(error))}){advice}", not rights) from error


class PostgresTransaction:
    """A transaction that is open."""

    def __init__(self, server: Postgres, connection: "_Connection") -> None:
        self._server, self._connection = server, connection

    def execute(self, statement: str, values: Sequence[object] = ()) -> "psycopg.Cursor[tuple[Any, ...]]":
        """As in ``Transaction``."""
        self._note()
        return self._connection.execute(statement.replace("?", "%s").encode(), _plain(values), binary=True)

    def insert(self, table: StoreTable, rows: Iterable[Sequence[object]], *, replaces: bool = False) -> None:
        """As in ``Transaction``."""
        marks = ", ".join("%s" for _ in table.columns)
        statement = f"INSERT INTO {table.name} ({', '.join(table.columns)}) VALUES ({marks})"
        if replaces:
            changes = ", ".join(f"{name} = excluded.{name}" for name in table.columns if name not in table.key)
            statement += f" ON CONFLICT ({', '.join(table.key)}) DO UPDATE SET {changes}"
        plain = map(_plain, rows)
        with self._connection.cursor() as cursor:
            while some := list(islice(plain, AT_ONCE)):
                self._note()
                cursor.executemany(statement, some)

    def stream(self, table: StoreTable) -> Iterator[tuple[Any, ...]]:
        """As in ``Transaction``."""
        with self._connection.cursor(name="rows", binary=True) as cursor:
            cursor.execute(all_rows(table))
            while some := cursor.fetchmany(AT_ONCE):
                self._note()
                yield from some

    def _note(self) -> None:
        self._server.busy[self._connection] = time.monotonic()


def take_password(url: str) -> str:
    """The URL without its password, which goes where the driver looks for it: the environment of this process.

    So neither a message nor the command line of a worker shows it.
    """
    parts = urlsplit(url)
    options = dict(parse_qsl(parts.query))
    password = options.pop("password", None if parts.password is None else unquote(parts.password))
    if password is None:
        return url
    os.environ["PGPASSWORD"] = password
    user, at, place = parts.netloc.rpartition("@")
    return urlunsplit(parts._replace(netloc=user.partition(":")[0] + at + place, query=urlencode(options)))


def _checked(url: str) -> str:
    try:
        import psycopg
    except ImportError as error:
        raise StoreError(f"{url}: needs psycopg; install it: pip install 'fcslam[postgres]' ({error})") from error
    try:
        if "sslpassword" in psycopg.conninfo.conninfo_to_dict(url):
            raise StoreError("the store's address has an sslpassword, which messages would show; use PGSERVICEFILE")
    except psycopg.Error as error:
        raise StoreError("the store's address cannot be read; write postgresql://USER@HOST:PORT/DATABASE") from error
    return url


def _is_lost(error: "psycopg.OperationalError") -> bool:
    """Whether a server may be back soon: it was reached before, or nobody listens now."""
    state = error.sqlstate
    return state is None or state.startswith(("08", "57P"))


def _plain(values: Sequence[object]) -> list[object]:
    """Values as the driver takes them: text without NUL, which the server has not, and no class of its own."""
    return [
        str(value).replace("\0", "\N{REPLACEMENT CHARACTER}") if isinstance(value, str) else value for value in values
    ]
