import pytest

from gonio.errors import InputError
from gonio.pipeline.params import Parameters, parameters_document, parse_parameters


def test_nothing_gives_all_defaults() -> None:
    assert parse_parameters({}) == Parameters()
    assert parse_parameters(parameters_document(Parameters())) == Parameters()


@pytest.mark.parametrize(
    ("given", "field"),
    [
        ({"subject": {"mass_kg": -1}}, "subject.mass_kg"),
        ({"subject": {"mass_kg": float("nan")}}, "subject.mass_kg"),
        ({"subject": {"sex": "x"}}, "subject.sex"),
        ({"reconstruction": {"method": "magic"}}, "reconstruction.method"),
        ({"reconstrution": {}}, "reconstrution"),
        ({"keypoints": {"model": "../../etc/passwd"}}, "keypoints.model"),
    ],
)
def test_a_wrong_parameter_is_named(given: dict[str, object], field: str) -> None:
    with pytest.raises(InputError) as caught:
        parse_parameters(given)
    assert caught.value.code == "parameter-invalid"
    assert field in caught.value.message
