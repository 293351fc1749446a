"""Webhooks: a lab's own programs hear when a job has ended. Signed, tried again, and never lost.

What is to be told is written in the transaction that ends the job (:meth:`Repository.change_job`), so a crash loses no
message. Who gets a message twice, because the answer was lost, recognises it by its id.
"""

import asyncio
import hashlib
import hmac
import json
import logging
import secrets
import socket
import time
from collections.abc import Sequence
from datetime import timedelta
from ipaddress import IPv6Address, ip_address, ip_network
from urllib.parse import urlsplit
from uuid import uuid4

import httpx

from gonio.errors import InputError
from gonio.jobs.database import Database
from gonio.jobs.repository import Repository, claim_deliveries_of_all_labs
from gonio.jobs.tables import DeliveryRow, WebhookRow, now

log = logging.getLogger(__name__)

TRIES = 12
FIRST_PAUSE = timedelta(seconds=5)
LONGEST_PAUSE = timedelta(hours=6)
"""Twelve tries with pauses that double take nearly six hours."""
CLAIM = timedelta(minutes=2)
"""For so long a message belongs to the process that sends it."""
TIMEOUT_S = 10.0
"""From finding the address to the status: one that answers a byte every nine seconds holds nobody up."""
BATCH = 20


class Webhooks:
    """A lab's webhooks, and the sending of what is due.

    Args:
        database: The database.
        allow_private: Whether addresses within the service's own network, and plain HTTP, are allowed: they would let
            a lab send requests to machines that only the service reaches.
    """

    def __init__(self, database: Database, *, allow_private: bool) -> None:
        self._database = database
        self._allow_private = allow_private

    def create(self, lab: str, url: str) -> WebhookRow:
        """Make a webhook; its secret is for checking signatures.

        Raises:
            InputError: ``webhook-address-wrong``.
        """
        self._check(url)
        row = WebhookRow(id=str(uuid4()), url=url, secret=secrets.token_urlsafe(32))
        with self._database.write(lab) as session:
            Repository(session, lab).add(row)
        return row

    def list(self, lab: str) -> Sequence[WebhookRow]:
        """List a lab's webhooks, newest first."""
        with self._database.read() as session:
            return Repository(session, lab).webhooks()

    def deliveries(self, lab: str, webhook_id: str, limit: int) -> Sequence[DeliveryRow]:
        """List the newest messages of a webhook."""
        with self._database.read() as session:
            repository = Repository(session, lab)
            repository.webhook(webhook_id)
            return repository.deliveries(webhook_id, limit)

    def delete(self, lab: str, webhook_id: str) -> None:
        """Delete a webhook and what it was still to be told."""
        with self._database.write(lab) as session:
            repository = Repository(session, lab)
            repository.delete(repository.webhook(webhook_id))

    def send_due(self) -> int:
        """Send the messages that are due, of all labs, and tell how many were."""
        with self._database.write() as session:
            due = claim_deliveries_of_all_labs(session, now(), now() + CLAIM, BATCH)
        for (delivery, _), answer in zip(due, asyncio.run(self._send_all(due)), strict=True):
            with self._database.write(delivery.lab) as session:
                row = session.get(DeliveryRow, delivery.id)
                if row is None:  # its webhook was deleted meanwhile
                    continue
                row.attempts += 1
                row.answer = answer
                good = answer.isdigit() and 200 <= int(answer) < 300
                row.delivered_at = now() if good else None
                pause = min(FIRST_PAUSE * 2 ** (row.attempts - 1), LONGEST_PAUSE)
                row.due_at = None if good or row.attempts >= TRIES else now() + pause
        return len(due)

    async def _send_all(self, due: Sequence[tuple[DeliveryRow, WebhookRow]]) -> Sequence[str]:
        """Send messages at the same time, so that no lab waits for the slow programs of another."""
        return await asyncio.gather(*(self._send(delivery, webhook) for delivery, webhook in due))

    async def _send(self, delivery: DeliveryRow, webhook: WebhookRow) -> str:
        """Send a message, and give the status of the answer, or why there is none."""
        body = json.dumps(delivery.content).encode()
        headers = {
            "Content-Type": "application/json",
            "Gonio-Delivery": delivery.id,
            "Gonio-Signature": sign(webhook.secret, body, int(time.time())),
        }
        try:
            url = httpx.URL(webhook.url)
            async with asyncio.timeout(TIMEOUT_S), httpx.AsyncClient(timeout=TIMEOUT_S, trust_env=False) as client:
                checked = await asyncio.to_thread(self._check, webhook.url)
                # To the machine that was checked: asked again, the name could point to another one. The certificate must be
                # the name's all the same. No redirects, and nothing is read of the answer but its status.
                place = url if checked is None else url.copy_with(host=checked)
                named = {**headers, "Host": url.netloc.decode("ascii")}
                sni = {"sni_hostname": url.raw_host.decode("ascii")}
                async with client.stream("POST", place, content=body, headers=named, extensions=sni) as answer:
                    return str(answer.status_code)
        except InputError as error:
            return error.code
        except (httpx.HTTPError, httpx.InvalidURL, TimeoutError) as error:
            return type(error).__name__

    def _check(self, url: str) -> str | None:
        """Refuse a place in the service's own network, and give the address of the machine; None: any may be asked."""
        parts = urlsplit(url)
        allowed = ("https", "http") if self._allow_private else ("https",)
        if parts.scheme not in allowed or not parts.hostname or parts.username is not None:
            raise _wrong(f"The address of a webhook begins with {' or '.join(f'{each}://' for each in allowed)}.")
        if self._allow_private:
            return None
        try:
            found = socket.getaddrinfo(parts.hostname, parts.port or 443, proto=socket.IPPROTO_TCP)
        except (OSError, UnicodeError):
            raise _wrong(f"There is no machine called {parts.hostname[:100]!r}.") from None
        addresses = [str(address[4][0]) for address in found]
        if not all(map(_is_public, addresses)):
            raise _wrong("The address leads into a private network.")
        return addresses[0]


def _is_public(text: str) -> bool:
    """Tell whether an address is one machine of the internet, and none of this network's in the clothes of such a one."""
    address = ip_address(text)
    if isinstance(address, IPv6Address) and (
        address not in _UNICAST or address.sixtofour is not None or address.teredo is not None
    ):
        return False
    return address.is_global and not address.is_multicast


_UNICAST = ip_network("2000::/3")
"""Outside of it are the addresses that stand for one of IPv4: mapped, compatible, or translated by a gateway (NAT64)."""


def sign(secret: str, body: bytes, time_s: int) -> str:
    """Give the signature of a message: its time, and an HMAC with SHA-256 of the time, a point and the body."""
    digest = hmac.new(secret.encode(), f"{time_s}.".encode() + body, hashlib.sha256).hexdigest()
    return f"t={time_s},v1={digest}"


def _wrong(reason: str) -> InputError:
    return InputError(
        reason,
        hint="Give the public https:// address of a program of yours; for one in the service's own network, its operator "
        "sets GONIO_PRIVATE_WEBHOOKS.",
        code="webhook-address-wrong",
    )
