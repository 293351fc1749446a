"""What goes in and out over HTTP, as the OpenAPI page shows it."""

import json
from collections.abc import Mapping
from datetime import UTC, datetime
from typing import Annotated, Any, Generic, Literal, Self, TypeVar, cast
from uuid import UUID

from pydantic import BaseModel, ConfigDict, Field, PlainSerializer, field_validator

from gonio.http.problems import entry_of
from gonio.jobs.access import LONGEST_KEY, NewKey, Scope
from gonio.jobs.service import JobView
from gonio.jobs.tables import CalibrationRow, ErasureRow, FileRow, JobState, KeyRow, ReadingRow, ReportRow, SessionRow
from gonio.pipeline.run import Role, SessionKind
from gonio.records import LabSource, Level, Severity

T = TypeVar("T")

Time = Annotated[datetime, PlainSerializer(lambda time: time.replace(tzinfo=UTC).isoformat().replace("+00:00", "Z"))]
PRINTABLE = r"^[^\x00-\x1f\x7f]*$"


class _In(BaseModel):
    model_config = ConfigDict(extra="forbid", allow_inf_nan=False)


class Subject(_In):
    """The person; each value makes the body model more like them."""

    model_config = ConfigDict(json_schema_extra={"example": {"mass_kg": 61.0, "stature_m": 1.68, "sex": "female"}})

    code: str | None = Field(
        default=None,
        min_length=1,
        max_length=100,
        pattern=PRINTABLE,
        description="What the lab calls this person, the same in all of their sessions. A pseudonym: names don't belong here.",
    )
    mass_kg: float | None = Field(default=None, gt=0, le=500, description="Needed for torques.")
    stature_m: float | None = Field(default=None, gt=0.3, le=2.8)
    sex: Literal["female", "male"] | None = Field(default=None, description="Chooses the regression of segment masses.")


class SessionIn(_In):
    """A session to create."""

    model_config = ConfigDict(
        json_schema_extra={
            "example": {
                "kind": "human_multicamera",
                "name": "Anna, barefoot, 2nd walk",
                "subject": {"mass_kg": 61.0, "stature_m": 1.68, "sex": "female"},
            }
        }
    )

    kind: SessionKind = Field(
        description="`human_multicamera`: a person filmed by several synchronized cameras. `human_monocular`: by one, whose "
        "place over the floor is calibrated; the subject's stature makes the scale. `articulated_object`: a thing "
        "with joints in a few pictures of one moving camera. `calibration`: a board filmed by the cameras, from which they are "
        "calibrated."
    )
    name: str = Field(default="", max_length=200, pattern=PRINTABLE, description="For people; need not be unique.")
    subject: Subject = Field(
        default=Subject(), description="The person: mass_kg, stature_m, sex; each may be left out."
    )

    calibration: UUID | None = Field(
        default=None,
        description="The calibration of these cameras, for all analyses that name no other; with kind `calibration`, the "
        "earlier one that is checked.",
    )


class SessionOut(BaseModel):
    """A session."""

    id: str
    kind: str
    name: str
    subject: Subject
    calibration: str | None
    created_at: Time

    @classmethod
    def of(cls, row: SessionRow) -> Self:
        """Show a session."""
        return cls(
            id=row.id,
            kind=row.kind,
            name=row.name,
            subject=Subject(**row.subject),
            calibration=row.calibration_id,
            created_at=row.created_at,
        )


class FileOut(BaseModel):
    """An accepted file."""

    id: str
    name: str
    role: str
    camera: str | None
    size: int = Field(description="In bytes.")
    sha256: str
    facts: dict[str, Any] = Field(description="What gonio saw in it: rate, frames, cameras.")
    created_at: Time
    content: str = Field(description="Where its content is.")

    @classmethod
    def of(cls, row: FileRow) -> Self:
        """Show a file."""
        return cls(
            id=row.id,
            name=row.name,
            role=row.role,
            camera=row.camera,
            size=row.size,
            sha256=row.sha256,
            facts=row.facts,
            created_at=row.created_at,
            content=f"/v1/sessions/{row.session_id}/files/{row.id}",
        )


class FileFields(_In):
    """The text fields of an upload."""

    role: Role | None = None
    camera: str | None = Field(default=None, min_length=1, max_length=100, pattern=PRINTABLE)


class AnalysisIn(_In):
    """An analysis or a calibration to start."""

    model_config = ConfigDict(json_schema_extra={"example": {"parameters": {}}})

    parameters: dict[str, Any] = Field(default_factory=dict, description="What differs from the defaults.")
    calibration: UUID | None = Field(default=None, description="The calibration to use in place of the session's.")

    @field_validator("parameters")
    @classmethod
    def _check_parameters(cls, value: dict[str, Any]) -> dict[str, Any]:
        if "subject" in value:
            raise ValueError("the subject belongs to the session")
        json.dumps(value, allow_nan=False, ensure_ascii=False).encode()  # no NaN, no halves of characters
        return value


class ParametersOut(BaseModel):
    """What an analysis and a calibration may be asked for."""

    analysis: dict[str, Any] = Field(description="A JSON schema, with defaults; all but `subject`, the session's.")
    calibration: dict[str, Any] = Field(description="The same for sessions of kind `calibration`.")


class ProgressOut(BaseModel):
    """How far a job is."""

    stage: str
    fraction: float = Field(ge=0, le=1, description="Of the whole analysis.")
    remaining_s: float | None = Field(description="An estimate; null while there is none.")


class JobProblem(BaseModel):
    """Why a job failed."""

    code: str
    message: str
    hint: str
    type: str = Field(description="The page that explains the code.")
    details: dict[str, Any]

    @classmethod
    def of(cls, problem: Mapping[str, Any]) -> Self:
        """Show a problem as the worker described it."""
        return cls(
            code=problem["code"],
            message=problem["message"],
            hint=problem["hint"],
            type=f"/problems/{entry_of(problem['code'], problem['kind'])}",
            details=problem["details"],
        )


class StageOut(BaseModel):
    """A finished stage."""

    name: str
    seconds: float


class JobOut(BaseModel):
    """An analysis or a calibration on its way."""

    model_config = ConfigDict(
        json_schema_extra={
            "example": {
                "id": "15f42e07-bcda-5b94-b1f1-fbe7f0923e26",
                "session": "dc7008fb-95ed-44bc-8a13-5d37aa03ee1e",
                "state": "doing",
                "progress": {"stage": "keypoints", "fraction": 0.42, "remaining_s": 96.0},
                "problem": None,
                "report": None,
                "calibration": None,
                "stages": [],
                "created_at": "2026-11-25T09:00:00Z",
                "started_at": "2026-11-25T09:00:00.4Z",
                "ended_at": None,
            }
        }
    )

    id: str
    session: str
    state: JobState
    progress: ProgressOut | None = Field(description="While it is being computed.")
    problem: JobProblem | None = Field(description="When it failed.")
    report: str | None = Field(description="Where its report is, when it succeeded.")
    calibration: str | None = Field(
        description="Where its calibration is, when it succeeded in a session of that kind."
    )
    stages: list[StageOut] = Field(description="The wall time of each stage, when it succeeded.")
    created_at: Time
    started_at: Time | None
    ended_at: Time | None

    @classmethod
    def of(cls, view: JobView) -> Self:
        """Show a job."""
        row = view.row
        done, calibrates = row.state == JobState.SUCCEEDED, row.kind == "calibration"
        return cls(
            id=row.id,
            session=row.session_id,
            state=JobState(row.state),
            progress=ProgressOut(**view.progress) if view.progress else None,
            problem=JobProblem.of(row.problem) if row.problem else None,
            report=f"/v1/reports/{row.id}" if done and not calibrates else None,
            calibration=f"/v1/calibrations/{row.id}" if done and calibrates else None,
            stages=[StageOut(**stage) for stage in row.stages],
            created_at=row.created_at,
            started_at=row.started_at,
            ended_at=row.ended_at,
        )


class ResultFileOut(BaseModel):
    """A file of a report or of a calibration."""

    name: str
    kind: str = Field(description="`document` is the JSON, `page` the HTML; `other` is for other programs.")
    size: int
    sha256: str
    url: str

    @classmethod
    def list_of(cls, row: ReportRow | CalibrationRow) -> list[Self]:
        """Show the files of a result."""
        resource = "reports" if isinstance(row, ReportRow) else "calibrations"
        return [
            cls(
                name=file["name"],
                kind=file["kind"],
                size=file["size"],
                sha256=file["sha256"],
                url=f"/v1/{resource}/{row.id}/files/{file['name']}",
            )
            for file in row.files
        ]


class FindingOut(BaseModel):
    """Something to know about a result, in words, and what to do about it."""

    code: str
    severity: Severity
    stage: str
    message: str
    hint: str
    where: str
    value: float | None
    unit: str


class CalibrationOut(BaseModel):
    """A calibrated rig, and whether it can be trusted."""

    id: str
    session: str
    name: str
    verdict: Level = Field(description="`reject`: don't use it; an analysis that does says so in its report.")
    cameras: list[str]
    left_out: list[str] = Field(description="Cameras that never saw the board together with the others.")
    board: str
    lab_source: LabSource = Field(description="What told where up, forward and the floor are; `cameras` is a guess.")
    volume_error_mm: float | None = Field(description="Error to expect of a point in the covered volume (rms).")
    findings: list[FindingOut]
    files: list[ResultFileOut]
    created_at: Time

    @classmethod
    def of(cls, row: CalibrationRow) -> Self:
        """Show a calibration."""
        return cls(
            id=row.id,
            session=row.session_id,
            name=row.name,
            verdict=cast("Level", row.level),
            files=ResultFileOut.list_of(row),
            created_at=row.created_at,
            **row.summary,
        )


class ListOf(BaseModel, Generic[T]):
    """One page of a list."""

    items: list[T]
    next_cursor: str | None = Field(
        default=None, description="Send it as `cursor` for the next page; null on the last one."
    )


class Health(BaseModel):
    """How the service is."""

    status: Literal["alive", "ready"]
    version: str


class Problem(BaseModel):
    """A problem document (RFC 9457). More members may say more."""

    model_config = ConfigDict(
        extra="allow",
        json_schema_extra={
            "example": {
                "type": "/problems/too-few-videos",
                "title": "Too few videos",
                "status": 409,
                "detail": "The session has one video; the analysis needs at least two.",
                "instance": "/v1/sessions/dc7008fb-95ed-44bc-8a13-5d37aa03ee1e/analyses",
                "code": "too-few-videos",
                "hint": "Upload the videos of at least two calibrated cameras, then start the analysis again.",
            }
        },
    )

    type: str = Field(description="The address of a page that explains it.")
    title: str
    status: int
    detail: str
    instance: str | None = None
    code: str = Field(description="A stable name, for programs.")
    hint: str | None = Field(default=None, description="What to do about it.")
    errors: list[dict[str, str]] | None = Field(
        default=None, description="With `invalid-request`: what is wrong, and where."
    )
    reference: str | None = Field(
        default=None, description="With `internal-error`: where it stands in the service's log."
    )


class SignIn(_In):
    """A key to sign in with."""

    key: str = Field(min_length=1, max_length=LONGEST_KEY)


class CallerOut(BaseModel):
    """Who asks."""

    lab: str
    scopes: list[str]
    signed_in: bool = Field(description="Whether a cookie of `POST /sign-in` came along.")


class KeyIn(_In):
    """A key to make."""

    name: str = Field(max_length=200, min_length=1, pattern=PRINTABLE, description="For people: who or what has it.")
    scopes: list[Scope] = Field(
        min_length=1,
        max_length=3,
        description="`read`: see all of the lab's. `write`: create, upload, analyse, cancel, delete. `admin`: keys and audit.",
    )
    lifetime_days: float | None = Field(default=None, gt=0, le=3650, description="Without one, until it is revoked.")


class KeyOut(BaseModel):
    """A key of the lab, without the key itself."""

    id: str
    name: str
    scopes: list[str]
    created_at: Time
    expires_at: Time | None = Field(description="When it ends, or ended.")
    last_used_at: Time | None = Field(description="To the minute.")

    @classmethod
    def of(cls, row: KeyRow) -> Self:
        """Show a key."""
        return cls(
            id=row.id,
            name=row.name,
            scopes=row.scopes,
            created_at=row.created_at,
            expires_at=row.expires_at,
            last_used_at=row.last_used_at,
        )


class KeyMade(KeyOut):
    """A key that was just made."""

    key: str = Field(description="The key itself. It can't be read again.")

    @classmethod
    def of_new(cls, made: NewKey) -> Self:
        """Show a new key, this once."""
        return cls(**KeyOut.of(made.row).model_dump(), key=made.secret)


class ReadingOut(BaseModel):
    """Somebody's look at what a session holds of its subject."""

    at: Time
    key: str | None = Field(description="The id of the key; null: without one, on the service's own machine.")
    session: str | None = Field(description="Null: the list of sessions.")
    what: str

    @classmethod
    def of(cls, row: ReadingRow) -> Self:
        """Show a reading."""
        return cls(at=row.created_at, key=row.key_id, session=row.session_id, what=row.what)


class ErasureOut(BaseModel):
    """The deletion of a session."""

    session: str
    asked_at: Time
    done_at: Time | None = Field(description="Since when nothing is left of it: no row, no file, no result, no step.")

    @classmethod
    def of(cls, row: ErasureRow) -> Self:
        """Show a deletion."""
        return cls(session=row.session_id, asked_at=row.created_at, done_at=row.done_at)
