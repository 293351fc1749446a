"""What every document that gonio reads or writes as JSON or TOML has in common."""

from pydantic import BaseModel, ConfigDict


class Strict(BaseModel):
    """Documents say nothing that we would not understand."""

    model_config = ConfigDict(extra="forbid", allow_inf_nan=False)
