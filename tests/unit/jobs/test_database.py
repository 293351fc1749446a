"""The migrations make the tables that the code expects, and what SQLite is asked for holds."""

import sqlite3
import threading
from importlib.resources import files

import pytest
import sqlalchemy as sa
from alembic import command
from alembic.config import Config

from gonio.jobs.database import Database, upgrade
from gonio.jobs.repository import Place, Repository
from gonio.jobs.tables import JobRow, JobState, SessionRow
from gonio.settings import Settings


@pytest.fixture
def settings(tmp_path) -> Settings:
    return Settings(data_dir=tmp_path / "a folder ü")


@pytest.fixture
def database(settings):
    upgrade(settings)
    database = Database(settings.resolved_database_url)
    yield database
    database.close()


def migrate(database: Database, what) -> None:
    config = Config()
    config.set_main_option("script_location", str(files("gonio.jobs") / "migrations"))
    with database.write() as session:
        config.attributes["connection"] = session.connection()
        what(config)


def test_migrations_and_tables_agree(database):
    migrate(database, command.check)


def test_migrations_go_back_and_forth(database):
    migrate(database, lambda config: command.downgrade(config, "base"))
    with database.read() as session:
        assert "sessions" not in sa.inspect(session.connection()).get_table_names()
    migrate(database, lambda config: command.upgrade(config, "head"))
    migrate(database, command.check)


def test_several_processes_may_upgrade_at_once(settings):
    threads = [threading.Thread(target=upgrade, args=(settings,)) for _ in range(6)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    upgrade(settings)


def session_row(number: int) -> SessionRow:
    return SessionRow(id=str(number), kind="human_multicamera", name="", subject={})


def test_two_writers_wait_for_each_other(database):
    def write(number: int) -> None:
        with database.write() as session:
            repository = Repository(session, "lab")
            count = len(repository.sessions(200))  # what was read stays true until the commit
            repository.add(SessionRow(id=str(number), kind="k", name=str(count), subject={}))

    threads = [threading.Thread(target=write, args=(number,)) for number in range(12)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    with database.read() as session:
        names = {row.name for row in Repository(session, "lab").sessions(200)}
    assert names == {str(count) for count in range(12)}


def test_a_failed_write_leaves_nothing(database):
    with pytest.raises(RuntimeError), database.write() as session:
        Repository(session, "lab").add(session_row(1))
        raise RuntimeError
    with database.read() as session:
        assert Repository(session, "lab").sessions(10) == []


def test_labs_see_nothing_of_each_other(database):
    with database.write() as session:
        Repository(session, "a").add(session_row(1))
        job = JobRow(id="j", session_id="1", state=JobState.TODO, parameters={}, files=[])
        Repository(session, "a").add(job)
    with database.write() as session:
        other = Repository(session, "b")
        assert other.sessions(10) == other.jobs(10) == other.active_jobs("1") == []
        assert other.find_job("j") is None
        assert not other.change_job("j", [JobState.TODO], state=JobState.CANCELLED)
        assert Repository(session, "a").change_job("j", [JobState.TODO], state=JobState.DOING)
        assert not Repository(session, "a").change_job("j", [JobState.TODO], state=JobState.DOING)


def test_pages_follow_each_other(database):
    with database.write() as session:
        for number in range(5):
            Repository(session, "lab").add(session_row(number))
    with database.read() as session:
        repository = Repository(session, "lab")
        first = repository.sessions(2)
        rest = repository.sessions(10, Place(first[-1].created_at, first[-1].id))
    assert [row.id for row in [*first, *rest]] == ["4", "3", "2", "1", "0"]


def test_foreign_keys_are_kept(database):
    with pytest.raises(sa.exc.IntegrityError), database.write() as session:
        Repository(session, "a").add(JobRow(id="j", session_id="no", state="todo", parameters={}, files=[]))


def test_the_file_is_in_write_ahead_mode(settings, database):
    connection = sqlite3.connect(settings.data_dir / "gonio.db")
    assert connection.execute("PRAGMA journal_mode").fetchone() == ("wal",)
    connection.close()
