"""A subject's data can be deleted, all of it: looked for in every table, every object and every byte of the disk."""

from collections.abc import Iterator
from datetime import timedelta
from pathlib import Path
from uuid import uuid4

import pytest
import sqlalchemy as sa

from gonio.errors import GonioError
from gonio.jobs.database import Database
from gonio.jobs.service import Service
from gonio.jobs.store import Store
from gonio.jobs.tables import ErasureRow, now

KEPT = {"erasures", "readings"}
"""What stays, and is told: which session was deleted when, and who read it. Ids only."""


def cells(database: Database) -> Iterator[tuple[str, str]]:
    """Give all that stands in any table, gonio's own and DBOS's, each with the table's name."""
    with database.engine.connect() as connection:
        inspector = sa.inspect(connection)
        postgres = connection.dialect.name == "postgresql"
        for schema in ("public", "dbos") if postgres else (None,):
            for name in inspector.get_table_names(schema=schema):
                table = sa.Table(name, sa.MetaData(), schema=schema, autoload_with=connection)
                for row in connection.execute(sa.select(table)):
                    yield name, repr(tuple(row))


def files_with(folder: Path, texts: list[str]) -> list[Path]:
    found: list[Path] = []
    for path in folder.rglob("*"):
        if path.is_file():
            content = path.read_bytes()
            if any(text.encode() in content or text in path.name for text in texts):
                found.append(path)
    return found


@pytest.fixture(params=["sqlite", "postgres"])
def service_lab(request, start_lab, monkeypatch, tmp_path):
    if request.param == "sqlite":
        return start_lab(workers=1)
    bucket = request.getfixturevalue("bucket")
    for name, value in bucket.environment.items():
        monkeypatch.setenv(name, value)
    url = request.getfixturevalue("postgres").new_database()
    return start_lab(workers=1, objects_url=f"{bucket.url}/{tmp_path.name}", database_url=url)


class Subject:
    """A session that leaves traces everywhere: files, an upload that isn't whole, a report, a job that failed."""

    def __init__(self, lab, capture: Path, journal) -> None:
        self.name, self.video = f"Anna-{uuid4().hex}", f"walk-{uuid4().hex}.mp4"
        self.session = lab.client.create_session(name=self.name)["id"]
        lab.client.upload(self.session, capture / "cam01.mp4", name=self.video)
        for name in ("cam02.mp4", "calibration.xml"):
            lab.client.upload(self.session, capture / name)
        begin = {"Tus-Resumable": "1.0.0", "Upload-Length": "100", "Upload-Metadata": "filename YS5tcDQ="}
        begun = lab.http.post(f"/v1/sessions/{self.session}/uploads", headers=begin)
        self.upload = begun.headers["location"].rpartition("/")[2]
        good = lab.client.analyse(self.session, journal.parameters(seconds=0.0, note=self.name))["id"]
        bad = lab.client.analyse(self.session, journal.parameters(fault={"keypoints": "capture"}))["id"]
        lab.client.wait(good, timeout_s=90)
        with pytest.raises(GonioError, match="Nobody"):
            lab.client.wait(bad, timeout_s=90)
        self.ids = [self.session, good, bad]


def erase(lab, session: str) -> None:
    """Delete a session, and let the minute pass after which nothing comes any more."""
    lab.client.delete_session(session)
    database = Database(lab.settings.resolved_database_url)
    with database.write() as db:
        db.execute(sa.update(ErasureRow).values(created_at=now() - timedelta(hours=1)))
    database.close()
    service = Service(lab.settings, lambda path, role: {})
    service.erase_again()
    service.close()


@pytest.mark.slow
def test_nothing_is_left_of_a_subject_and_everything_of_the_others(service_lab, capture, journal, tmp_path):
    lab, settings = service_lab, service_lab.settings
    other = lab.complete_session(capture)  # the same bytes
    report = lab.client.analyse(other, journal.parameters(seconds=0.0))["id"]
    subject = Subject(lab, capture, journal)
    names, prefix = [subject.name, subject.video], f"labs/default/sessions/{subject.session}"
    tables, store = Database(settings.resolved_database_url), Store.open(settings.resolved_objects_url)
    assert {name for name, cell in cells(tables) if subject.name in cell} >= {"sessions", "operation_outputs"}
    assert store.is_there(prefix)
    assert settings.database_url or files_with(settings.data_dir, names)

    erase(lab, subject.session)

    assert {name for name, cell in cells(tables) if any(each in cell for each in subject.ids)} <= KEPT
    assert not [name for name, cell in cells(tables) if any(each in cell for each in names)]
    assert not store.is_there(prefix)
    for folder in (settings.data_dir, settings.cache_dir):  # free pages of the database, its log, work in progress
        assert files_with(folder, [*names, subject.upload]) == []
    (told,) = lab.http.get("/v1/erasures").json()["items"]
    assert (told["session"], told["done_at"] is not None) == (subject.session, True)
    assert len(lab.client.files(other)) == 3
    assert len(lab.client.download(report, tmp_path / "report")) == 3
    tables.close()
