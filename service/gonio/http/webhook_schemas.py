"""What goes in and out over HTTP of webhooks."""

from typing import Any, Self

from pydantic import BaseModel, ConfigDict, Field

from gonio.http.schemas import Time
from gonio.jobs.tables import DeliveryRow, WebhookRow


class WebhookIn(BaseModel):
    """A webhook to make."""

    model_config = ConfigDict(extra="forbid", json_schema_extra={"example": {"url": "https://lab.example.org/gonio"}})

    url: str = Field(min_length=1, max_length=2000, pattern=r"^[!-~]*$", description="A public https:// address.")


class WebhookOut(BaseModel):
    """A webhook, without its secret."""

    id: str
    url: str
    created_at: Time

    @classmethod
    def of(cls, row: WebhookRow) -> Self:
        """Show a webhook."""
        return cls(id=row.id, url=row.url, created_at=row.created_at)


class WebhookMade(WebhookOut):
    """A webhook that was just made."""

    secret: str = Field(description="Signs its messages. It can't be read again.")

    @classmethod
    def of_new(cls, row: WebhookRow) -> Self:
        """Show a new webhook, this once."""
        return cls(**WebhookOut.of(row).model_dump(), secret=row.secret)


class DeliveryOut(BaseModel):
    """A message to a webhook."""

    id: str
    content: dict[str, Any]
    attempts: int
    answer: str = Field(description="The status of the last answer, or why there was none.")
    created_at: Time
    delivered_at: Time | None
    due_at: Time | None = Field(description="When it is sent next; null: never again.")

    @classmethod
    def of(cls, row: DeliveryRow) -> Self:
        """Show a message."""
        return cls(
            id=row.id,
            content=row.content,
            attempts=row.attempts,
            answer=row.answer,
            created_at=row.created_at,
            delivered_at=row.delivered_at,
            due_at=row.due_at,
        )
