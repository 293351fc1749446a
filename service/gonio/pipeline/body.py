"""Stage ``scaling``: the body model made the subject's."""

from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
from jaxtyping import Float

from gonio.errors import InputError
from gonio.formats.markerset import read_markerset
from gonio.formats.osim import read_osim
from gonio.kernel.body.markerset import attach, make_tasks
from gonio.kernel.body.scaling import measure_scale_factors, scale_model
from gonio.pipeline.findings import finding
from gonio.pipeline.params import Subject
from gonio.pipeline.run import CaptureFile, Outcome, Role
from gonio.records import (
    BodyModel,
    Finding,
    LabPoints,
    MarkerSet,
    Tasks,
    record,
)
from gonio.resources import models_dir


@record
class SubjectBody:
    """The body model in the subject's size, with the keypoints as its markers, and how inverse kinematics weighs them."""

    model: BodyModel
    markerset: MarkerSet
    tasks: Tasks
    file: Path
    scales: Float[np.ndarray, "body 3"]


def scale_to_subject(points: LabPoints, subject: Subject, files: Sequence[CaptureFile] = ()) -> Outcome[SubjectBody]:
    """Fit a body model's segments to the subject's keypoints, and its mass to the subject's.

    The model is the one among the session's files, else the built-in one of the subject's sex (of men where it is not known).

    Raises:
        InputError: the session has two body models or marker sets, or no marker set fits.
    """
    findings: list[Finding] = []
    own = only_file(files, "body_model")
    file = own or models_dir() / "bodies" / f"fullbody_{subject.sex or 'male'}.osim"
    unmarked = read_osim(file)
    markerset = choose_markerset(unmarked, points.keypoint_names, only_file(files, "marker_set"))
    generic = attach(unmarked, markerset)
    observed = in_marker_order(generic, points)
    markerset, unseen = keep_seen_measurements(generic, markerset, observed)
    scales = measure_scale_factors(generic, markerset.measurements, observed)
    model = scale_model(generic, scales, mass_kg=subject.mass_kg)
    findings += [finding("segment-not-scaled", where=name) for name in unseen]
    if subject.mass_kg is None:
        findings.append(finding("mass-unknown", value=model.mass_kg))
    if subject.sex is None and own is None:
        findings.append(finding("sex-unknown"))
    body = SubjectBody(model=model, markerset=markerset, tasks=make_tasks(model, markerset), file=file, scales=scales)
    return Outcome(body, tuple(findings))


def only_file(files: Sequence[CaptureFile], role: Role) -> Path | None:
    """Give the session's file of a role, None if there is none.

    Raises:
        InputError: there are several.
    """
    found = [file for file in files if file.role == role]
    if len(found) > 1:
        raise InputError(
            f"The session has {len(found)} files of the kind {role}: {', '.join(f.name for f in found)}.",
            hint="Delete all but the one that is to be used.",
            code="file-ambiguous",
        )
    return found[0].path if found else None


def choose_markerset(model: BodyModel, keypoint_names: tuple[str, ...], given: Path | None = None) -> MarkerSet:
    """Choose the card that fixes these keypoints to a model: the one given, else the one of gonio's own that fits best.

    A card fits if its keypoints are among those found and their places exist in the model; the best places the most.

    Raises:
        InputError: ``markerset-missing``, or what attaching the given card says.
    """
    if given is not None:
        card = read_markerset(given)
        attach(model, card)
        return card
    fitting = [
        card
        for card in _own_cards(models_dir())
        if set(card.keypoint_names) <= set(keypoint_names) and _fits(model, card)
    ]
    if fitting:
        return max(fitting, key=lambda card: len(card.keypoint_names))
    raise InputError(
        f"No marker set places the keypoints on the model {model.name}.",
        hint="Upload one with the role marker_set; those in models/markersets are examples.",
        code="markerset-missing",
    )


@cache
def _own_cards(models: Path) -> tuple[MarkerSet, ...]:
    """Read gonio's own cards, once for all analyses of a process: they don't change while it runs."""
    return tuple(read_markerset(path) for path in sorted((models / "markersets").rglob("*.toml")))


def _fits(model: BodyModel, card: MarkerSet) -> bool:
    try:
        attach(model, card)
    except InputError:
        return False
    return True


def in_marker_order(model: BodyModel, points: LabPoints) -> Float[np.ndarray, "frame marker 3"]:
    """Give the points in the order of the model's markers."""
    return points.xyz_lab_m[:, [points.index(name) for name in model.markers.names]]


def keep_seen_measurements(
    model: BodyModel, markerset: MarkerSet, observed: Float[np.ndarray, "frame marker 3"]
) -> tuple[MarkerSet, tuple[str, ...]]:
    """Leave out the pairs of markers that were never seen together; also give the measurements that lost all of theirs."""
    seen = np.isfinite(observed[..., 0])

    def seen_together(pair: tuple[str, str]) -> bool:
        first, second = (model.markers.index(name) for name in pair)
        return bool((seen[:, first] & seen[:, second]).any())

    trimmed = [(m, tuple(pair for pair in m.pairs if seen_together(pair))) for m in markerset.measurements]
    kept = tuple(replace(measurement, pairs=pairs) for measurement, pairs in trimmed if pairs)
    lost = {measurement.name for measurement, pairs in trimmed if not pairs} - {m.name for m in kept}
    return replace(markerset, measurements=kept), tuple(sorted(lost))
