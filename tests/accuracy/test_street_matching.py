"""Rendered pictures of two epochs behave as photographs do: features match where nothing changed, and only there."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from georef.geometry.rigid import Array, Rigid3
from georef.simulate.render import Photography, render
from georef.simulate.rigs import second_rig
from georef.simulate.scene import Scene, build_scene
from georef.simulate.street import StreetOptions, build_street

STREET = build_street(StreetOptions(seed=0))
LENS = second_rig("small", 0.7).lenses["front"]
TRUE_PX = 3.0


def keypoints(picture: NDArray[np.uint8]) -> tuple[Array, NDArray[np.float32]]:
    sift = cv2.SIFT_create(4000)  # pyright: ignore[reportAttributeAccessIssue]
    found, descriptors = sift.detectAndCompute(cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY), None)
    return np.array([k.pt for k in found]) + 0.5, descriptors


def camera_at(s_m: float, right_m: float) -> Rigid3:
    head = second_rig("small", 0.7).heads[0]
    frame = STREET.axis.frame(s_m, right_m, 0.0)
    return frame @ head.rig_from_cam


def seen(scene: Scene, pose: Rigid3, pixels: Array) -> tuple[Array, NDArray[np.int32]]:
    """The points that pixels show, and the items that they are of."""
    rays = LENS.rays(pixels) @ pose.rotation.T
    hits = scene.cast(np.broadcast_to(pose.translation, rays.shape), rays)
    return pose.translation + hits.distance_m[:, None] * rays, hits.item_number


def test_features_match_across_the_epochs_where_nothing_changed_and_fail_where_it_did() -> None:
    old, new = (build_scene(STREET, epoch) for epoch in ("first", "second"))
    here, there = camera_at(12.0, 1.7), camera_at(13.0, 0.4)
    a, da = keypoints(render(old, LENS, here, Photography(seed=1)))
    b, db = keypoints(render(new, LENS, there, Photography(seed=2)))
    assert min(len(a), len(b)) > 1500
    point, item = seen(old, here, a)
    point[~np.isfinite(point)] = np.nan
    reprojected = LENS.project(there.inverse().apply(point))
    _, new_item = seen(new, there, np.nan_to_num(reprojected))
    changed = np.isin(item, [c.item_number for c in STREET.changes])
    inside = np.isfinite(point).all(axis=1) & np.isfinite(reprojected).all(axis=1)
    both = inside & ~changed & (item == new_item)
    pairs = cv2.BFMatcher(cv2.NORM_L2).knnMatch(da, db, k=2)
    matched = {m.queryIdx: m.trainIdx for m, second in pairs if m.distance < 0.8 * second.distance}
    right = np.zeros(len(a), bool)
    for i, j in matched.items():
        right[i] = np.linalg.norm(b[j] - reprojected[i]) < TRUE_PX
    assert changed[inside].mean() > 0.05
    stable_share, changed_share = right[both].mean(), right[inside & changed].mean()
    assert 0.02 < stable_share < 0.5  # light, season and viewpoint are different
    assert changed_share < 0.2 * stable_share
    off = np.array([b[matched[int(i)]] - reprojected[i] for i in np.flatnonzero(right & both)])
    assert np.abs(np.median(off, axis=0)).max() < 0.25  # nothing shifts as a whole
    assert 0.05 < np.median(np.linalg.norm(off, axis=1)) < 1.0
