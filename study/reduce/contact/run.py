"""``softgrasp reduce`` on a scene with effects.obstacles: runs, tables, page."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

from softgrasp.fem import Scene, SceneError, Stopwatch
from softgrasp.reduction.archive import save
from softgrasp.reduction.contact.make import check_contact_scene
from softgrasp.study.reduce.contact.measure import measure_contact
from softgrasp.study.reduce.contact.page import NO_CERTIFICATE, compose, speed_up
from softgrasp.study.reduce.result import reduce_result
from softgrasp.study.reduce.times import measured_run
from softgrasp.study.report import Page
from softgrasp.study.shell import Session


def check_contact(scene: Scene) -> None:
    """Refuse, before any run, what contact models do not have. Raises SceneError."""
    if scene.reduction.certify != "off" or scene.reduction.train == "greedy":
        raise SceneError(
            f"scene '{scene.name}': no certificate covers contact; leave out --tolerance and reduction.certify for "
            "reduced models with contact, or use --set effects.obstacles=false --set obstacle=false for a certified "
            "model without it"
        )
    if scene.reduction.methods:
        raise SceneError(
            "reduction.methods does not go with effects.obstacles: a contact model has the responses of "
            "nodes that may touch; leave it out"
        )


def run_contact(session: Session, scene: Scene) -> dict[str, Any]:
    """Reduce the scene and write the results. Collective. Raises SoftgraspError: with one sentence."""
    model, watch = session.model(scene), Stopwatch(session.comm)
    check_contact_scene(model)
    with session.counting("full run") as say:
        with watch.stage("full"):
            full, times = measured_run(model, say)
        with watch.stage("reduced"):
            study = measure_contact(full, times, say)
    files = {session.out / "models" / f"{key}.h5": rom for key, rom in study.models.items()}
    for path, rom in files.items():
        save(rom, path)
    points = [asdict(p) | {"model": key, "speed_up": speed_up(study, p)} for key, p in study.points.items()]
    own = {
        "contact": points,
        "held_out": [asdict(motion) for motion in study.motions],
        "refused": study.refused,
        "best": study.best,
        "certificate": NO_CERTIFICATE,
    }
    result = reduce_result(full, own, times.to_json() | watch.seconds)

    def page() -> Page:
        drawn = []
        if session.pictures:
            from softgrasp.study.reduce.contact.plots import draw  # brings Matplotlib

            drawn = draw(session.out, study)
        return compose(study, drawn, [*files])

    session.write(scene, result, page)
    return result
