"""The same service on a real PostgreSQL and a real S3 server: migrations, locks, the store, and the whole way."""

import threading
import time

import psycopg
import pytest
import sqlalchemy as sa
from alembic.autogenerate import compare_metadata
from alembic.migration import MigrationContext

from gonio.errors import GonioError, InputError, ResourceError
from gonio.jobs.database import Database, patiently, upgrade
from gonio.jobs.liveness import open_locks
from gonio.jobs.repository import Repository
from gonio.jobs.store import Store
from gonio.jobs.tables import METADATA, KeyRow
from gonio.settings import Settings


@pytest.fixture(params=["sqlite", "postgres"])
def settings(request, tmp_path) -> Settings:
    url = request.getfixturevalue("postgres").new_database() if request.param == "postgres" else ""
    return Settings(data_dir=tmp_path / "data", cache_dir=tmp_path / "cache", database_url=url, port=0)


@pytest.fixture(params=["folder", "bucket"])
def store(request, tmp_path, monkeypatch) -> Store:
    if request.param == "folder":
        return Store.open((tmp_path / "objects").as_uri())
    bucket = request.getfixturevalue("bucket")
    for name, value in bucket.environment.items():
        monkeypatch.setenv(name, value)
    return Store.open(f"{bucket.url}/{tmp_path.name}")


def test_migrations_give_the_tables_that_the_code_expects_also_from_several_processes(settings):
    threads = [threading.Thread(target=upgrade, args=(settings,)) for _ in range(3)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    database = Database(settings.resolved_database_url)
    with database.engine.connect() as connection:
        context = MigrationContext.configure(
            connection, opts={"include_object": lambda _, name, kind, *rest: kind != "table" or name in METADATA.tables}
        )
        assert compare_metadata(context, METADATA) == []
    database.close()


def test_writes_of_one_lab_come_one_after_another(settings):
    upgrade(settings)
    database = Database(settings.resolved_database_url)
    seen: list[int] = []

    def add() -> None:
        with database.write("north") as session:
            repository = Repository(session, "north")
            count = len(repository.keys())
            time.sleep(0.05)
            seen.append(count)
            repository.add(KeyRow(id=str(count), name="", digest=str(count), scopes=[], last_used_at=None))

    threads = [threading.Thread(target=add) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert seen == [0, 1, 2, 3]
    database.close()


def test_a_lock_is_free_when_its_owner_is_gone(settings):
    mine, other = open_locks(settings), open_locks(settings)
    with mine.hold("worker-1"):
        with other.try_hold("worker-1") as dead:
            assert not dead
        assert not mine.renew()
    with other.try_hold("worker-1") as dead:
        assert dead


def test_a_lock_that_an_outage_took_is_taken_again(postgres, tmp_path):
    settings = Settings(data_dir=tmp_path, database_url=postgres.new_database())
    mine, other = open_locks(settings), open_locks(settings)
    with mine.hold("worker-1"):
        with psycopg.connect(settings.database_url, autocommit=True) as admin:
            admin.execute(
                "SELECT pg_terminate_backend(pid) FROM pg_locks WHERE locktype = 'advisory' AND pid <> pg_backend_pid()"
            )
        deadline_s, dead = time.monotonic() + 10, False
        while not dead:
            assert time.monotonic() < deadline_s
            with other.try_hold("worker-1") as dead:
                pass
        assert mine.renew()
        with other.try_hold("worker-1") as dead:
            assert not dead


def test_a_lock_is_taken_again_also_after_an_outage_that_lasts(postgres, tmp_path):
    settings = Settings(data_dir=tmp_path, database_url=postgres.new_database())
    mine, other = open_locks(settings), open_locks(settings)
    with mine.hold("worker-1"):
        postgres.stop()
        for _ in range(2):
            with pytest.raises(psycopg.OperationalError):
                mine.renew()
        postgres.start()
        assert mine.renew()
        assert not mine.renew()
        with other.try_hold("worker-1") as dead:
            assert not dead


def test_what_an_outage_cuts_is_tried_again():
    tries: list[int] = []

    def work() -> str:
        tries.append(1)
        if len(tries) < 3:
            raise sa.exc.OperationalError("SELECT 1", {}, Exception("connection refused"))
        return "done"

    assert patiently(work) == "done"
    with pytest.raises(sa.exc.OperationalError):
        tries.clear()
        patiently(work, patience_s=-1)


def test_the_store_keeps_finds_and_deletes(store, tmp_path):
    stored = store.put_bytes("labs/a/s1", "x.npz", b"content")
    assert store.get_bytes(stored) == b"content"
    (tmp_path / "video").write_bytes(b"v" * 100_000)
    file = store.put_file("labs/a/s1", "video", tmp_path / "video")
    job = tmp_path / "job"
    job.mkdir()
    with store.local_path(file.key, job) as path:
        assert path.stat().st_size == file.size == 100_000
        # A copy has to lie where the next worker clears up after one that was killed.
        assert path.parent == job or path.is_relative_to(tmp_path / "objects")
    store.take_file("labs/a/s1/files/1", tmp_path / "video")
    assert not (tmp_path / "video").exists()
    store.put_bytes("labs/a/s11", "x", b"of another session")
    store.delete("labs/a/s1")
    assert not store.is_there("labs/a/s1")
    assert store.is_there("labs/a/s11")
    with pytest.raises(GonioError) as caught:
        store.get_bytes(stored)
    assert caught.value.code == "artefact-damaged"
    with pytest.raises(GonioError, match="no longer in the store"), store.local_path(file.key):
        pass


def test_a_store_out_of_reach_and_one_of_unknown_kind_are_clear_errors(monkeypatch):
    monkeypatch.setenv("AWS_ENDPOINT_URL", "http://127.0.0.1:9")
    monkeypatch.setenv("AWS_ACCESS_KEY_ID", "a")
    monkeypatch.setenv("AWS_SECRET_ACCESS_KEY", "b")
    with pytest.raises(ResourceError) as caught:
        Store.open("s3://bucket/x", patience_s=0.1).put_bytes("a", "b", b"c")
    assert caught.value.code == "store-unreachable"
    with pytest.raises(InputError) as caught_other:
        Store.open("ftp://host/x")
    assert caught_other.value.code == "store-unsupported"
