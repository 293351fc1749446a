"""What can be set from outside, by environment variables ``GONIO_*``. Read by the command line, jobs and http only."""

import hashlib
from ipaddress import ip_address
from pathlib import Path
from typing import Annotated, Literal

import platformdirs
from pydantic import Field, model_validator
from pydantic_settings import BaseSettings, SettingsConfigDict

MEGABYTE = 10**6
GIGABYTE = 10**9


class Settings(BaseSettings):
    """The settings of one service: the defaults are those of a laptop with nothing beside it."""

    model_config = SettingsConfigDict(env_prefix="GONIO_", frozen=True)

    data_dir: Path = Field(
        default_factory=lambda: platformdirs.user_data_path("gonio"),
        description="The folder that holds the database and the files; what is in here must be backed up.",
    )
    cache_dir: Path = Field(
        default_factory=lambda: platformdirs.user_cache_path("gonio"),
        description="The folder for what can be made again: model weights and work in progress.",
    )
    database_url: str = Field(
        default="", description="postgresql://USER:PASSWORD@HOST/NAME; without it, a SQLite file in data_dir."
    )
    objects_url: str = Field(
        default="", description="Where files and results are kept, as a URL; without one, a folder in data_dir."
    )
    host: str = Field(default="127.0.0.1", description="The address on which the service listens.")
    port: Annotated[int, Field(ge=0, le=65535)] = Field(default=8000, description="The port; 0 takes a free one.")
    workers: Annotated[int, Field(ge=0)] = Field(default=1, description="How many worker processes `gonio serve` runs.")
    stage_silence_s: float = Field(
        default=1800.0, description="A worker of whose stage nothing was heard for so long ends; another one goes on."
    )
    max_json_bytes: int = Field(default=MEGABYTE, description="The largest body of a request that carries no file.")
    max_upload_bytes: int = Field(default=20 * GIGABYTE, description="The largest file that is accepted.")
    free_disk_floor: int = Field(
        default=2 * GIGABYTE, description="Uploads are refused when they would leave fewer free bytes on the disk."
    )
    upload_hours: float = Field(
        default=24.0, gt=0, description="An upload that was cut is removed when nothing was added to it for so long."
    )
    requests_per_minute: int = Field(
        default=6000,
        ge=0,
        description="How many requests each key may send a minute to each API process; 0: any number.",
    )
    jobs_per_lab: int = Field(default=200, ge=1, description="How many jobs of a lab may wait or run at once.")
    lab_quota_bytes: int = Field(
        default=0, ge=0, description="How much each lab may upload, sessions that it deleted not counted; 0: no limit."
    )
    retention_days: float = Field(
        default=0, ge=0, description="Sessions are deleted so long after they were last worked on; 0: never."
    )
    log_format: Literal["text", "json"] = Field(default="text", description="How the log is written.")
    private_webhooks: bool = Field(
        default=False, description="Whether webhooks may lead into the service's own network, and over plain HTTP."
    )
    metrics_key: str = Field(default="", description="The key with which Prometheus reads /metrics.")
    keys: Literal["auto", "required"] = Field(
        default="auto",
        description="`auto`: no key is needed on this machine itself while the service listens there only, keeps its data "
        "in data_dir, and no key was made. `required`: always.",
    )
    default_lab: str = Field(default="default", description="The lab that owns everything while no key names another.")

    @model_validator(mode="before")
    @classmethod
    def _drop_empty(cls, values: dict[str, object]) -> dict[str, object]:
        """Take an empty variable for one that isn't set: `GONIO_PORT= gonio serve` is no error."""
        return {name: value for name, value in values.items() if value != ""}

    @property
    def is_embedded(self) -> bool:
        """Whether this is a service for its own machine alone: it listens nowhere else, and nothing stands beside it."""
        return is_loopback(self.host) and not self.database_url and not self.objects_url

    @property
    def resolved_database_url(self) -> str:
        """The database's URL with its default filled in."""
        return self.database_url or f"sqlite:///{self.data_dir.absolute() / 'gonio.db'}"

    @property
    def work_dir(self) -> Path:
        """The folder for work in progress. Each database has one: its workers remove what a dead one left, whose they know."""
        name = hashlib.sha256(self.resolved_database_url.encode()).hexdigest()[:12]
        return self.cache_dir / "work" / name

    @property
    def resolved_objects_url(self) -> str:
        """The object store's URL with its default filled in."""
        return self.objects_url or (self.data_dir.absolute() / "objects").as_uri()

    def environment(self) -> dict[str, str]:
        """Give the environment variables from which another process makes the same settings."""
        prefix = self.model_config.get("env_prefix", "")
        return {f"{prefix}{name.upper()}": str(value) for name, value in self}


def is_loopback(host: str) -> bool:
    """Tell whether a name or an address is this machine itself."""
    if host == "localhost":
        return True
    try:
        return ip_address(host).is_loopback
    except ValueError:
        return False
