"""Several reference epochs on the common route: images of the same names are told apart, and all are used."""

from __future__ import annotations

import pytest

from georef.stages.evaluate import evaluate
from georef.stages.localize import read_outcomes
from georef.stages.survey import load_survey
from georef.types.results import Localized
from tests.stages.bench import Bench
from tests.worlds.tiny import EPOCH, write_tiny_world


@pytest.fixture(scope="module")
def bench(tmp_path_factory: pytest.TempPathFactory) -> Bench:
    """The small world's eight reference images as two epochs of four, which stand in turn and have the same names."""
    folder = tmp_path_factory.mktemp("references")
    data = write_tiny_world(folder / "data").data
    lines = (data / "reference_eo.csv").read_text(encoding="utf-8").splitlines()
    for number, epoch in enumerate(("old", "new")):
        (data / epoch).mkdir()
        rows = lines[2 + number :: 2]
        for i, row in enumerate(rows):
            name, rest = row.split(",", 1)
            (data / "reference" / name).rename(data / epoch / f"r{i}.jpg")
            rows[i] = f"r{i}.jpg,{rest}"
        (data / f"{epoch}_eo.csv").write_text("\n".join([*lines[:2], *rows]) + "\n", encoding="utf-8")
    text = (data / "project.toml").read_text(encoding="utf-8")
    start, end = text.index("[reference]"), text.index("[epochs")
    section = text[start:end]
    sections = [
        section.replace("reference", f"references.{n}", 1).replace('"reference', f'"{n}') for n in ("old", "new")
    ]
    (data / "project.toml").write_text(text[:start] + "".join(sections) + text[end:], encoding="utf-8")
    return Bench(data, folder / "output")


def test_images_are_localized_against_both(bench: Bench) -> None:
    results = bench.run()
    assert results["features"].summary.total == 8 + 3
    project = bench.open()
    errors = evaluate(project.published(EPOCH) / "poses.csv", bench.data / f"truth_{EPOCH}_eo.csv").errors
    assert errors.failed == ()
    assert 0.0002 < errors.position_m.median < 0.01
    survey = load_survey(project, EPOCH)
    outcomes = read_outcomes(bench.states()["localize"].folder, survey.epoch)
    used = {m.reference_id for o in outcomes if isinstance(o, Localized) for m in o.matches}
    assert {name.split("/")[0] for name in used} == {"old", "new"}
    assert used <= {image.image_id for image in survey.reference.images}
    again = bench.run()
    assert all(result.reused for result in again.values())
