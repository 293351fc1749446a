"""The queue of jobs: DBOS's client, as gonio uses it. It never runs a job, and it never waits for the database to come back."""

from collections.abc import Mapping, Sequence
from typing import Any

from dbos import DBOSClient, DBOSPortableJSONSerializer, WorkflowStatus
from sqlalchemy.orm import Session

from gonio.jobs.database import Database
from gonio.jobs.postgres import is_postgres, with_driver
from gonio.jobs.repository import Repository
from gonio.jobs.tables import ACTIVE, JobRow, JobState

APPLICATION = "gonio"
WORKFLOW = "analyse"
QUEUE = "analysis"
PROGRESS = "progress"
"""The DBOS event under which a job's progress is published."""


class Queue:
    """Jobs that wait or are being computed. A job and its workflow have the same id."""

    def __init__(self, url: str) -> None:
        self._client = DBOSClient(
            system_database_url=with_driver(url).render_as_string(hide_password=False) if is_postgres(url) else url,
            application_name=APPLICATION,
            serializer=DBOSPortableJSONSerializer(),
            retry_connection_errors=False,
        )

    def close(self) -> None:
        """Close all connections."""
        self._client.destroy()

    def add(self, session: Session, lab: str, job_id: str, place: int) -> None:
        """Queue a job within the transaction that adds its row: there is never the one without the other.

        Args:
            session: The transaction.
            lab: The job's lab.
            job_id: The job.
            place: How many jobs of its lab are active with it. Lower ones are served first, so that a lab which queues a
                hundred jobs doesn't make the others wait for all of them.
        """
        self._client.enqueue_in_transaction(
            session,
            {"queue_name": QUEUE, "workflow_name": WORKFLOW, "workflow_id": job_id, "priority": place},
            lab,
            job_id,
        )

    def add_again(self, database: Database, lab: str, job_id: str) -> None:
        """Queue a job anew whose workflow was forgotten, if it is still wanted."""
        with database.write(lab) as session:
            if Repository(session, lab).change_job(
                job_id, ACTIVE, state=JobState.TODO, generation=JobRow.generation + 1
            ):
                self.add(session, lab, job_id, 1)

    def cancel(self, job_id: str) -> None:
        """Cancel a job, wherever it is."""
        self._client.cancel_workflow(job_id)

    def resume(self, job_id: str) -> None:
        """Put a job that a worker had back into the queue."""
        self._client.resume_workflow(job_id, queue_name=QUEUE)  # the queue: or its limits would be bypassed

    def forget(self, job_ids: Sequence[str]) -> None:
        """Delete all that is known of jobs: their arguments, steps and events."""
        if job_ids:
            self._client.delete_workflows(list(job_ids))

    def progress(self, job_id: str) -> Mapping[str, Any] | None:
        """Give what the worker last said of a job."""
        return self._client.get_event(job_id, PROGRESS, timeout_seconds=0)

    def pending(self, owner: str | None = None) -> Sequence[WorkflowStatus]:
        """List the workflows that a worker has, of one worker if it is named."""
        return self._client.list_workflows(status="PENDING", executor_id=owner, load_input=False, load_output=False)

    def of_jobs(self, job_ids: Sequence[str]) -> Sequence[WorkflowStatus]:
        """List the workflows of jobs."""
        return self._client.list_workflows(workflow_ids=list(job_ids), load_input=False, load_output=False)

    def step_names(self, job_id: str) -> Sequence[str]:
        """Name the steps of a job that are done, in order."""
        return [step["function_name"] for step in self._client.list_workflow_steps(job_id, load_output=False)]
