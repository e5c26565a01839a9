"""The published way to the local model: all pairs among the query and its candidates matched, verified, triangulated.

COLMAP verifies each pair, then triangulates from the fixed reference poses with two-view tracks kept; the points that
the query's keypoints correspond to make the local model.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import combinations

import numpy as np
import pycolmap
from numpy.typing import NDArray

from georef.estimation.colmap import colmap_camera
from georef.estimation.guided import PosedFeatures
from georef.estimation.local_model import LocalModel
from georef.features.base import Matcher
from georef.geometry.projection import Views
from georef.geometry.triangulation import triangulate
from georef.types.results import ReferenceNoise
from georef.types.scene import Observations

VerifyPair = Callable[[int, int], pycolmap.TwoViewGeometry]
"""The verified matches of two images, by their place in the list of references with the query behind them."""


def verify_pair(a: PosedFeatures, b: PosedFeatures, matcher: Matcher, match_keypoints: int) -> pycolmap.TwoViewGeometry:
    """Matches of two images and COLMAP's geometric verification of them; the known poses are not used."""
    matches = matcher.match(a.features.head(match_keypoints), b.features.head(match_keypoints))
    indices = matches.indices.astype(np.uint32)
    options = pycolmap.TwoViewGeometryOptions()
    options.ransac.random_seed = 0
    known = not (a.camera.estimate or b.camera.estimate)
    verify = pycolmap.estimate_calibrated_two_view_geometry if known else pycolmap.estimate_two_view_geometry
    return verify(colmap_camera(a.camera, 1), a.pixels, colmap_camera(b.camera, 2), b.pixels, indices, options)


def published_model(references: Sequence[PosedFeatures], verify: VerifyPair, noise: ReferenceNoise) -> LocalModel:
    """The local model of a query from its candidates, all pairs among them verified: 55 pairs of 11 images."""
    graph = pycolmap.CorrespondenceGraph()
    for index, image in enumerate(references):
        graph.add_image(index + 1, len(image.features))
    for a, b in combinations(range(len(references)), 2):
        graph.add_two_view_geometry(a + 1, b + 1, verify(a, b))
    graph.finalize()
    reconstruction = triangulated(references, graph)
    to_query = [_with_query(verify(a, len(references)), a) for a in range(len(references))]
    return _model_of_query(references, reconstruction, np.concatenate(to_query), noise)


def _with_query(geometry: pycolmap.TwoViewGeometry, reference: int) -> NDArray[np.int64]:
    """Rows (M, 3): reference, its keypoint, the query's keypoint."""
    verified = np.asarray(geometry.inlier_matches, dtype=np.int64).reshape(-1, 2)
    return np.column_stack([np.full(len(verified), reference), verified])


def triangulated(references: Sequence[PosedFeatures], graph: pycolmap.CorrespondenceGraph) -> pycolmap.Reconstruction:
    """Points from the references at their given poses."""
    reconstruction = pycolmap.Reconstruction()
    for index, reference in enumerate(references):
        camera = colmap_camera(reference.camera, index + 1)
        reconstruction.add_camera_with_trivial_rig(camera)
        image = pycolmap.Image(
            name=str(index), keypoints=reference.pixels, camera_id=camera.camera_id, image_id=index + 1
        )
        pose = reference.world_from_cam.inverse()
        reconstruction.add_image_with_trivial_frame(image, pycolmap.Rigid3d(pose.matrix()[:3]))
    options = pycolmap.IncrementalTriangulatorOptions()
    options.ignore_two_view_tracks = False
    options.random_seed = 0
    manager = pycolmap.ObservationManager(reconstruction, graph)
    triangulator = pycolmap.IncrementalTriangulator(graph, reconstruction, manager)
    for index in range(len(references)):
        triangulator.triangulate_image(options, index + 1)
    triangulator.complete_all_tracks(options)
    triangulator.merge_all_tracks(options)
    manager.filter_all_points3D(4.0, 1.5)
    return reconstruction


def _model_of_query(
    references: Sequence[PosedFeatures],
    reconstruction: pycolmap.Reconstruction,
    to_query: NDArray[np.int64],
    noise: ReferenceNoise,
) -> LocalModel:
    """Each query keypoint takes the point that most of its reference keypoints belong to."""
    candidates: dict[int, dict[int, int]] = {}
    for reference, keypoint, query_keypoint in to_query:
        point = reconstruction.image(int(reference) + 1).points2D[int(keypoint)]
        if point.has_point3D():
            votes = candidates.setdefault(int(query_keypoint), {})
            votes[point.point3D_id] = votes.get(point.point3D_id, 0) + 1
    chosen = {keypoint: max(votes, key=lambda k: votes[k]) for keypoint, votes in sorted(candidates.items())}
    rows = [
        (index, element.image_id - 1, element.point2D_idx)
        for index, point in enumerate(chosen.values())
        for element in reconstruction.point3D(point).track.elements
    ]
    table = np.array(rows, dtype=np.int64).reshape(-1, 3)
    pixel = np.array([references[v].pixels[k] for _, v, k in rows]).reshape(-1, 2)
    scale = np.array([references[v].features.scales_px[k] for _, v, k in rows], dtype=np.float64)
    observations = Observations(table[:, 0], table[:, 1], pixel, noise.keypoint_sigma * scale, table[:, 2])
    views = Views.of([r.world_from_cam for r in references], [r.camera for r in references])
    points = np.array([reconstruction.point3D(p).xyz for p in chosen.values()]).reshape(-1, 3)
    solved = triangulate(views, table[:, 0], table[:, 1], pixel, observations.sigma_px, len(chosen))
    model = LocalModel(np.array(list(chosen), dtype=np.int64), points, solved.cov, views, observations)
    return model.take(np.asarray(np.isfinite(solved.cov).all(axis=(1, 2))))
