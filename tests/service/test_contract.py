"""Requests made from the API's own description, right and wrong ones: no answer is one that it doesn't document."""

import pytest
import schemathesis
from hypothesis import HealthCheck, Phase, settings
from schemathesis.checks import not_a_server_error
from schemathesis.specs.openapi.checks import (
    content_type_conformance,
    response_headers_conformance,
    response_schema_conformance,
    status_code_conformance,
)

from gonio.http.app import create_app
from gonio.settings import Settings

API = schemathesis.openapi.from_dict(create_app(Settings()).openapi())
CHECKS = [
    not_a_server_error,
    status_code_conformance,
    content_type_conformance,
    response_headers_conformance,
    response_schema_conformance,
]


@schemathesis.serializer("application/offset+octet-stream")
def as_it_is(_context: object, value: object) -> bytes:
    return value if isinstance(value, bytes) else str(value).encode()


@pytest.mark.slow
@pytest.mark.parametrize("with_key", [True, False], ids=["key", "no key"])
@API.parametrize()
@settings(
    max_examples=4,
    derandomize=True,
    deadline=None,
    database=None,
    phases=[Phase.explicit, Phase.generate],
    suppress_health_check=list(HealthCheck),
)
def test_every_answer_is_documented(case, keyed_lab, with_key):
    headers = dict(keyed_lab.http.headers) if with_key else {}
    authorization = {"Authorization": headers["authorization"]} if "authorization" in headers else {}
    case.call_and_validate(base_url=keyed_lab.url, headers=authorization, checks=CHECKS, timeout=30)
