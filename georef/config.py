"""Configuration: frozen, validated models, one section a room; `configs/default.toml` explains every key."""

from __future__ import annotations

import difflib
import tomllib
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, ValidationError, field_validator

from georef.errors import ConfigError

M = TypeVar("M", bound=BaseModel)


class Section(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


def _zero_or(least: int) -> AfterValidator:
    """Checks a number that is 0, for what is said beside it, or at least `least`."""

    def check(value: int) -> int:
        if value != 0 and value < least:
            raise ValueError(f"expected 0, or {least} or more")
        return value

    return AfterValidator(check)


ZeroOr16 = Annotated[int, _zero_or(16)]
ZeroOr64 = Annotated[int, _zero_or(64)]


class FeaturesConfig(Section):
    extractor: str = "aliked-n16"
    longest_side_px: ZeroOr64 = 1024
    max_keypoints: ZeroOr16 = 0
    device: Literal["auto", "cpu", "cuda"] = "auto"
    quantize: bool = True


class MatchingConfig(Section):
    matcher: str = "lightglue-aliked"
    max_keypoints: int = Field(default=2048, ge=16)
    options: dict[str, str | int | float | bool] = {}


class RetrievalConfig(Section):
    descriptor: str = "vlad"
    options: dict[str, str | int | float | bool] = {}


class CandidatesConfig(Section):
    box: Literal["reach", "published", "fixed", "none"] = "reach"
    min_half_side_m: float = Field(default=15.0, gt=0)
    viewing_reach_m: float = Field(default=30.0, gt=0)
    half_side_m: float = Field(default=100.0, gt=0)
    unstated_half_side_m: float = Field(default=500.0, gt=0)
    heading_window_deg: float = Field(default=90.0, gt=0, le=180)
    fallback: bool = True
    epochs: list[str] = []
    ranking: Literal["global-votes", "global", "votes"] = "global-votes"
    shortlist: int = Field(default=50, ge=2)
    count: int = Field(default=10, ge=2)
    first_count: int = Field(default=4, ge=2)
    target_sigma_m: float = Field(default=0.0, ge=0)
    vote_keypoints: int = Field(default=512, ge=16)
    max_searched: int = Field(default=2000, ge=2)


class LocalizeConfig(Section):
    method: Literal["query-centred", "tracks", "published", "global-model"] = "query-centred"
    ransac_gate_px: float = Field(default=12.0, gt=0)
    guided_gate: float = Field(default=3.0, gt=0)
    guided_min_similarity: float = Field(default=0.6, ge=0, le=1)
    guided_ratio: float = Field(default=0.95, gt=0, le=1)
    min_inliers: int = Field(default=20, ge=6)
    min_inlier_ratio: float = Field(default=0.1, ge=0, le=1)
    max_position_sigma_m: float = Field(default=1.0, gt=0)
    max_correspondences: int = Field(default=0, ge=0)
    try_turned: bool = True
    seed: int = 0


class GlobalMapConfig(Section):
    neighbours: int = Field(default=10, ge=1)
    viewing_reach_m: float = Field(default=30.0, gt=0)
    gate: float = Field(default=3.0, gt=0)
    block_images: int = Field(default=100, ge=2)


class TracksConfig(Section):
    neighbours: int = Field(default=10, ge=1)
    viewing_reach_m: float = Field(default=30.0, gt=0)
    block_images: int = Field(default=100, ge=2)


class NetworkConfig(Section):
    neighbours: int = Field(default=6, ge=2)
    max_images: int = Field(default=40, ge=4)
    max_points_per_image: int = Field(default=300, ge=20)
    max_keypoints: int = Field(default=2048, ge=64)
    max_suspect_share: float = Field(default=0.1, ge=0, le=0.5)


class StationsConfig(Section):
    together: Literal["none", "station", "sequence"] = "station"
    length: int = Field(default=3, ge=2)
    max_gap_m: float = Field(default=15.0, gt=0)
    tie_neighbours: int = Field(default=4, ge=0)
    min_tie_point_rays: int = Field(default=3, ge=3)
    max_tie_points_per_image: int = Field(default=100, ge=20)
    gate_probability: float = Field(default=0.999, gt=0.5, lt=1)


DATUM_FINDINGS = (
    *("height offset", "height scale", "heights reversed", "axes swapped", "handedness", "axes turned", "feet"),
    *("wrong zone", "false origin", "antenna offset", "shift", "turn", "scale", "several", "unrelated", "undecided"),
)


class AdjustConfig(Section):
    constraints: Literal["auto-gcps", "pose-priors", "none"] = "auto-gcps"
    tie_points: bool = True
    gnss: bool = True
    surveyed_control: bool = False
    max_gcps_per_image: int = Field(default=1500, ge=20)
    tie_neighbours: int = Field(default=8, ge=1)
    min_tie_point_rays: int = Field(default=3, ge=2)
    max_tie_points_per_image: int = Field(default=100, ge=20)
    cauchy_scale: float = Field(default=2.0, gt=0)
    gate_probability: float = Field(default=0.999, gt=0.5, lt=1)
    max_iterations: int = Field(default=30, ge=1)
    update_from_images: int = Field(default=500, ge=0)
    accept_datum: list[str] = []

    @field_validator("accept_datum")
    @classmethod
    def _findings(cls, value: list[str]) -> list[str]:
        if set(value) - set(DATUM_FINDINGS):
            raise ValueError(f"expected some of: {', '.join(DATUM_FINDINGS)}")
        return value

    @field_validator("constraints", mode="before")
    @classmethod
    def _one_kind(cls, value: Any) -> Any:
        if isinstance(value, (list, tuple, dict)) or (isinstance(value, str) and "," in value):
            raise ValueError(
                "choose one of 'auto-gcps', 'pose-priors', 'none'. Automatic GCPs and pose priors come from the same "
                "matches: both together would count them twice, and the result would claim to be better than it is"
            )
        return value


class ReportConfig(Section):
    recording: bool = True
    recording_image_side_px: int = Field(default=768, ge=64)
    recording_max_points: int = Field(default=200_000, ge=0)


class RunConfig(Section):
    workers: int = Field(default=1, ge=1)
    threads: int = Field(default=0, ge=0)


class Config(Section):
    features: FeaturesConfig = FeaturesConfig()
    matching: MatchingConfig = MatchingConfig()
    retrieval: RetrievalConfig = RetrievalConfig()
    candidates: CandidatesConfig = CandidatesConfig()
    localize: LocalizeConfig = LocalizeConfig()
    network: NetworkConfig = NetworkConfig()
    tracks: TracksConfig = TracksConfig()
    global_map: GlobalMapConfig = GlobalMapConfig()
    stations: StationsConfig = StationsConfig()
    adjust: AdjustConfig = AdjustConfig()
    report: ReportConfig = ReportConfig()
    run: RunConfig = RunConfig()


def presets_folder() -> Path:
    """Where the presets lie: inside an installed package, or in `configs/` of a checkout."""
    installed = Path(__file__).parent / "_configs"
    return installed if installed.is_dir() else Path(__file__).parent.parent / "configs"


def load_config(preset: str, layers: Iterable[Mapping[str, Any]] = ()) -> Config:
    """The default, a preset on top (a name of `configs/` or a path to a TOML file), then layers of nested tables.

    Raises ConfigError with the key, its value and the nearest valid key.
    """
    merged: dict[str, Any] = {}
    for path in (presets_folder() / "default.toml", _preset_path(preset)):
        layer = read_toml(path)
        validated(Config, layer, str(path))  # by itself, so that the message names the file
        merged = merge(merged, layer)
    for layer in layers:
        merged = merge(merged, layer)
    return validated(Config, merged, "[config] of project.toml, or --set")


def _preset_path(preset: str) -> Path:
    path = Path(preset)
    if path.suffix != ".toml":
        path = presets_folder() / f"{preset}.toml"
        known = sorted(p.stem for p in presets_folder().glob("*.toml"))
        if preset not in known:
            raise ConfigError(
                f"There is no preset '{preset}'.{_nearest(preset, known)}\nExpected one of {', '.join(known)}, "
                "or the path of a .toml file."
            )
    return path


def read_toml(path: Path) -> dict[str, Any]:
    """A TOML file as nested tables; ConfigError with line and column where it is not valid."""
    try:
        return tomllib.loads(path.read_text(encoding="utf-8-sig"))
    except FileNotFoundError:
        raise ConfigError(f"There is no file {path}.") from None
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise ConfigError(f"Not valid TOML: {error}.\nIn {path}.") from None


def merge(base: Mapping[str, Any], top: Mapping[str, Any]) -> dict[str, Any]:
    """Nested tables, the keys of `top` winning."""
    out = dict(base)
    for key, value in top.items():
        below = out.get(key)
        out[key] = merge(below, value) if isinstance(below, Mapping) and isinstance(value, Mapping) else value
    return out


def parse_overrides(settings: Iterable[str]) -> dict[str, Any]:
    """`section.key=value` strings as nested tables; the value is TOML where it reads as TOML, else a string."""
    merged: dict[str, Any] = {}
    for setting in settings:
        key, equals, text = setting.partition("=")
        parts = [part.strip() for part in key.split(".")]
        if not equals or len(parts) < 2 or not all(parts):
            raise ConfigError(f"--set {setting!r} cannot be read.\nExpected section.key=value, e.g. adjust.gnss=false.")
        try:
            value = tomllib.loads(f"value = {text}")["value"]
        except tomllib.TOMLDecodeError:
            value = text.strip()
        nested: Any = value
        for part in reversed(parts):
            nested = {part: nested}
        merged = merge(merged, nested)
    return merged


def validated(model: type[M], data: Mapping[str, Any], where: str) -> M:
    """The validated model; ConfigError with every wrong key, its value, and the nearest valid key."""
    try:
        return model.model_validate(dict(data))
    except ValidationError as error:
        lines = [_explain(model, dict(item)) for item in error.errors()]
        raise ConfigError("\n".join([*lines, f"In {where}."])) from None


def _explain(model: type[BaseModel], item: dict[str, Any]) -> str:
    path = [part for part in item["loc"] if not str(part).startswith(("function-", "literal["))]
    key = ".".join(str(part) for part in path)
    if item["type"] == "extra_forbidden":
        valid = _keys_beside(model, path)
        return f"Unknown key '{key}'.{_nearest(str(path[-1]), valid)} Valid keys here: {', '.join(valid)}."
    if item["type"] == "missing":
        return f"The key '{key}' is missing."
    message = item["msg"].removeprefix("Value error, ")
    if isinstance(item["input"], dict):  # what a section says as a whole, not one value in it
        return f"{f'The section [{key}]' if key else 'The file'} cannot be used: {message}."
    return f"The key '{key}' has the value {item['input']!r}: {message[0].lower()}{message[1:]}."


def _keys_beside(model: type[BaseModel], path: list[Any]) -> list[str]:
    current: Any = model
    for part in path[:-1]:
        field = current.model_fields.get(part) if hasattr(current, "model_fields") else None
        current = _model_in(field.annotation) if field else current
    return sorted(current.model_fields) if hasattr(current, "model_fields") else []


def _model_in(annotation: Any) -> Any:
    """The pydantic model inside an annotation such as `dict[str, Model]` or `Model | None`."""
    if hasattr(annotation, "model_fields"):
        return annotation
    inner = [_model_in(arg) for arg in getattr(annotation, "__args__", ())]
    return next((model for model in inner if model is not None), None)


def _nearest(name: str, known: Iterable[str]) -> str:
    close = difflib.get_close_matches(name, list(known), n=1, cutoff=0.5)
    return f" Did you mean '{close[0]}'?" if close else ""
