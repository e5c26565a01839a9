"""The configuration: default.toml says what the models say, and mistakes are explained."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from georef.config import Config, load_config, parse_overrides, presets_folder, read_toml
from georef.errors import ConfigError
from georef.features.registry import EXTRACTORS, MATCHERS

PRESETS = sorted(path.stem for path in presets_folder().glob("*.toml"))


def flat(tables: dict[str, Any]) -> dict[str, Any]:
    return {f"{section}.{key}": value for section, keys in tables.items() for key, value in keys.items()}


def test_default_toml_has_every_key_with_its_default_and_no_other() -> None:
    written = flat(read_toml(presets_folder() / "default.toml"))
    assert written == flat(Config().model_dump())
    assert {key: type(value) for key, value in written.items()} == {
        key: type(value) for key, value in flat(Config().model_dump()).items()
    }


def test_default_toml_explains_every_key_behind_it() -> None:
    lines = (presets_folder() / "default.toml").read_text(encoding="utf-8").splitlines()
    keys = [line for line in lines if "=" in line and not line.lstrip().startswith("#")]
    assert len(keys) == len(flat(Config().model_dump()))
    unexplained = [line for line in keys if len(line.partition("#")[2].strip()) < 8]
    assert unexplained == []


def test_units_of_keys_are_said() -> None:
    """A key that ends in a unit says it in its explanation."""
    for line in (presets_folder() / "default.toml").read_text(encoding="utf-8").splitlines():
        key = line.split("=")[0].strip()
        for unit in ("px", "m", "deg"):
            if key.endswith(f"_{unit}"):
                assert line.partition("#")[2].strip().startswith(f"{unit};"), line


@pytest.mark.parametrize("preset", PRESETS)
def test_a_preset_loads_and_names_components_that_exist(preset: str) -> None:
    config = load_config(preset)
    assert config.features.extractor in EXTRACTORS.names()
    assert config.matching.matcher in MATCHERS.names()


def test_presets_change_something_and_repeat_nothing() -> None:
    default = flat(Config().model_dump())
    for preset in PRESETS:
        if preset != "default":
            written = flat(read_toml(presets_folder() / f"{preset}.toml"))
            assert written
            assert [key for key in written if key not in default] == []


def test_sift_needs_no_weights(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    from georef.features.registry import load_component

    monkeypatch.setenv("GEOREF_CACHE", str(tmp_path))
    config = load_config("sift")
    load_component(EXTRACTORS, config.features.extractor)
    load_component(MATCHERS, config.matching.matcher, **config.matching.options)


@pytest.mark.parametrize("both", [["auto-gcps", "pose-priors"], ["auto-gcps"], "auto-gcps,pose-priors"])
def test_two_kinds_of_constraints_are_refused_with_the_reason(both: object) -> None:
    with pytest.raises(ConfigError, match=r"adjust\.constraints.*choose one of.*same matches.*count them twice"):
        load_config("default", [{"adjust": {"constraints": both}}])


@pytest.mark.parametrize("kind", ["auto-gcps", "pose-priors", "none"])
def test_one_kind_of_constraints_is_taken(kind: str) -> None:
    assert load_config("default", [{"adjust": {"constraints": kind}}]).adjust.constraints == kind


def test_layers_go_on_top_of_each_other(tmp_path: Path) -> None:
    own = tmp_path / "own.toml"
    own.write_text("[network]\nneighbours = 4\nmax_images = 20\n", encoding="utf-8")
    config = load_config(str(own), [{"network": {"max_images": 30}}, parse_overrides(["network.max_images=31"])])
    assert (config.network.neighbours, config.network.max_images) == (4, 31)
    assert config.network.max_keypoints == Config().network.max_keypoints


def test_an_unknown_key_of_a_preset_names_its_file(tmp_path: Path) -> None:
    own = tmp_path / "own.toml"
    own.write_text("[network]\nneighbors = 4\n", encoding="utf-8")
    with pytest.raises(ConfigError) as caught:
        load_config(str(own))
    assert "Unknown key 'network.neighbors'. Did you mean 'neighbours'?" in str(caught.value)
    assert str(own) in str(caught.value)


@pytest.mark.parametrize(
    ("layer", "texts"),
    [
        ({"netwrk": {}}, ["Unknown key 'netwrk'. Did you mean 'network'?", "adjust, candidates"]),
        ({"adjust": {"gns": True}}, ["Unknown key 'adjust.gns'. Did you mean 'gnss'?"]),
        ({"adjust": {"gate_probability": 1.5}}, ["'adjust.gate_probability' has the value 1.5", "less than 1"]),
        (
            {"candidates": {"box": "round"}},
            ["'candidates.box' has the value 'round'", "'reach', 'published', 'fixed' or 'none'"],
        ),
        ({"features": {"max_keypoints": 3}}, ["'features.max_keypoints' has the value 3", "16"]),
        ({"features": {"max_keypoints": "many"}}, ["'features.max_keypoints' has the value 'many'", "integer"]),
        ({"localize": {"ransac_gate_px": float("nan")}}, ["'localize.ransac_gate_px' has the value nan", "finite"]),
        ({"run": 4}, ["'run' has the value 4"]),
    ],
)
def test_a_wrong_value_is_named_with_what_is_right(layer: dict[str, Any], texts: list[str]) -> None:
    with pytest.raises(ConfigError) as caught:
        load_config("default", [layer])
    for text in texts:
        assert text in str(caught.value)


def test_an_unknown_preset_names_the_nearest() -> None:
    with pytest.raises(ConfigError, match=r"no preset 'sfit'\. Did you mean 'sift'\?(?s:.*)published, sift"):
        load_config("sfit")
    with pytest.raises(ConfigError, match="There is no file"):
        load_config("absent.toml")


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("adjust.gnss=false", {"adjust": {"gnss": False}}),
        ("adjust.cauchy_scale = 3", {"adjust": {"cauchy_scale": 3}}),
        ("features.extractor=sift", {"features": {"extractor": "sift"}}),
        ('features.extractor="sift"', {"features": {"extractor": "sift"}}),
        ("matching.options.ratio=0.8", {"matching": {"options": {"ratio": 0.8}}}),
        ("crs.origin=[1, 2, 3]", {"crs": {"origin": [1, 2, 3]}}),
        ("reference.images=a=b", {"reference": {"images": "a=b"}}),
    ],
)
def test_overrides_read_as_toml_else_as_text(text: str, value: dict[str, Any]) -> None:
    assert parse_overrides([text]) == value


@pytest.mark.parametrize("text", ["adjust.gnss", "gnss=false", "=1", ".gnss=1", "adjust.=1"])
def test_an_override_that_cannot_be_read_is_shown(text: str) -> None:
    with pytest.raises(ConfigError, match=r"cannot be read(?s:.*)adjust\.gnss=false"):
        parse_overrides([text])


def test_toml_that_is_not_valid_says_where(tmp_path: Path) -> None:
    path = tmp_path / "broken.toml"
    path.write_text("[adjust]\ngnss = maybe\n", encoding="utf-8")
    with pytest.raises(ConfigError, match=r"line 2(?s:.*)broken\.toml"):
        read_toml(path)
