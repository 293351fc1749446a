"""Webhooks: addresses that hear when a job has ended. Only a key with the scope `admin` gets in here."""

from fastapi import APIRouter, Response

from gonio.http.dependencies import Administrator, Id, TheService
from gonio.http.problems import GUARD, fails
from gonio.http.schemas import ListOf
from gonio.http.webhook_schemas import DeliveryOut, WebhookIn, WebhookMade, WebhookOut

router = APIRouter(prefix="/v1/webhooks", tags=["webhooks"], responses=fails(*GUARD))

NEWEST = 50


@router.post("", status_code=201, responses=fails("malformed-body", "body-too-large", "webhook-address-wrong"))
def create_webhook(body: WebhookIn, response: Response, service: TheService, caller: Administrator) -> WebhookMade:
    """Have an address told when jobs of the lab end, by a POST of `{"event": "job-ended", "job", "session", "state"}`.

    The answer holds the secret with which messages are signed; it can't be read again. The header `Gonio-Signature` is
    `t=TIME,v1=HEX`: the HMAC with SHA-256, under the secret, of the time, a point and the body. A message that isn't answered
    with 2xx is sent again, twelve times in nearly six hours; `Gonio-Delivery` is its id, the same each time.
    """
    row = service.webhooks.create(caller.lab, body.url)
    response.headers["Location"] = f"/v1/webhooks/{row.id}"
    return WebhookMade.of_new(row)


@router.get("", responses=fails())
def list_webhooks(service: TheService, caller: Administrator) -> ListOf[WebhookOut]:
    """List the lab's webhooks, newest first, all on one page."""
    return ListOf(items=[WebhookOut.of(row) for row in service.webhooks.list(caller.lab)])


@router.get("/{webhook_id}/deliveries", responses=fails("not-found"))
def list_deliveries(webhook_id: Id, service: TheService, caller: Administrator) -> ListOf[DeliveryOut]:
    """List the newest messages to a webhook, and how they were answered."""
    return ListOf(items=[DeliveryOut.of(row) for row in service.webhooks.deliveries(caller.lab, webhook_id, NEWEST)])


@router.delete("/{webhook_id}", status_code=204, responses=fails("not-found"))
def delete_webhook(webhook_id: Id, service: TheService, caller: Administrator) -> None:
    """Delete a webhook, and what it was still to be told."""
    service.webhooks.delete(caller.lab, webhook_id)
