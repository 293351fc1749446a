"""Numbers for Prometheus: what the database knows of all labs and workers, and the requests of this process."""

import hmac

from fastapi import APIRouter, Request, Response
from prometheus_client import CollectorRegistry, Counter, Histogram, generate_latest
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, SummaryMetricFamily
from prometheus_client.registry import Collector

from gonio.errors import InputError
from gonio.http.dependencies import TheService, TheSettings, is_at_home
from gonio.http.problems import fails
from gonio.jobs.service import Service

TEXT = "text/plain; version=0.0.4; charset=utf-8"

router = APIRouter(tags=["service"])

REQUESTS = CollectorRegistry()
_COUNT = Counter("gonio_http_requests", "Requests answered.", ["method", "route", "status"], registry=REQUESTS)
_SECONDS = Histogram("gonio_http_seconds", "How long answers took.", ["route"], registry=REQUESTS)


def count_request(method: str, route: str, status: int, seconds: float) -> None:
    """Count a request under its route's pattern: an address as it was sent could hold anything."""
    _COUNT.labels(method, route, status).inc()
    _SECONDS.labels(route).observe(seconds)


class _Jobs(Collector):
    """What the database knows, asked when it is scraped: the same from every API process."""

    def __init__(self, service: Service) -> None:
        self._service = service
        self.registry = CollectorRegistry()
        self.registry.register(self)

    def collect(self) -> list[CounterMetricFamily | GaugeMetricFamily | SummaryMetricFamily]:
        counted = self._service.statistics()
        jobs = GaugeMetricFamily("gonio_jobs", "Jobs by state; `todo` is the depth of the queue.", labels=["state"])
        for state, count in counted.jobs.items():
            jobs.add_metric([state], count)
        oldest = GaugeMetricFamily("gonio_queue_oldest_seconds", "How long the oldest queued job waits.")
        oldest.add_metric([], counted.oldest_s)
        stages = SummaryMetricFamily("gonio_stage_seconds", "Wall time of finished stages.", labels=["stage"])
        for stage, (count, seconds) in counted.stages.items():
            stages.add_metric([stage], count, seconds)
        takeovers = CounterMetricFamily("gonio_takeovers", "Jobs that were taken over from a dead worker.")
        takeovers.add_metric([], counted.takeovers)
        frames = CounterMetricFamily("gonio_frames", "Frames of video of the jobs that succeeded.")
        frames.add_metric([], counted.frames)
        return [jobs, oldest, stages, takeovers, frames]


@router.get(
    "/metrics",
    response_class=Response,
    responses={200: {"content": {"text/plain": {"schema": {"type": "string"}}}}, **fails("key-missing", "key-invalid")},
)
def read_metrics(request: Request, service: TheService, settings: TheSettings) -> Response:
    """Give numbers for Prometheus, with `Authorization: Bearer` and GONIO_METRICS_KEY; without it, to this machine only."""
    sent = request.headers.get("authorization", "").removeprefix("Bearer ")
    if not is_at_home(request, service, settings) and not sent:
        raise InputError("The numbers want a key.", hint="Send the key GONIO_METRICS_KEY.", code="key-missing")
    known = settings.metrics_key.encode()
    if sent and not (known and hmac.compare_digest(sent.encode(), known)):
        raise InputError("This is not the key of the numbers.", hint="It is GONIO_METRICS_KEY.", code="key-invalid")
    return Response(generate_latest(_Jobs(service).registry) + generate_latest(REQUESTS), media_type=TEXT)
